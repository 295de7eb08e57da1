"""Recorded drives become scenarios: readers of posed photographs, ground, corridor, obstacles,
quality.
"""
