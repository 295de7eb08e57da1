"""The network of the per-frame fixer, and reading of weights."""
