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

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.kernels import float_kernel
from alpasim_plugin.core.types import F32, F64, U8, Bool, Box
from alpasim_plugin.fixers.warp import (
    FREE_SHARE,
    RecordedImage,
    WarpTarget,
    boxes_on_rays,
    on_boxes,
    place_boxes,
    warp,
)
from alpasim_plugin.gaussians.raster.stages import map_on_threads

I32 = npt.NDArray[np.int32]

# Depths in which the road is taken for the plane below the rig
NEAREST_M = 0.5
FARTHEST_M = 120.0
WINDOW_RAD = 0.075  # side of the window in which two recorded frames are compared
# Grey levels by which the ground may agree less than the render's depth does; and where the render
# itself shows a surface about as far away, which is the ground at a wrong depth.
PREFERENCE = 3
NEAR_PREFERENCE = 10
ABOUT = (0.75, 1.4)  # the render's depth as a share of the ground's
FLOATING_M = 1.0  # nothing stands so near to a camera: it does not hide the ground
GREY = np.array([[1 / 3, 1 / 3, 1 / 3, 0]], dtype=np.float32)
SAMPLES = 15  # a larger window is sampled by so many rows and columns, or up to twice as many
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
    depth = ground_hypothesis(target, T_world_rig)
    ground = depth > 0
    if len(recorded_images) < 2 or not ground.any():
        return tuple(_warp_all(recorded_images, _by_two(target, depth, ground), threads))
    size = window_px(target.K)
    step = step_px(size)
    across = size // step | 1
    top = int(ground.any(axis=1).argmax()) // step * step
    compared = recorded_images[:2]
    columns = slice(0, None, step)
    # All pixels of the view are the view itself, which knows its road users' boxes already.
    sampled = target if step == 1 else target.window(columns, columns)
    by_depth = _warp_all(compared, sampled, threads)
    view = replace(target, depth=depth, ground=ground, actors={})
    view = view.window(slice(top, None, step), columns)
    by_ground = _warp_all(compared, view, threads)
    coarse = [image[top // step :] for image in by_depth]
    share = target.depth[top::step, ::step] / np.maximum(view.depth, NEAREST_M)
    about = (share > ABOUT[0]) & (share < ABOUT[1])
    agrees = (
        _disagreement(by_ground[0], by_ground[1], across)
        <= _disagreement(coarse[0], coarse[1], across)
        + np.where(about, NEAR_PREFERENCE, PREFERENCE) * across**2
    )
    height, width = ground[top:].shape
    if step > 1:
        agrees = agrees.repeat(step, axis=0)[:height].repeat(step, axis=1)[:, :width]
    ground[top:] &= agrees | (target.depth[top:] <= 0)
    if step > 1:
        return tuple(_warp_all(recorded_images, _by_two(target, depth, ground), threads))
    for image, on_ground in zip(by_depth, by_ground, strict=True):
        cv2.copyTo(on_ground, ground[top:].view(np.uint8), image[top:])  # in place
    if len(recorded_images) == 2:
        return tuple(by_depth)
    others = _warp_all(recorded_images[2:], _by_two(target, depth, ground), threads)
    return (*by_depth, *others)


def _by_two(target: WarpTarget, depth: F32, ground: Bool) -> WarpTarget:
    """Return a view that has the depth of the ground where ``ground`` says so."""
    return replace(target, depth=np.where(ground, depth, target.depth), ground=ground)


def _warp_all(
    recorded_images: Sequence[RecordedImage], target: WarpTarget, threads: int
) -> list[U8]:
    return map_on_threads(threads, partial(warp, target=target), recorded_images)


def window_px(K: F64) -> int:
    """Return the side of the window in which two recorded frames are compared, pixels; odd."""
    return max(3, round(WINDOW_RAD * float(K[0, 0])) | 1)


def step_px(size: int) -> int:
    """Return every how many pixels two recorded frames are compared in windows of a size."""
    return max(1, size // SAMPLES)


def ground_hypothesis(target: WarpTarget, T_world_rig: F64) -> F32:
    """Return the depth of the ground ``(H, W)`` in metres, as the view counts it, where a pixel of
    the view may show it; elsewhere 0.

    It may where the ray meets the ground between `NEAREST_M` and `FARTHEST_M`, and the render has a
    hole there, a surface that is not nearer than `FREE_SHARE` of that, or one within `FLOATING_M`,
    and the ray meets no actor's box. Arguments as of `carry`.
    """
    # A pixel p at depth z lies at the height z (down . p) + height_m above the ground.
    down = T_world_rig[:3, 2] @ target.T_world_camera[:3, :3]
    height_m = T_world_rig[:3, 2] @ (target.T_world_camera[:3, 3] - T_world_rig[:3, 3])
    out = np.empty(target.depth.shape, dtype=np.float32)
    depth = np.ascontiguousarray(target.depth)
    if target.rays is None:
        _ground(depth, down @ np.linalg.inv(target.K), height_m, out)
    else:
        _ground_on_rays(target.rays, depth, down, height_m, out)
    out[on_boxes(target.depth.shape, target.placed.boxes, target.rays)] = 0
    return out


@float_kernel
def _ground(depth, down, height_m, out):
    for row in range(out.shape[0]):
        below = down[1] * (row + 0.5) + down[2]
        for column in range(out.shape[1]):
            slope, surface = down[0] * (column + 0.5) + below, np.float64(depth[row, column])
            z = -height_m / slope if slope < 0 else 0.0
            hides = (surface > FLOATING_M) & (surface < FREE_SHARE * z)
            free = (z > NEAREST_M) & (z < FARTHEST_M) & ~hides
            out[row, column] = z if free else 0.0


@float_kernel
def _ground_on_rays(rays, depth, down, height_m, out):
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            x, y, z = rays[row, column]
            slope, surface = down[0] * x + down[1] * y + down[2] * z, np.float64(depth[row, column])
            distance = -height_m / slope if slope < 0 else 0.0
            hides = (surface > FLOATING_M) & (surface < FREE_SHARE * distance)
            free = (distance > NEAREST_M) & (distance < FARTHEST_M) & ~hides
            out[row, column] = distance if free else 0.0


def with_users(recorded: RecordedImage, boxes: Mapping[str, Box]) -> RecordedImage:
    """Return a recorded frame that knows which of its pixels show road users."""
    height, width = recorded.depth.shape
    world = recorded.T_world_camera, recorded.actors, boxes
    if recorded.lens is None:
        placed = place_boxes((height, width), recorded.K, *world)
        users = on_boxes((height, width), placed.boxes)
    else:
        placed = boxes_on_rays(recorded.lens.rays, *world)
        users = on_boxes((height, width), placed.boxes, recorded.lens.rays)
    return replace(recorded, users=users) if users.any() else recorded


def _disagreement(a: U8, b: U8, size: int) -> I32:
    """Return by how many grey levels two warped frames differ, summed over the window around each
    pixel ``(H, W)``.

    Whole numbers: their sum is the same in any order.
    """
    apart = cv2.transform(cv2.absdiff(a, b), GREY)
    apart[cv2.min(cv2.extractChannel(a, 3), cv2.extractChannel(b, 3)) == 0] = UNSEEN
    return cv2.boxFilter(apart, cv2.CV_32S, (size, size), normalize=False)
