"""Cameras: from a pixel to a ray and back. Lens models, shutters, and calibrations from files."""
