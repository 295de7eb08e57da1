"""Scenes of Gaussians: a map dressed in clouds, its actors, and its sky."""
