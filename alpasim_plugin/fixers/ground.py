"""Recorded frames carried into a view by two hypotheses of its depth: the render's own, and the
ground.

A poor reconstruction has holes and mist above the road in front of the car, where a recorded frame
shows the road itself. A rig stands on the ground, so the depth of the ground is known wherever a
ray meets the plane z = 0 of the rig. Of the two depths of a pixel the one counts with which two
recorded frames agree: plane-sweeping stereo (Collins, 1996, "A space-sweep approach to true
multi-image matching") with two hypotheses a pixel. Where they agree equally well, or where only one
frame is there, the ground is preferred.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.kernels import float_kernel
from alpasim_plugin.core.types import F32, F64, U8, Box
from alpasim_plugin.fixers.warp import RecordedImage, WarpTarget, on_boxes, place_boxes, warp
from alpasim_plugin.gaussians.raster.rasterize_cpu import run_on_threads

I32 = npt.NDArray[np.int32]

NEAREST_M, FARTHEST_M = 0.5, 120.0  # depths in which the road is taken for the plane below the rig
# a surface nearer than this share of the ground's depth stands above the ground for certain
FREE_SHARE = 0.4
WINDOW_RAD = 0.075  # side of the window in which two recorded frames are compared
PREFERENCE = 3  # grey levels by which the ground may agree less than the render's depth does
GREY = np.array([[1 / 3, 1 / 3, 1 / 3, 0]], np.float32)
HIDING_M = 1e-3  # depth given to a recorded road user, whom the ground behind shows nowhere
UNSEEN = 30  # grey levels: the disagreement of a pixel that one of the two frames does not show


def carry(
    recorded_images: Sequence[RecordedImage], target: WarpTarget, T_world_rig: F64, threads: int = 1
) -> tuple[U8, ...]:
    """Carry recorded frames into a view, each as `warp` does, by the better of the two depths of
    every pixel.

    Args:
        recorded_images: Recorded frames as of `with_users`, nearest first; the first two are compared.
        target: The view; where a ray meets the box of an actor, the render's depth counts.
        T_world_rig: ``(4, 4)`` of a rig near the view; the plane z = 0 of it is the ground.
        threads: As many images are carried at a time; the result does not depend on it.

    Returns:
        For each recorded image ``(H, W, 4)`` uint8: see `warp`.
    """
    by_depth = _warp_all(recorded_images, target, np.inf, threads)
    depth = ground_hypothesis(target, T_world_rig)
    rows = np.flatnonzero(depth.any(axis=1))
    if not by_depth or not len(rows):
        return tuple(by_depth)
    lower = slice(int(rows[0]), len(depth))
    K = target.K.copy()
    K[1, 2] -= lower.start
    view = replace(target, K=K, depth=depth[lower], actors={})
    by_ground = _warp_all(
        [hidden_by_users(recorded) for recorded in recorded_images], view, FREE_SHARE, threads
    )
    ground = view.depth > 0
    if len(recorded_images) > 1:
        size = window_px(K)
        own = [image[lower] for image in by_depth[:2]]
        better = (
            _disagreement(by_ground[0], by_ground[1], size)
            <= _disagreement(own[0], own[1], size) + PREFERENCE * size**2
        )
        ground &= better | (target.depth[lower] <= 0)
    for image, on_ground in zip(by_depth, by_ground, strict=True):
        cv2.copyTo(on_ground, ground.view(np.uint8), image[lower])  # in place
    return tuple(by_depth)


def _warp_all(
    recorded_images: Sequence[RecordedImage], target: WarpTarget, free_share: float, threads: int
) -> list[U8]:
    out = {}
    todo = iter(range(len(recorded_images)))  # shared: each thread takes the next

    def work() -> None:
        for i in todo:
            out[i] = warp(recorded_images[i], target, free_share)

    run_on_threads(max(1, min(threads, len(recorded_images))), work)
    return [out[i] for i in range(len(recorded_images))]


def window_px(K: F64) -> int:
    """Return the side of the window in which two recorded frames are compared, pixels; odd."""
    return max(3, round(WINDOW_RAD * float(K[0, 0])) | 1)


def ground_hypothesis(target: WarpTarget, T_world_rig: F64) -> F32:
    """Return the depth of the ground ``(H, W)`` in metres along the optical axis, where a pixel of
    the view may show it; elsewhere 0.

    It may where the ray meets the ground between `NEAREST_M` and `FARTHEST_M`, and the render has a
    hole there or a surface that is not nearer than `FREE_SHARE` of that, and the ray meets no
    actor's box. Arguments as of `carry`.
    """
    # A pixel p at depth z lies at the height z (down . p) + height_m above the ground.
    down = T_world_rig[:3, 2] @ target.T_world_camera[:3, :3] @ np.linalg.inv(target.K)
    height_m = T_world_rig[:3, 2] @ (target.T_world_camera[:3, 3] - T_world_rig[:3, 3])
    out = np.empty(target.depth.shape, np.float32)
    _ground(np.ascontiguousarray(target.depth), down, height_m, out)
    out[on_boxes(target.depth.shape, target.placed.seen)] = 0
    return out


@float_kernel
def _ground(depth, down, height_m, out):
    for row in range(out.shape[0]):
        below = down[1] * (row + 0.5) + down[2]
        for column in range(out.shape[1]):
            slope, surface = down[0] * (column + 0.5) + below, np.float64(depth[row, column])
            z = -height_m / slope if slope < 0 else 0.0
            free = (
                (z > NEAREST_M) & (z < FARTHEST_M) & ((surface <= 0) | (surface >= FREE_SHARE * z))
            )
            out[row, column] = z if free else 0.0


def with_users(recorded: RecordedImage, boxes: Mapping[str, Box]) -> RecordedImage:
    """Return a recorded frame that knows which of its pixels show road users."""
    height, width = recorded.depth.shape
    placed = place_boxes(
        (height, width), recorded.K, recorded.T_world_camera, recorded.actors, boxes
    )
    users = on_boxes((height, width), placed.seen)
    return replace(recorded, users=users) if users.any() else recorded


def hidden_by_users(recorded: RecordedImage) -> RecordedImage:
    """Return a recorded frame whose road users hide all ground behind them, however near to it they
    stand.
    """
    return (
        recorded
        if recorded.users is None
        else replace(recorded, depth=np.where(recorded.users, np.float32(HIDING_M), recorded.depth))
    )


def _disagreement(a: U8, b: U8, size: int) -> I32:
    """Return by how many grey levels two warped frames differ, summed over the window around each
    pixel ``(H, W)``.

    Whole numbers: their sum is the same in any order.
    """
    apart = cv2.transform(cv2.absdiff(a, b), GREY)
    apart[cv2.min(cv2.extractChannel(a, 3), cv2.extractChannel(b, 3)) == 0] = UNSEEN
    return cv2.boxFilter(apart, cv2.CV_32S, (size, size), normalize=False)
