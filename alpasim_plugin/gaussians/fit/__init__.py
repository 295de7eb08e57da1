"""Reconstruct a scene: fit 3D Gaussians to posed views.

`logged_views` gives views, `start_from_depth` gives a start, and
`loop.fit` the `Reconstruction`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from alpasim_plugin.gaussians.fit.recipe import SplatRecipe as SplatRecipe
    from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction as Reconstruction
    from alpasim_plugin.gaussians.fit.start import Start as Start
    from alpasim_plugin.gaussians.fit.start import cloud_from_points as cloud_from_points
    from alpasim_plugin.gaussians.fit.start import start_from_depth as start_from_depth
    from alpasim_plugin.gaussians.fit.views import PosedView as PosedView
    from alpasim_plugin.gaussians.fit.views import logged_views as logged_views

__all__ = [
    "PosedView",
    "Reconstruction",
    "SplatRecipe",
    "Start",
    "cloud_from_points",
    "logged_views",
    "start_from_depth",
]

__getattr__ = lazy_names(
    __name__,
    {
        "PosedView": ".views",
        "Reconstruction": ".reconstruction",
        "SplatRecipe": ".recipe",
        "Start": ".start",
        "cloud_from_points": ".start",
        "logged_views": ".views",
        "start_from_depth": ".start",
    },
)
