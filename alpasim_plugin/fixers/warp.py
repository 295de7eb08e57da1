"""Carry a recorded frame into another view by that view's depth."""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np

from alpasim_plugin.cameras.image_map_kernel import lens_pixel, map_numbers
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.kernels import float_kernel, inlined_float_kernel
from alpasim_plugin.core.types import F32, F64, I64, U8, Bool, Box, CameraSpec
from alpasim_plugin.gaussians.lens_camera import lens_map, lens_rays

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
SAMPLED_PX = 8  # between the rays of a lens that are tested for whether a box can be seen
# Validity, the last channel of a reference: the depths agree, or do not; 0 elsewhere.
VALID = 255
INCONSISTENT = 128


@dataclass(frozen=True, eq=False)
class WarpTarget:
    """The view that references are warped into.

    Attributes:
        K: ``(3, 3)`` pixels; of a lens those on its axis.
        T_world_camera: ``(4, 4)``.
        depth: ``(H, W)`` metres along the optical axis, through a lens along `rays`; 0 where nothing
            is, which counts as infinitely far.
        actors: ``T_world_box`` of the actors present.
        boxes: Sizes of actors; one that has none counts as absent.
        ground: ``(H, W)`` which depths are the ground's; None: none is.
        rays: ``(H, W, 3)`` of unit length, in the camera's axes, what each pixel of a lens sees;
            None: the view is the pinhole ``K``.
        rays_on_device: ``(3, H, W)`` the same beside a depth that is on a device.
    """

    K: F64
    T_world_camera: F64
    depth: F32
    actors: Mapping[str, F64]
    boxes: Mapping[str, Box]
    ground: Bool | None = None
    rays: F64 | None = None
    rays_on_device: Any = None

    def window(self, rows: slice, columns: slice) -> WarpTarget:
        """Return a part of the view, all its pixels or, as the slices' step says, some."""
        K, step = self.K.copy(), columns.step or 1
        K[:2, 2] += (step - 1) / 2 - np.array([columns.start, rows.start])
        K[:2] /= step
        depth = np.ascontiguousarray(self.depth[rows, columns])
        ground = None if self.ground is None else np.ascontiguousarray(self.ground[rows, columns])
        rays = None if self.rays is None else np.ascontiguousarray(self.rays[rows, columns])
        return replace(self, K=K, depth=depth, ground=ground, rays=rays)

    @cached_property
    def pixels_of_ground(self) -> Bool:
        """Return ``ground``, also where there is none."""
        return np.zeros(self.depth.shape, dtype=bool) if self.ground is None else self.ground

    @cached_property
    def placed(self) -> PlacedBoxes:
        """The boxes of the actors present, as the view sees them; found once for all recorded
        frames that are carried into it.
        """
        if self.rays is not None:
            return boxes_on_rays(self.rays, self.T_world_camera, self.actors, self.boxes)
        return place_boxes(self.depth.shape, self.K, self.T_world_camera, self.actors, self.boxes)

    @cached_property
    def sights(self) -> tuple[F64, F64]:
        """Return what the pixels see ``(H, W, 3)``, and the matrix ``(3, 3)`` that turns it to the
        camera's point at depth 1: of a pinhole pixels (u, v, 1).
        """
        if self.rays is not None:
            return np.ascontiguousarray(self.rays), np.eye(3)
        height, width = self.depth.shape
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        return np.stack([u, v, np.ones_like(u)], axis=-1), np.asarray(np.linalg.inv(self.K))


@dataclass(frozen=True, eq=False)
class RecordedLens:
    """The lens of a recorded frame.

    Attributes:
        numbers: See `image_map_kernel.map_numbers`.
        rays: See `WarpTarget`.
        visible: ``(H, W)`` pixels around which the lens sees something, as far as `TAPS`.
    """

    numbers: F64
    rays: F64
    visible: Bool


def recorded_lens(camera: CameraSpec) -> RecordedLens | None:
    """Return the lens of a camera that recorded a frame; None where it has none."""
    if camera.lens is None:
        return None
    rays = lens_rays(camera)
    shape = camera.height, camera.width
    mask = rays.visible.reshape(shape).astype(np.uint8)
    side = 2 * TAPS + 1
    visible = cv2.erode(mask, np.ones((side, side), dtype=np.uint8)) > 0
    return RecordedLens(map_numbers(lens_map(camera)), rays.ray.reshape(*shape, 3), visible)


@dataclass(frozen=True, eq=False)
class RecordedImage:
    """A recorded frame in memory.

    Attributes:
        K, T_world_camera, rgb, depth, actors: See `RecordedFrame`. Depth is along the optical axis,
            through a lens from the camera's centre.
        users: The pixels of its road users ``(H, W)``; None where there are none.
        others: The frames of the other pinholes of its lens, of the same instant; they fill in what
            lies outside of this one.
        lens: Its lens; None: the pinhole ``K``.
    """

    K: F64
    T_world_camera: F64
    rgb: U8
    depth: F32
    actors: Mapping[str, F64]
    users: Bool | None = None
    others: tuple[RecordedImage, ...] = ()
    lens: RecordedLens | None = None

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
    if target.rays is None and recorded.lens is None:
        _place_in_pinhole(recorded, target, x, y, held)
    else:
        _place_along_rays(recorded, target, x, y, held)
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


def _place_in_pinhole(
    recorded: RecordedImage, target: WarpTarget, x: F32, y: F32, held: U8
) -> None:
    """Fill in where a pinhole that recorded a frame shows what a pinhole sees, and how well that
    holds, ``(H, W)`` each.
    """
    # A pixel p at depth z lies at z A p + b in the recorded frame's homogeneous pixels; A p is
    # linear along a row.
    project = recorded.K @ inverse(recorded.T_world_camera)[:3]
    A = project[:, :3] @ (target.T_world_camera[:3, :3] @ np.linalg.inv(target.K))
    b = project[:, :3] @ target.T_world_camera[:3, 3] + project[:, 3]
    depth = np.ascontiguousarray(target.depth)
    depth_then = np.ascontiguousarray(recorded.depth)
    ground = target.pixels_of_ground
    _coordinates(depth, ground, depth_then, recorded.pixels_of_users, A, b, x, y, held)
    boxes = target.placed.boxes
    to_then: F64 = project @ _boxes_then(recorded, target)
    for i in reversed(boxes.visible):  # of two boxes the first counts
        part = boxes.window(i)
        box = boxes.ray[i], boxes.eye[i], boxes.walls[i], to_then[i], boxes.pixels[i]
        images = x[part], y[part], held[part]
        _coordinates_on_box(depth[part], depth_then, *box, *images)


def _place_along_rays(
    recorded: RecordedImage, target: WarpTarget, x: F32, y: F32, held: U8
) -> None:
    """Fill in the same where either of the two has a lens."""
    sights, lift = target.sights
    T_then_world = inverse(recorded.T_world_camera)[:3]
    T_then_camera = T_then_world @ target.T_world_camera
    to_then = np.column_stack([T_then_camera[:, :3] @ lift, T_then_camera[:, 3]])
    depth = np.ascontiguousarray(target.depth)
    depth_then = np.ascontiguousarray(recorded.depth)
    lens = recorded.lens
    visible = np.ones((1, 1), dtype=bool) if lens is None else lens.visible
    camera_then = recorded.K, np.empty(0) if lens is None else lens.numbers, visible
    users = recorded.pixels_of_users
    images = x, y, held
    view = sights, depth, target.pixels_of_ground
    _coordinates_along_rays(*view, depth_then, users, to_then, *camera_then, *images)
    boxes = target.placed.boxes
    box_to_then: F64 = T_then_world @ _boxes_then(recorded, target)
    for i in reversed(boxes.visible):
        part = boxes.window(i)
        box = boxes.ray[i], boxes.eye[i], boxes.walls[i], box_to_then[i]
        view_part = sights[part], depth[part], depth_then
        _coordinates_on_box_along_rays(*view_part, *box, *camera_then, *(p[part] for p in images))


def _boxes_then(recorded: RecordedImage, target: WarpTarget) -> F64:
    """Return where the boxes of a view's actors were when a frame was recorded ``(A, 4, 4)``; NaN of
    those that were not there.
    """
    absent = np.full((4, 4), np.nan)
    T_then_box = [recorded.actors.get(name, absent) for name in target.placed.names]
    return np.array(T_then_box).reshape(-1, 4, 4)


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
    names, T_box_camera, walls = _box_walls(T_world_camera, actors, boxes)
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


def boxes_on_rays(
    rays: F64, T_world_camera: F64, actors: Mapping[str, F64], boxes: Mapping[str, Box]
) -> PlacedBoxes:
    """Return the boxes of the actors present as a camera sees them that sees unit ``rays``
    ``(H, W, 3)``, in its axes: within the cone around each box's sphere.
    """
    names, T_box_camera, walls = _box_walls(T_world_camera, actors, boxes)
    T_camera_box = inverse(T_box_camera)
    middles = np.einsum("aij,aj->ai", T_camera_box[:, :3, :3], walls.mean(axis=1))
    middles += T_camera_box[:, :3, 3]
    distance = np.linalg.norm(middles, axis=1)
    radius = np.linalg.norm(walls[:, 1] - walls[:, 0], axis=1) / 2
    cone = np.where(
        distance > radius, np.arcsin(np.minimum(radius / np.maximum(distance, 1e-9), 1)), np.pi
    )
    rows, columns = (np.append(np.arange(0, n - 1, SAMPLED_PX), n - 1) for n in rays.shape[:2])
    sampled = rays[np.ix_(rows, columns)]
    steps = [np.linalg.norm(np.diff(sampled, axis=axis), axis=2).max(initial=0) for axis in (0, 1)]
    # The rays of a square between samples are within so much of those at its corners.
    between = 2 * float(np.arcsin(min(sum(steps) / 2, 1.0)))
    pixels = np.zeros((len(names), 4), dtype=np.int64)
    for i, reach in enumerate(np.minimum(cone + between, np.pi)):
        is_near = sampled @ (middles[i] / max(distance[i], 1e-9)) >= np.cos(reach) - 1e-12
        if is_near.any():
            near_rows = rows[is_near.any(axis=1)]
            near_columns = columns[is_near.any(axis=0)]
            pixels[i] = near_rows[0], near_rows[-1] + 1, near_columns[0], near_columns[-1] + 1
    eye = np.ascontiguousarray(T_box_camera[:, :3, 3])
    seen_boxes = SeenBoxes(np.ascontiguousarray(T_box_camera[:, :3, :3]), eye, walls, pixels)
    return PlacedBoxes(names, seen_boxes)


def _box_walls(
    T_world_camera: F64, actors: Mapping[str, F64], boxes: Mapping[str, Box]
) -> tuple[list[str], F64, F64]:
    """Return the names of the A actors that have a box, ``T_box_camera (A, 4, 4)`` and the least and
    greatest coordinates ``(A, 2, 3)`` of what moves with each.
    """
    names = [name for name in sorted(actors) if name in boxes]
    T_box_world = inverse(np.array([actors[name] for name in names]).reshape(-1, 4, 4))
    sizes = np.array([boxes[name].size_m for name in names]).reshape(-1, 3)
    walls = sizes[..., None, :] / 2 * np.array([[-1.0], [1.0]]) + np.array(
        [np.negative(AROUND_M), AROUND_M]
    )
    walls[..., 0, 2] = SOLE_M - sizes[..., 2] / 2
    return names, T_box_world @ T_world_camera, walls


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


@float_kernel
def _coordinates_along_rays(
    sights, depth, ground, depth_then, users, to_then, K, lens, visible, x, y, held
):
    """Fill ``x``, ``y`` and ``held`` as if nothing moved; ``to_then`` maps what a pixel sees, times
    its depth, to the axes of the recorded camera.
    """
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = np.float64(depth[row, column])
            z = z if z > 0 else np.float64(INFINITY_M)
            sight = sights[row, column]
            px, py, pz = _moved(to_then, z * sight[0], z * sight[1], z * sight[2])
            u, v, surface_m = _seen_then(K, lens, px, py, pz)
            is_inside = _is_inside(u, v, surface_m, depth_then, visible)
            x[row, column] = np.float32(u + FIRST_PX) if is_inside else NOWHERE_PX
            y[row, column] = np.float32(v + FIRST_PX) if is_inside else np.float32(0.0)
            if not is_inside:
                held[row, column] = 0
            elif ground[row, column] and users[int(v), int(u)]:
                held[row, column] = INCONSISTENT
            else:
                free_share = FREE_SHARE if ground[row, column] else np.inf
                held[row, column] = _held(depth_then[int(v), int(u)], surface_m, free_share)


@float_kernel
def _moved(T, x, y, z):
    """Return a point moved by a transform ``(3, 4)``."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@float_kernel
def _seen_then(K, lens, x, y, z):
    """Return the pixel (u, v) at which a recorded camera shows a point in its axes, and the point's
    depth as its frames have it.
    """
    if len(lens) > 0:
        u, v = lens_pixel(lens, x, y, z)
        return u, v, math.sqrt(x * x + y * y + z * z)
    return (K[0, 0] * x + K[0, 1] * y) / z + K[0, 2], K[1, 1] * y / z + K[1, 2], z


@float_kernel
def _is_inside(u, v, surface_m, depth_then, visible):
    """Return whether a recorded frame shows its pixel (u, v); ``visible`` of a single element is
    that of a pinhole, which shows all of them.
    """
    height, width = depth_then.shape
    if not (surface_m > NEAREST_M and u >= 0 and u < width and v >= 0 and v < height):
        return False
    return visible.size == 1 or visible[int(v), int(u)]


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


@float_kernel
def _coordinates_on_box_along_rays(
    sights, depth, depth_then, ray, eye, walls, to_then, K, lens, visible, x, y, held
):
    """Fill in what moves with one box, as `_coordinates_on_box`; ``to_then`` maps the box's axes to
    those of the recorded camera.
    """
    low, high = walls
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = np.float64(depth[row, column])
            if not z > 0:
                continue
            a, b, c = sights[row, column]
            px = z * (ray[0, 0] * a + ray[0, 1] * b + ray[0, 2] * c) + eye[0]
            py = z * (ray[1, 0] * a + ray[1, 1] * b + ray[1, 2] * c) + eye[1]
            pz = z * (ray[2, 0] * a + ray[2, 1] * b + ray[2, 2] * c) + eye[2]
            if not (low[0] < px < high[0] and low[1] < py < high[1] and low[2] <= pz < high[2]):
                continue
            x[row, column], held[row, column] = NOWHERE_PX, 0
            tx, ty, tz = _moved(to_then, px, py, pz)
            u, v, surface_m = _seen_then(K, lens, tx, ty, tz)
            if _is_inside(u, v, surface_m, depth_then, visible):
                x[row, column], y[row, column] = u + FIRST_PX, v + FIRST_PX
                held[row, column] = _held(depth_then[int(v), int(u)], surface_m, np.inf)


def on_boxes(shape: tuple[int, int], boxes: SeenBoxes, rays: F64 | None = None) -> Bool:
    """Return the pixels of a camera of ``shape`` rows and columns whose ray meets a box; ``rays`` are
    those of its lens, as of `WarpTarget`.
    """
    out: Bool = np.zeros(shape, dtype=bool)
    for i, (ray, eye, walls, pixels) in enumerate(zip(*boxes, strict=True)):
        part = boxes.window(i)
        if rays is None:
            _add_box(ray, eye, walls, pixels, out[part])
        else:
            _add_box_on_rays(rays[part], ray, eye, walls, out[part])
    return out


class SeenBoxes(NamedTuple):
    """What moves with each of A boxes, and where a camera may see it."""

    ray: F64  # (A, 3, 3) maps a pixel (u, v, 1) to its ray in the box's axes
    eye: F64  # (A, 3) the camera in the box's axes
    walls: F64  # (A, 2, 3) least and greatest coordinates
    pixels: I64  # (A, 4) first row, last, first column, last; the last ones are not included

    @property
    def visible(self) -> I64:
        """Return the numbers of the boxes that the image may show."""
        return np.flatnonzero((self.pixels[:, ::2] < self.pixels[:, 1::2]).all(axis=1))

    def window(self, i: int) -> tuple[slice, slice]:
        """Return the rows and columns in which a box may be seen."""
        return slice(*self.pixels[i, :2]), slice(*self.pixels[i, 2:])


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


@float_kernel
def _add_box_on_rays(rays, ray, eye, walls, out):
    """Add the pixels that show one box, as `_add_box`, to a part of a lens's image."""
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            x, y, z = rays[row, column]
            near = 0.0
            far = np.inf
            for axis in range(3):
                along = ray[axis, 0] * x + ray[axis, 1] * y + ray[axis, 2] * z
                along = along if along != 0.0 else PARALLEL
                a, b = (walls[0, axis] - eye[axis]) / along, (walls[1, axis] - eye[axis]) / along
                near, far = max(near, min(a, b)), min(far, max(a, b))
            out[row, column] |= near < far
