"""Scenes of Gaussians: a map dressed in clouds, its actors, its sky, and the surrogate
degradation.
"""
