"""What the fit behind ``3dgs`` starts from: poses that drift, and depth of a few views, wrong by patches, as matching images gives both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, Box
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.start import Start, start_from_depth
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.renderers.reconstruction_recipe import ReconstructionRecipe

PATCH_SHARE = 0.075  # of the image's width: neighbours within a patch are wrong together
LEAST, MOST = 0.5, 2.0  # a depth is never wrong by more than these factors
POSE_KNOT_VIEWS = 4  # the error of poses is drawn every so many views and interpolated: registration drifts, it does not jump
TURN_RAD_PER_M = 0.044  # of the error's directions: a quarter degree with 0.1 m


def misplaced(views: Sequence[PosedView], spread_m: float, scene_id: str, seed: int) -> list[PosedView]:
    """Return the views with the poses that registration believes: moved and turned by smooth errors of normal spread.

    Args:
        views: In order of time.
        spread_m: Along each axis of the camera; directions turn by `TURN_RAD_PER_M` of it about each axis. 0 changes nothing.
        scene_id, seed: Key of the random stream.
    """
    if spread_m == 0:
        return list(views)
    knots = stream(scene_id, seed, "reconstruction.poses").standard_normal((len(views) // POSE_KNOT_VIEWS + 2, 6))
    at = np.arange(len(views)) / POSE_KNOT_VIEWS
    errors = spread_m * np.stack([np.interp(at, np.arange(len(knots)), column) for column in knots.T], axis=1)  # (V, 6)
    out = []
    for view, error in zip(views, errors, strict=True):
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(TURN_RAD_PER_M * error[3:])[0]
        T[:3, 3] = error[:3]
        out.append(replace(view, camera=replace(view.camera, T_camera_world=T @ view.camera.T_camera_world)))
    return out


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
