"""Policies: from observations to plans."""
