"""Carry a recorded frame into another view by that view's depth: a compiled kernel, and the plain arithmetic that it is held to."""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F32, F64, U8, Bool, Box
from alpasim_plugin.plugins.kernels import njit

INFINITY_M = 1e5  # how far a pixel without depth is: nothing moves by parallax there
NEAREST_M = 0.3  # a point that is nearer to the recorded camera, or behind it, is not in its picture
SLACK, SLACK_M = 0.12, 0.4  # two depths agree within this share and this length: reconstructions are no better
AROUND_M = (0.25, 0.25, 0.2)  # a point this far outside of a box still moves with it
SOLE_M = 0.05  # but not the ground below: a box's lowest layer of this height stays where it is
VALID, INCONSISTENT = 255, 128  # last channel of a reference: validity: the depths agree; they do not


@dataclass(frozen=True, eq=False)
class WarpTarget:
    """The view that references are warped into.

    Attributes:
        K: ``(3, 3)`` pixels.
        T_world_camera: ``(4, 4)``.
        depth: ``(H, W)`` metres along the optical axis; 0 where nothing is, which counts as infinitely far.
        actors: ``T_world_box`` of the actors present.
    """

    K: F64
    T_world_camera: F64
    depth: F32
    actors: Mapping[str, F64]


@dataclass(frozen=True, eq=False)
class Picture:
    """A recorded frame in memory: see `RecordedFrame`; ``users`` are the pixels of its road users ``(H, W)``, None where there are none."""

    K: F64
    T_world_camera: F64
    rgb: U8
    depth: F32
    actors: Mapping[str, F64]
    users: Bool | None = None


class Lookup(NamedTuple):
    """What says where the pixels of a view lie in a recorded frame.

    Attributes:
        depth: ``(H, W)`` of the view, metres; 0 is infinitely far.
        K, T_world_camera: Of the view.
        K_then, T_then_world: Of the recorded camera; the second maps the world to it.
        depth_then: ``(H', W')`` of the recorded frame.
        T_box_world: ``(A, 4, 4)`` the world to each actor's box, at the view's time.
        T_then_box: ``(A, 4, 4)`` each box to the world, when the frame was recorded; NaN where the actor was absent.
        sizes: ``(A, 3)`` length, width and height, metres.
        free_share: A recorded surface that is at least this share of a point's distance away does not hide the point. Infinite: only one
            that agrees with the point does not.
    """

    depth: F32
    K: F64
    T_world_camera: F64
    K_then: F64
    T_then_world: F64
    depth_then: F32
    T_box_world: F64
    T_then_box: F64
    sizes: F64
    free_share: float


def warp(picture: Picture, target: WarpTarget, boxes: Mapping[str, Box], free_share: float = np.inf) -> U8:
    """Carry a recorded frame into a view by the view's depth.

    A pixel's surface point is moved with the box it lies in, from where the actor is now to where it was when the frame was recorded, and
    looked up there, between pixels bicubically.

    Args:
        picture: The recorded frame.
        target: The view.
        boxes: Sizes of the actors.
        free_share: See `Lookup`.

    Returns:
        ``(H, W, 4)`` uint8: colour, and `VALID` where the recorded frame's own depth agrees with the point, `INCONSISTENT` where it does
        not (something stands in between, or one of the depths is wrong), 0 where the point lies outside of the recorded frame or belongs to
        an actor that was not there.
    """
    now, T_box_world, sizes = placed_boxes(target.actors, boxes)
    absent = np.full((4, 4), np.nan)
    T_then_box = np.array([picture.actors.get(name, absent) for name in now]).reshape(-1, 4, 4)
    T_then_world = inverse(picture.T_world_camera)
    lookup = Lookup(
        target.depth, target.K, target.T_world_camera, picture.K, T_then_world, picture.depth, T_box_world, T_then_box, sizes, free_share
    )
    x, y, held = warp_coordinates(lookup)
    out = np.empty((*held.shape, 4), np.uint8)
    out[..., :3] = cv2.remap(picture.rgb, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    out[..., 3] = held
    return out


def placed_boxes(actors: Mapping[str, F64], boxes: Mapping[str, Box]) -> tuple[list[str], F64, F64]:
    """Return names, ``T_box_world (A, 4, 4)`` and sizes ``(A, 3)`` of the actors that have a box."""
    now = [name for name in sorted(actors) if name in boxes]
    T_box_world = np.array([inverse(actors[name]) for name in now]).reshape(-1, 4, 4)
    return now, T_box_world, np.array([[boxes[n].length_m, boxes[n].width_m, boxes[n].height_m] for n in now]).reshape(-1, 3)


def warp_coordinates(lookup: Lookup) -> tuple[F32, F32, U8]:
    """Return where every pixel of a view is to be looked up in a recorded frame, and how well that holds.

    Returns:
        Column and row ``(H, W)``, counted from the centre of the first pixel, and `VALID`, `INCONSISTENT` or 0 ``(H, W)``.
    """
    depth, K, T_world_camera, K_then, T_then_world, depth_then, T_box_world, T_then_box, sizes, free_share = lookup
    height, width = depth.shape
    x, y, held = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8)
    # A pixel p at depth z lies at z A p + b in the recorded frame's homogeneous pixels; A p is linear along a row.
    ray = T_world_camera[:3, :3] @ np.linalg.inv(K)
    project = K_then @ T_then_world[:3]
    A, b = project[:, :3] @ ray, project[:, :3] @ T_world_camera[:3, 3] + project[:, 3]
    arrays = (
        np.ascontiguousarray(part, dtype=np.float64) for part in (A, b, ray, T_world_camera[:3, 3], project, T_box_world, T_then_box, sizes)
    )
    _coordinates(np.ascontiguousarray(depth), np.ascontiguousarray(depth_then), *arrays, free_share, x, y, held)
    return x, y, held


@njit(cache=True, nogil=True, error_model="numpy")
def _coordinates(depth, depth_then, A, b, ray, eye, project, T_box, T_then_box, sizes, free_share, x, y, held):
    """Fill ``x``, ``y`` and ``held``; the loop of `plain_coordinates`."""
    height, width = depth.shape
    rows_then, columns_then = depth_then.shape
    actors = sizes.shape[0]
    for row in range(height):
        v0 = row + 0.5
        for column in range(width):
            u0 = column + 0.5
            z = np.float64(depth[row, column]) if depth[row, column] > 0 else np.float64(INFINITY_M)
            qx = z * (A[0, 0] * u0 + A[0, 1] * v0 + A[0, 2]) + b[0]
            qy = z * (A[1, 0] * u0 + A[1, 1] * v0 + A[1, 2]) + b[1]
            rz = z * (A[2, 0] * u0 + A[2, 1] * v0 + A[2, 2]) + b[2]
            if actors and z < INFINITY_M:
                px = z * (ray[0, 0] * u0 + ray[0, 1] * v0 + ray[0, 2]) + eye[0]
                py = z * (ray[1, 0] * u0 + ray[1, 1] * v0 + ray[1, 2]) + eye[1]
                pz = z * (ray[2, 0] * u0 + ray[2, 1] * v0 + ray[2, 2]) + eye[2]
                a = _box_around(px, py, pz, T_box, sizes)
                if a >= 0:
                    W, B = T_then_box[a], T_box[a]
                    if not np.isfinite(W[0, 0]):
                        continue
                    bx = B[0, 0] * px + B[0, 1] * py + B[0, 2] * pz + B[0, 3]
                    by = B[1, 0] * px + B[1, 1] * py + B[1, 2] * pz + B[1, 3]
                    bz = B[2, 0] * px + B[2, 1] * py + B[2, 2] * pz + B[2, 3]
                    px = W[0, 0] * bx + W[0, 1] * by + W[0, 2] * bz + W[0, 3]
                    py = W[1, 0] * bx + W[1, 1] * by + W[1, 2] * bz + W[1, 3]
                    pz = W[2, 0] * bx + W[2, 1] * by + W[2, 2] * bz + W[2, 3]
                    qx = project[0, 0] * px + project[0, 1] * py + project[0, 2] * pz + project[0, 3]
                    qy = project[1, 0] * px + project[1, 1] * py + project[1, 2] * pz + project[1, 3]
                    rz = project[2, 0] * px + project[2, 1] * py + project[2, 2] * pz + project[2, 3]
            if not rz > NEAREST_M:
                continue
            u, v = qx / rz, qy / rz
            if not (0 <= u < columns_then and 0 <= v < rows_then):
                continue
            x[row, column], y[row, column] = u - 0.5, v - 0.5
            there = np.float64(depth_then[int(v), int(u)])
            there = there if there > 0 else np.float64(INFINITY_M)
            far = there > INFINITY_M / 2 and rz > INFINITY_M / 2
            agrees = far or there >= free_share * rz or abs(there - rz) < SLACK * rz + SLACK_M
            held[row, column] = VALID if agrees else INCONSISTENT


@njit(cache=True, nogil=True, error_model="numpy")
def _box_around(px, py, pz, T_box, sizes):
    """Return the first box that a point of the world lies in; -1: none."""
    for a in range(sizes.shape[0]):
        B = T_box[a]
        qz = B[2, 0] * px + B[2, 1] * py + B[2, 2] * pz + B[2, 3]
        if not -sizes[a, 2] / 2 + SOLE_M <= qz < sizes[a, 2] / 2 + AROUND_M[2]:
            continue
        qx = B[0, 0] * px + B[0, 1] * py + B[0, 2] * pz + B[0, 3]
        qy = B[1, 0] * px + B[1, 1] * py + B[1, 2] * pz + B[1, 3]
        if abs(qx) < sizes[a, 0] / 2 + AROUND_M[0] and abs(qy) < sizes[a, 1] / 2 + AROUND_M[1]:
            return a
    return -1


def on_boxes(shape: tuple[int, int], K: F64, T_world_camera: F64, actors: Mapping[str, F64], boxes: Mapping[str, Box]) -> Bool:
    """Return the pixels of a camera ``shape`` whose ray meets an actor's box.

    Args:
        shape: Rows and columns.
        K, T_world_camera: Of the camera.
        actors: ``T_world_box`` of the actors present.
        boxes: Their sizes.
    """
    _, T_box_world, sizes = placed_boxes(actors, boxes)
    out: Bool = np.zeros(shape, dtype=bool)
    for T_box_camera, size in zip(T_box_world @ T_world_camera, sizes, strict=True):
        low, high = _walls(size)
        corners = _moved(K @ inverse(T_box_camera)[:3], np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3))
        if (corners[:, 2] <= 0).all():
            continue
        first, last = np.zeros(2, dtype=np.int64), np.array(shape[::-1])
        if (corners[:, 2] > NEAREST_M).all():  # else some corners lie behind the camera, and the box may reach anywhere
            u_v = corners[:, :2] / corners[:, 2:]
            first, last = (np.clip(edge, 0, last).astype(np.int64) for edge in (np.floor(u_v.min(axis=0)), np.ceil(u_v.max(axis=0))))
        part = out[first[1] : last[1], first[0] : last[0]]
        ray = np.ascontiguousarray(T_box_camera[:3, :3] @ np.linalg.inv(K))
        _add_box(ray, T_box_camera[:3, 3].copy(), low, high, first[0], first[1], part)
    return out


def _walls(size: F64) -> tuple[F64, F64]:
    """Return the least and the greatest coordinates of what moves with a box."""
    around, up = size / 2 + np.array(AROUND_M), size[2] / 2
    return np.array([-around[0], -around[1], SOLE_M - up]), around


@njit(cache=True, nogil=True, error_model="numpy")
def _add_box(ray, eye, low, high, left, top, out):
    """Add the pixels that show one box to a part of a picture that begins at (left, top), by the slab method (Kay and Kajiya, 1986).

    ``ray`` and ``eye`` are in the box's axes.
    """
    for row in range(out.shape[0]):
        v = top + row + 0.5
        for column in range(out.shape[1]):
            u, near, far = left + column + 0.5, 0.0, np.inf
            for axis in range(3):
                along = ray[axis, 0] * u + ray[axis, 1] * v + ray[axis, 2]
                if along == 0.0:
                    if not low[axis] < eye[axis] < high[axis]:
                        far = -1.0
                    continue
                a, b = (low[axis] - eye[axis]) / along, (high[axis] - eye[axis]) / along
                near, far = max(near, min(a, b)), min(far, max(a, b))
            if near < far:
                out[row, column] = True


def plain_on_boxes(shape: tuple[int, int], K: F64, T_world_camera: F64, actors: Mapping[str, F64], boxes: Mapping[str, Box]) -> Bool:
    """Return the same as `on_boxes`, array by array: the reference of its kernel."""
    rays = plain_points(np.ones(shape), K, T_world_camera) - T_world_camera[:3, 3]
    out: Bool = np.zeros(shape, dtype=bool)
    _, T_box_world, sizes = placed_boxes(actors, boxes)
    for T_box, size in zip(T_box_world, sizes, strict=True):
        with np.errstate(divide="ignore"):
            hits = (np.stack(_walls(size)) - _moved(T_box, T_world_camera[:3, 3]))[:, None, None] / (rays @ T_box[:3, :3].T)
        out |= np.maximum(hits.min(axis=0).max(axis=-1), 0) < hits.max(axis=0).min(axis=-1)
    return out


def plain_coordinates(lookup: Lookup) -> tuple[F32, F32, U8]:
    """Return the same as `warp_coordinates`, array by array: the reference of its kernel."""
    depth, K, T_world_camera, K_then, T_then_world, depth_then, T_box_world, T_then_box, sizes, free_share = lookup
    height, width = depth.shape
    points = plain_points(np.where(depth > 0, depth, INFINITY_M), K, T_world_camera)
    out, there, free = points.copy(), np.ones((height, width), dtype=bool), np.ones((height, width), dtype=bool)
    for T_box, T_then, size in zip(T_box_world, T_then_box, sizes, strict=True):
        q = _moved(T_box, points)
        low, high = _walls(size)
        inside = free & (np.abs(q[..., :2]) < high[:2]).all(-1) & (q[..., 2] >= low[2]) & (q[..., 2] < high[2])
        out[inside] = _moved(T_then, q[inside])
        there[inside] = bool(np.isfinite(T_then).all())
        free &= ~inside
    local = _moved(T_then_world, out)
    rz = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = local[..., 0] / rz * K_then[0, 0] + K_then[0, 2]
        y = local[..., 1] / rz * K_then[1, 1] + K_then[1, 2]
        rows, columns = depth_then.shape
        seen = there & (rz > NEAREST_M) & (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    at = depth_then[np.where(seen, y, 0).astype(int), np.where(seen, x, 0).astype(int)]
    then = np.where(at > 0, at, INFINITY_M)
    far = (then > INFINITY_M / 2) & (rz > INFINITY_M / 2)
    agrees = far | (then >= free_share * rz) | (np.abs(then - rz) < SLACK * rz + SLACK_M)
    held = np.where(seen, np.where(agrees, VALID, INCONSISTENT), 0).astype(np.uint8)
    return np.where(seen, x - 0.5, 0).astype(np.float32), np.where(seen, y - 0.5, 0).astype(np.float32), held


def plain_points(depth: F64 | F32, K: F64, T_world_camera: F64) -> F64:
    """Return the points of the world ``(H, W, 3)`` that pixels show at a depth ``(H, W)``."""
    height, width = depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    z = depth.astype(np.float64)
    return _moved(T_world_camera, np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=-1))


def _moved(T: F64, points: F64) -> F64:
    """Map points ``(..., 3)`` by ``T (4, 4)``."""
    moved: F64 = points @ T[:3, :3].T + T[:3, 3]
    return moved
