"""Hydra presets for AlpaSim's wizard (entry point group ``alpasim.configs``)."""
