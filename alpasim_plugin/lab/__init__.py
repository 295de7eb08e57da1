"""The laboratory: what compares and trains fixers. Nothing of the product imports it."""
