"""Decide while scenes are driven: e-processes and confidence sequences on paired scene differences,
with a guarantee at every look.
"""
