"""Make training data and train the networks of a fixer."""
