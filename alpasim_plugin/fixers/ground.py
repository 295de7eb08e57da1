"""Recorded frames carried into a view by two hypotheses of its depth: the render's own, and the ground.

A poor reconstruction has holes and mist above the road in front of the car, where a recorded frame shows the road itself. A rig stands on
the ground, so the depth of the ground is known wherever a ray meets the plane z = 0 of the rig. Of the two depths of a pixel the one counts
with which two recorded frames agree: plane-sweeping stereo (Collins, 1996, "A space-sweep approach to true multi-image matching") with two
hypotheses a pixel. Where they agree equally well, or where only one frame is there, the ground is preferred.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from alpasim_plugin.core.types import F32, F64, U8, Bool, Box
from alpasim_plugin.fixers.warp import Picture, WarpTarget, box_around, placed_boxes, plain_box_around, plain_points, warp

I32 = npt.NDArray[np.int32]

NEAREST_M, FARTHEST_M = 0.5, 120.0  # depths in which the road is taken for the plane below the rig
FREE_SHARE = 0.4  # a surface nearer than this share of the ground's depth stands above the ground for certain
WINDOW_RAD = 0.075  # side of the window in which two recorded frames are compared
PREFERENCE = 3  # grey levels by which the ground may agree less than the render's depth does
GREY = np.array([[1 / 3, 1 / 3, 1 / 3, 0]], np.float32)
UNSEEN = 30  # grey levels: the disagreement of a pixel that one of the two frames does not show


def carry(pictures: Sequence[Picture], target: WarpTarget, T_world_rig: F64, boxes: Mapping[str, Box]) -> tuple[U8, ...]:
    """Carry recorded frames into a view, each as `warp` does, by the better of the two depths of every pixel.

    Args:
        pictures: Recorded frames, nearest first; the first two are compared.
        target: The view.
        T_world_rig: ``(4, 4)`` of a rig near the view; the plane z = 0 of it is the ground.
        boxes: Sizes of the actors; what lies in the box of one keeps the render's depth.

    Returns:
        For each picture ``(H, W, 4)`` uint8: see `warp`.
    """
    by_depth = [warp(picture, target, boxes) for picture in pictures]
    depth = ground_hypothesis(target, T_world_rig, boxes)
    rows = np.flatnonzero(depth.any(axis=1))
    if not by_depth or not len(rows):
        return tuple(by_depth)
    lower = slice(int(rows[0]), len(depth))
    K = target.K.copy()
    K[1, 2] -= lower.start
    view = replace(target, K=K, depth=depth[lower], actors={})
    by_ground = [warp(picture, view, boxes, FREE_SHARE) for picture in pictures]
    ground = view.depth > 0
    if len(pictures) > 1:
        size = max(3, round(WINDOW_RAD * float(K[0, 0])) | 1)
        own = [image[lower] for image in by_depth[:2]]
        better = _disagreement(by_ground[0], by_ground[1], size) <= _disagreement(own[0], own[1], size) + PREFERENCE * size**2
        ground &= better | (target.depth[lower] <= 0)
    for image, on_ground in zip(by_depth, by_ground, strict=True):
        cv2.copyTo(on_ground, ground.view(np.uint8), image[lower])  # in place
    return tuple(by_depth)


def ground_hypothesis(target: WarpTarget, T_world_rig: F64, boxes: Mapping[str, Box]) -> F32:
    """Return the depth of the ground ``(H, W)`` in metres along the optical axis, where a pixel of the view may show it; elsewhere 0.

    It may where the ray meets the ground between `NEAREST_M` and `FARTHEST_M`, and the render has a hole there or a surface that is not
    nearer than `FREE_SHARE` of that and does not lie in an actor's box. Arguments as of `carry`.
    """
    _, T_box_world, sizes = placed_boxes(target.actors, boxes)
    # A pixel p at depth z lies at z ray p + eye in the world, and so at the height z (down . p) + height_m above the ground.
    ray, eye = (
        np.ascontiguousarray(target.T_world_camera[:3, :3] @ np.linalg.inv(target.K)),
        np.ascontiguousarray(target.T_world_camera[:3, 3]),
    )
    up = T_world_rig[:3, 2]
    out = np.zeros(target.depth.shape, np.float32)
    _ground(np.ascontiguousarray(target.depth), up @ ray, float(up @ (eye - T_world_rig[:3, 3])), ray, eye, T_box_world, sizes, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _ground(depth, down, height_m, ray, eye, T_box, sizes, out):
    """Fill ``out``; the loop of `plain_ground_hypothesis`."""
    for row in range(depth.shape[0]):
        v = row + 0.5
        for column in range(depth.shape[1]):
            u = column + 0.5
            z = -height_m / (down[0] * u + down[1] * v + down[2])
            if not NEAREST_M < z < FARTHEST_M:
                continue
            seen = np.float64(depth[row, column])
            if seen > 0:
                if seen < FREE_SHARE * z:
                    continue
                px = seen * (ray[0, 0] * u + ray[0, 1] * v + ray[0, 2]) + eye[0]
                py = seen * (ray[1, 0] * u + ray[1, 1] * v + ray[1, 2]) + eye[1]
                pz = seen * (ray[2, 0] * u + ray[2, 1] * v + ray[2, 2]) + eye[2]
                if box_around(px, py, pz, T_box, sizes) >= 0:
                    continue
            out[row, column] = z


def plain_ground_hypothesis(target: WarpTarget, T_world_rig: F64, boxes: Mapping[str, Box]) -> F32:
    """Return the same as `ground_hypothesis`, array by array: the reference of its kernel."""
    one_m = plain_points(np.ones_like(target.depth), target.K, target.T_world_camera)
    up, eye = T_world_rig[:3, 2], target.T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = up @ (T_world_rig[:3, 3] - eye) / ((one_m - eye) @ up)
    _, T_box_world, sizes = placed_boxes(target.actors, boxes)
    boxed = plain_box_around(plain_points(target.depth, target.K, target.T_world_camera), T_box_world, sizes) >= 0
    may: Bool = (z > NEAREST_M) & (z < FARTHEST_M) & ((target.depth <= 0) | ((target.depth >= FREE_SHARE * z) & ~boxed))
    return np.where(may, z, 0).astype(np.float32)


def _disagreement(a: U8, b: U8, size: int) -> I32:
    """Return by how many grey levels two warped frames differ, summed over the window around each pixel ``(H, W)``.

    Whole numbers: their sum is the same in any order.
    """
    apart = cv2.transform(cv2.absdiff(a, b), GREY)
    apart[(a[..., 3] == 0) | (b[..., 3] == 0)] = UNSEEN
    return np.asarray(cv2.boxFilter(apart, cv2.CV_32S, (size, size), normalize=False), np.int32)
