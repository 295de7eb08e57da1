"""Carry a recorded frame into another view by that view's depth."""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.kernels import float_kernel, inlined_float_kernel
from alpasim_plugin.core.types import F32, F64, I64, U8, Bool, Box

INFINITY_M = 1e5  # how far a pixel without depth is: nothing moves by parallax there
# A point that is nearer to the recorded camera, or behind it, is not in its image.
NEAREST_M = 0.3
# Two depths agree within this share and this length: reconstructions are no better.
SLACK = 0.12
SLACK_M = 0.4
AROUND_M = (0.25, 0.25, 0.2)  # a point this far outside of a box still moves with it
# stands for the slope of a ray along a wall, so that it meets that wall's plane nowhere near
PARALLEL = 1e-300
# A recorded surface that is at least this share of a point's distance away does not hide the ground,
# unless it is a road user's; another point is hidden by all that does not agree with it.
FREE_SHARE = 0.4
# Where other pinholes of a lens fill in is looked for in at least so many columns of a view.
SEARCHED = 100
SOLE_M = 0.05  # but not the ground below: a box's lowest layer of this height stays where it is
TAPS = 2  # bicubic look-ups reach so many pixels beyond an image
# Added to a place in pixels: OpenCV counts from the first pixel's middle, here of such a margin.
FIRST_PX = TAPS - 0.5
NOWHERE_PX = np.float32(-1e4)
# Validity, the last channel of a reference: the depths agree, or do not; 0 elsewhere.
VALID = 255
INCONSISTENT = 128


@dataclass(frozen=True, eq=False)
class WarpTarget:
    """The view that references are warped into.

    Attributes:
        K: ``(3, 3)`` pixels.
        T_world_camera: ``(4, 4)``.
        depth: ``(H, W)`` metres along the optical axis; 0 where nothing is, which counts as
            infinitely far.
        actors: ``T_world_box`` of the actors present.
        boxes: Sizes of actors; one that has none counts as absent.
        ground: ``(H, W)`` which depths are the ground's; None: none is.
    """

    K: F64
    T_world_camera: F64
    depth: F32
    actors: Mapping[str, F64]
    boxes: Mapping[str, Box]
    ground: Bool | None = None

    def window(self, rows: slice, columns: slice) -> WarpTarget:
        """Return a part of the view, all its pixels or, as the slices' step says, some."""
        K, step = self.K.copy(), columns.step or 1
        K[:2, 2] += (step - 1) / 2 - np.array([columns.start, rows.start])
        K[:2] /= step
        depth = np.ascontiguousarray(self.depth[rows, columns])
        ground = None if self.ground is None else np.ascontiguousarray(self.ground[rows, columns])
        return replace(self, K=K, depth=depth, ground=ground)

    @cached_property
    def placed(self) -> PlacedBoxes:
        """The boxes of the actors present, as the view sees them; found once for all recorded
        frames that are carried into it.
        """
        return place_boxes(self.depth.shape, self.K, self.T_world_camera, self.actors, self.boxes)


@dataclass(frozen=True, eq=False)
class RecordedImage:
    """A recorded frame in memory.

    Attributes:
        K, T_world_camera, rgb, depth, actors: See `RecordedFrame`.
        users: The pixels of its road users ``(H, W)``; None where there are none.
        others: The frames of the other pinholes of its lens, of the same instant; they fill in what
            lies outside of this one.
    """

    K: F64
    T_world_camera: F64
    rgb: U8
    depth: F32
    actors: Mapping[str, F64]
    users: Bool | None = None
    others: tuple[RecordedImage, ...] = ()

    @cached_property
    def padded(self) -> U8:
        """Return ``rgb`` with a margin of `TAPS` pixels, which gives all that is inside its
        neighbours; made once for all views into which the frame is carried.
        """
        return np.asarray(
            cv2.copyMakeBorder(self.rgb, *(TAPS,) * 4, cv2.BORDER_REPLICATE), dtype=np.uint8
        )

    @cached_property
    def pixels_of_users(self) -> Bool:
        """Return ``users``, also where there are none."""
        return np.zeros(self.depth.shape, dtype=bool) if self.users is None else self.users


def warp(recorded: RecordedImage, target: WarpTarget) -> U8:
    """Carry a recorded frame into a view by the view's depth.

    A pixel's surface point is moved with the box it lies in, from where the actor is now to where
    it was when the frame was recorded, and looked up there, between pixels bicubically.

    Args:
        recorded: The recorded frame.
        target: The view.

    Returns:
        ``(H, W, 4)`` uint8: colour, and `VALID` where the recorded frame's own depth agrees with
        the point, `INCONSISTENT` where it does not (something stands in between, or one of the
        depths is wrong), 0 where the point lies outside of the recorded frame or belongs to an
        actor that was not there.
    """
    shape = target.depth.shape
    x = np.empty(shape, dtype=np.float32)
    y = np.empty(shape, dtype=np.float32)
    held = np.empty(shape, dtype=np.uint8)
    # A pixel p at depth z lies at z A p + b in the recorded frame's homogeneous pixels; A p is
    # linear along a row.
    project = recorded.K @ inverse(recorded.T_world_camera)[:3]
    A = project[:, :3] @ (target.T_world_camera[:3, :3] @ np.linalg.inv(target.K))
    b = project[:, :3] @ target.T_world_camera[:3, 3] + project[:, 3]
    depth = np.ascontiguousarray(target.depth)
    depth_then = np.ascontiguousarray(recorded.depth)
    ground = np.zeros(shape, dtype=bool) if target.ground is None else target.ground
    _coordinates(depth, ground, depth_then, recorded.pixels_of_users, A, b, x, y, held)
    names, boxes = target.placed
    absent = np.full((4, 4), np.nan)
    T_then_box = np.array([recorded.actors.get(name, absent) for name in names])
    to_then: F64 = project @ T_then_box.reshape(-1, 4, 4)
    visible = np.flatnonzero((boxes.pixels[:, ::2] < boxes.pixels[:, 1::2]).all(axis=1))
    for i in reversed(visible):  # of two boxes the first counts
        part = slice(*boxes.pixels[i, :2]), slice(*boxes.pixels[i, 2:])
        box = boxes.ray[i], boxes.eye[i], boxes.walls[i], to_then[i], boxes.pixels[i]
        images = x[part], y[part], held[part]
        _coordinates_on_box(depth[part], depth_then, *box, *images)
    # Places outside are far off, and black.
    rgb = cv2.remap(recorded.padded, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)
    out: U8 = cv2.insertChannel(held, cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA), 3)
    step = max(1, shape[1] // SEARCHED)
    coarse = slice(0, None, step)
    for other in recorded.others:
        hole = out[..., 3] == 0
        fills = warp(other, target.window(coarse, coarse))[..., 3] > 0
        places = np.argwhere(hole[coarse, coarse] & fills)
        if len(places):
            top, left = np.maximum(places.min(axis=0) - 1, 0) * step
            below, right = (places.max(axis=0) + 2) * step
            around = slice(top, below), slice(left, right)
            filling = warp(other, target.window(*around))
            cv2.copyTo(filling, hole[around].astype(np.uint8), out[around])  # in place
    return out


class PlacedBoxes(NamedTuple):
    """The A actors that have a box, as a camera sees them."""

    names: list[str]
    boxes: SeenBoxes


def place_boxes(
    shape: tuple[int, ...],
    K: F64,
    T_world_camera: F64,
    actors: Mapping[str, F64],
    boxes: Mapping[str, Box],
) -> PlacedBoxes:
    """Return the boxes of the actors present as a camera of ``shape`` rows and columns sees
    them.
    """
    names = [name for name in sorted(actors) if name in boxes]
    T_box_world = inverse(np.array([actors[name] for name in names]).reshape(-1, 4, 4))
    sizes = np.array([boxes[name].size_m for name in names]).reshape(-1, 3)
    T_box_camera = T_box_world @ T_world_camera
    walls = sizes[..., None, :] / 2 * np.array([[-1.0], [1.0]]) + np.array(
        [np.negative(AROUND_M), AROUND_M]
    )
    walls[..., 0, 2] = SOLE_M - sizes[..., 2] / 2
    # (A, 8, 3)
    corners = walls[:, [[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], [0, 1, 2]]
    project = K @ inverse(T_box_camera)[:, :3]
    projected = corners @ np.swapaxes(project[..., :3], 1, 2) + project[:, None, :, 3]
    behind = (projected[..., 2] <= 0).all(axis=1, keepdims=True)
    # Some corners lie behind the camera, and the box may reach anywhere
    around = (projected[..., 2] <= NEAREST_M).any(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        u_v = projected[..., :2] / projected[..., 2:]
    whole = np.array(shape[::-1])
    first = np.where(around, 0, np.clip(np.floor(u_v.min(axis=1)), 0, whole))
    last = np.where(behind, 0, np.where(around, whole, np.clip(np.ceil(u_v.max(axis=1)), 0, whole)))
    pixels = np.stack([first[:, 1], last[:, 1], first[:, 0], last[:, 0]], axis=1).astype(np.int64)
    ray = np.ascontiguousarray(T_box_camera[:, :3, :3] @ np.linalg.inv(K))
    seen_boxes = SeenBoxes(ray, np.ascontiguousarray(T_box_camera[:, :3, 3]), walls, pixels)
    return PlacedBoxes(names, seen_boxes)


@float_kernel
def _coordinates(depth, ground, depth_then, users, A, b, x, y, held):
    """Fill ``x``, ``y`` and ``held`` as if nothing moved."""
    height, width = depth.shape
    rows_then, columns_then = depth_then.shape
    surfaces, of_user = depth_then.reshape(-1), users.reshape(-1)
    place = np.empty(width, dtype=np.uint32)
    distance = np.empty(width, dtype=np.float64)
    is_inside = np.empty(width, dtype=np.bool_)
    for row in range(height):
        v0 = row + 0.5
        ax = A[0, 1] * v0 + A[0, 2]
        ay = A[1, 1] * v0 + A[1, 2]
        az = A[2, 1] * v0 + A[2, 2]
        for column in range(width):
            u0 = column + 0.5
            z = np.float64(depth[row, column])
            z = z if z > 0 else np.float64(INFINITY_M)
            rz = z * (A[2, 0] * u0 + az) + b[2]
            u = (z * (A[0, 0] * u0 + ax) + b[0]) / rz
            v = (z * (A[1, 0] * u0 + ay) + b[1]) / rz
            inside = (rz > NEAREST_M) & (u >= 0) & (u < columns_then) & (v >= 0) & (v < rows_then)
            u, v = u if inside else 0.5, v if inside else 0.5
            x[row, column] = np.float32(u + FIRST_PX) if inside else NOWHERE_PX
            y[row, column] = np.float32(v + FIRST_PX)
            place[column], distance[column], is_inside[column] = (
                np.uint32(np.int32(v) * columns_then + np.int32(u)),
                rz,
                inside,
            )
        for column in range(width):
            then = place[column]
            if not is_inside[column]:
                held[row, column] = 0
            elif ground[row, column] and of_user[then]:
                held[row, column] = INCONSISTENT
            else:
                free_share = FREE_SHARE if ground[row, column] else np.inf
                held[row, column] = _held(surfaces[then], distance[column], free_share)


@inlined_float_kernel
def _held(surface, rz, free_share):
    """Return how well it holds that a point at depth ``rz`` of the recorded camera is shown by its
    pixel of depth ``surface``.
    """
    recorded_m = np.float64(surface) if surface > 0 else INFINITY_M
    far = (recorded_m > INFINITY_M / 2) & (rz > INFINITY_M / 2)
    agrees = far | (recorded_m >= free_share * rz) | (abs(recorded_m - rz) < SLACK * rz + SLACK_M)
    return VALID if agrees else INCONSISTENT


@float_kernel
def _coordinates_on_box(depth, depth_then, ray, eye, walls, project, pixels, x, y, held):
    """Fill in what moves with one box in the part of the image that it may be seen in; see
    `SeenBoxes`.

    ``project`` maps the box's axes to the recorded frame's homogeneous pixels; it is not finite
    where the actor was absent.
    """
    rows_then, columns_then = depth_then.shape
    low, high = walls
    for row in range(depth.shape[0]):
        v0 = pixels[0] + row + 0.5
        for column in range(depth.shape[1]):
            u0, z = pixels[2] + column + 0.5, np.float64(depth[row, column])
            if not z > 0:
                continue
            px = z * (ray[0, 0] * u0 + ray[0, 1] * v0 + ray[0, 2]) + eye[0]
            py = z * (ray[1, 0] * u0 + ray[1, 1] * v0 + ray[1, 2]) + eye[1]
            pz = z * (ray[2, 0] * u0 + ray[2, 1] * v0 + ray[2, 2]) + eye[2]
            if not (low[0] < px < high[0] and low[1] < py < high[1] and low[2] <= pz < high[2]):
                continue
            x[row, column], held[row, column] = NOWHERE_PX, 0
            rz = project[2, 0] * px + project[2, 1] * py + project[2, 2] * pz + project[2, 3]
            if not rz > NEAREST_M:
                continue
            u = (project[0, 0] * px + project[0, 1] * py + project[0, 2] * pz + project[0, 3]) / rz
            v = (project[1, 0] * px + project[1, 1] * py + project[1, 2] * pz + project[1, 3]) / rz
            if 0 <= u < columns_then and 0 <= v < rows_then:
                x[row, column], y[row, column] = u + FIRST_PX, v + FIRST_PX
                held[row, column] = _held(depth_then[int(v), int(u)], rz, np.inf)


def on_boxes(shape: tuple[int, int], boxes: SeenBoxes) -> Bool:
    """Return the pixels of a camera of ``shape`` rows and columns whose ray meets a box."""
    out: Bool = np.zeros(shape, dtype=bool)
    for ray, eye, walls, pixels in zip(*boxes, strict=True):
        _add_box(ray, eye, walls, pixels, out[slice(*pixels[:2]), slice(*pixels[2:])])
    return out


class SeenBoxes(NamedTuple):
    """What moves with each of A boxes, and where a camera may see it."""

    ray: F64  # (A, 3, 3) maps a pixel (u, v, 1) to its ray in the box's axes
    eye: F64  # (A, 3) the camera in the box's axes
    walls: F64  # (A, 2, 3) least and greatest coordinates
    pixels: I64  # (A, 4) first row, last, first column, last; the last ones are not included


@float_kernel
def _add_box(ray, eye, walls, pixels, out):
    """Add the pixels that show one box to the part of an image that it may be seen in, by the slab
    method (Kay and Kajiya, 1986).
    """
    for row in range(out.shape[0]):
        v = pixels[0] + row + 0.5
        for column in range(out.shape[1]):
            u = pixels[2] + column + 0.5
            near = 0.0
            far = np.inf
            for axis in range(3):
                along = ray[axis, 0] * u + ray[axis, 1] * v + ray[axis, 2]
                along = along if along != 0.0 else PARALLEL
                a, b = (walls[0, axis] - eye[axis]) / along, (walls[1, axis] - eye[axis]) / along
                near, far = max(near, min(a, b)), min(far, max(a, b))
            out[row, column] |= near < far
