"""Scores of other benchmarks on our logs, from their published definitions."""
