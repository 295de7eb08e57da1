"""Recipes: what is trained on what, for how long, from which weights. One recipe gives one system
of the paper's tables.
"""
