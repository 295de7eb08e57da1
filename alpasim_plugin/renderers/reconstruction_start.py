"""The rough points that the fit behind ``3dgs`` starts from: depth of a few views, wrong by patches, as matching images gives it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.start import Start, start_from_depth
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.renderers.reconstruction_recipe import ReconstructionRecipe
from alpasim_plugin.seeding import stream
from alpasim_plugin.types import F32, Box

PATCH_SHARE = 0.075  # of the image's width: neighbours within a patch are wrong together
LEAST, MOST = 0.5, 2.0  # a depth is never wrong by more than these factors


def rough_start(views: Sequence[PosedView], boxes: Mapping[str, Box], recipe: ReconstructionRecipe, scene_id: str) -> Start:
    """Return the Gaussians to begin with.

    Points that are wrong along the ray of the view they come from look right from there and wrong from aside: that, and not only blur, is
    what a short fit leaves of a scene beside the logged path.

    Args:
        views: With depth.
        boxes: Size of each actor that a view may show.
        recipe: How many points from how many views, how wrong, how large.
        scene_id: Key of the random streams, with the recipe's seed.

    Raises:
        InputError: No view has depth.
    """
    splat = recipe.splat
    chosen = [
        replace(view, depth=view.depth * _factors(view, recipe.range_error, stream(scene_id, splat.seed, "reconstruction.range", i)))
        for i, view in enumerate(views)
        if view.depth is not None and i % recipe.depth_every == 0
    ]
    start = start_from_depth(chosen, boxes, splat.points, scene_id, splat.seed)
    return Start(_sized(start.background, recipe), {name: _sized(cloud, recipe) for name, cloud in start.actors.items()})


def _factors(view: PosedView, spread: float, rng: np.random.Generator) -> F32:
    """Return by what the depth of every pixel ``(H, W)`` is multiplied: smooth over a patch, of this spread about one."""
    height, width = view.rgb.shape[:2]
    cell = max(2.0, PATCH_SHARE * width)
    coarse = rng.standard_normal((int(height / cell) + 2, int(width / cell) + 2)).astype(np.float32)
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(1 + np.float32(spread) * smooth, LEAST, MOST), dtype=np.float32)


def _sized(cloud: GaussianCloud, recipe: ReconstructionRecipe) -> GaussianCloud:
    return replace(cloud, scales=cloud.scales * recipe.size, opacities=np.full_like(cloud.opacities, recipe.opacity))
