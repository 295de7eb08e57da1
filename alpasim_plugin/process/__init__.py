"""Subprocesses and their supervisor, signals, standard output."""
