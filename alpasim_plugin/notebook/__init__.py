"""Runs in a notebook: tables as data frames, runs and rollouts that show themselves. `open_run` is the way in."""
