"""Fixers: what repairs a rendered frame, and what tells it where the road is."""
