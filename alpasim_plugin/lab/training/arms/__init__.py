"""The arms of the paper's comparison, trained as one whole."""
