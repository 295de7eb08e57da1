"""Reconstruct a scene: fit 3D Gaussians to posed views.

`logged_views` or `view_files.read_views` give views, `start_from_depth` gives a start, and `loop.fit` the `Reconstruction`. The loop is not
imported here, because it loads torch, which those who only read a reconstruction do without.
"""

from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.start import Start, cloud_from_points, start_from_depth
from alpasim_plugin.gaussians.fit.views import PosedView, held_out, logged_views

__all__ = [
    "PosedView",
    "Reconstruction",
    "SplatRecipe",
    "Start",
    "cloud_from_points",
    "held_out",
    "logged_views",
    "start_from_depth",
]
