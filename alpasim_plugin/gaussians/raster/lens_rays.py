"""The rays of a lens and the numbers of a camera with one, as the CPU kernels read them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from alpasim_plugin.cameras.lens import radial_form
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F32, F64, CameraSpec, FloatArray
from alpasim_plugin.gaussians.camera import Rolling
from alpasim_plugin.gaussians.constants import TILE
from alpasim_plugin.gaussians.lens_camera import (
    LensCamera,
    LensKey,
    lens_key,
    lens_map,
    lens_rays,
    spec_of,
)

# Columns of a camera's numbers, float64.
LENS_MIDDLE = 0
LENS_WIDTH, LENS_HEIGHT = 2, 3
LENS_COS, LENS_SIN = 4, 5  # of the widest angle in the image
LENS_S_MOST = 6
LENS_LEAST, LENS_MOST = 7, 8  # pixels per radian
LENS_MARGIN = 9  # pixels by which every box is grown
LENS_LINEAR = 10
LENS_BENDS = 14  # whether there are tangential terms: the six after it
LENS_ROLLS = 21
LENS_SMALL = 31  # by how much an ellipse may miss a small Gaussian: see `lens_small_kernels`
LENS_TIME = 22  # of a pixel: a, b, c of `Rolling.time`
LENS_TURN = 25  # the camera's own motion in a shutter, in its axes at the middle
LENS_SHIFT = 28
LENS_G = 32
LENS_BEND = 47  # of a lens's image, radians a radian
LENS_SLOPE = 48
LENS_SIZE = 64
KEPT_NUMBERS = 4096  # lenses whose numbers stay: 2 MB
# A square of pixels: their rays' mean, its change to the right and down, and what these two miss.
BLOCK_ROWS = 10
MARGIN_PX = 0.02
# By how much an ellipse of the image may miss a Gaussian, see `lens_small_kernels.is_small`: a level of
# 255. Where the form of a lens misses it by more than so many pixels, no ellipses are drawn.
MISSED = 1 / (255 * 1.16)
EXACT_PX = 5e-3
# How a moving node differs from the standing world: rotation vector, velocity and centre, by the
# shutter, then how much its turning changes a ray's direction and start at most.
MOTION_TURN, MOTION_SPEED, MOTION_CENTRE, MOTION_BOUND_D, MOTION_BOUND_O = 0, 3, 6, 9, 10
MOTION = 11


@dataclass(frozen=True, eq=False)
class TileRays:
    """What the pixels of a lens see, in the order of the kernels: by tile, block of 4 x 4 pixels,
    axis, pixel.

    Attributes:
        rays: float32, 3 x 16 numbers a block.
        alive: float32, 16 numbers a block: 1 where the lens sees anything, else -1.
        blocks: float32, `BLOCK_ROWS` x 16 numbers a tile: of its sixteen blocks.
        tiles: float32, as many for each sixteen tiles side by side: of these tiles.
    """

    rays: F32
    alive: F32
    blocks: F32
    tiles: F32


_of_cameras: WeakKeyDictionary[LensCamera, TileRays] = WeakKeyDictionary()


def tile_rays(camera: LensCamera) -> TileRays:
    """Return the rays of a camera's lens, kept as long as the camera, which a fit needs whose photographs
    have a lens each, and for the next camera with that lens.
    """
    table = _of_cameras.get(camera)
    if table is None:
        table = _of_cameras[camera] = _tile_rays(lens_key(camera.spec))
    return table


@lru_cache(maxsize=8)
def _tile_rays(key: LensKey) -> TileRays:
    spec = spec_of(key)
    pixel_rays = lens_rays(spec)
    height = spec.height
    width = spec.width
    rows = -(-height // TILE)
    columns = -(-width // TILE)
    pad = ((0, rows * TILE - height), (0, columns * TILE - width))
    alive = np.where(pixel_rays.visible, 1.0, -1.0).astype(np.float32).reshape(height, width)
    alive = np.pad(alive, pad, constant_values=-1.0)
    rays = pixel_rays.ray.astype(np.float32).reshape(height, width, 3)
    rays = np.pad(rays, (*pad, (0, 0)), mode="edge")
    blocked = rays.reshape(rows, 4, 4, columns, 4, 4, 3).transpose(0, 3, 1, 4, 2, 5, 6)
    blocked = blocked.reshape(rows * columns, 16, 4, 4, 3)
    return TileRays(
        np.ascontiguousarray(blocked.transpose(0, 1, 4, 2, 3)).reshape(-1),
        np.ascontiguousarray(
            alive.reshape(rows, 4, 4, columns, 4, 4).transpose(0, 3, 1, 4, 2, 5)
        ).reshape(-1),
        _square_table(blocked),
        _tile_table(rays),
    )


def _square_table(rays: F32) -> F32:
    """Return by sixteen squares ``(N, 16, side, side, 3)`` the bilinear part of their rays: mean,
    change to the right, change down, each x, y, z, and the greatest distance from it.
    """
    side = rays.shape[2]
    steps = np.linspace(-1, 1, side, dtype=np.float32)
    corners = rays[:, :, :: side - 1, :: side - 1]
    mean = corners.mean(axis=(2, 3))
    right = (corners[:, :, :, 1] - corners[:, :, :, 0]).mean(axis=2) / 2
    down = (corners[:, :, 1] - corners[:, :, 0]).mean(axis=2) / 2
    flat = (
        mean[:, :, None, None]
        + steps[None, None, None, :, None] * right[:, :, None, None]
        + steps[None, None, :, None, None] * down[:, :, None, None]
    )
    missed = np.sqrt(((rays - flat) ** 2).sum(axis=-1)).max(axis=(2, 3))
    parts = [*(part.transpose(0, 2, 1) for part in (mean, right, down)), missed[:, None]]
    return np.ascontiguousarray(np.concatenate(parts, axis=1), dtype=np.float32).reshape(-1)


def _tile_table(rays: F32) -> F32:
    """Return `_square_table` of the tiles of rays ``(H, W, 3)``, those of a row sixteen by sixteen."""
    rows = rays.shape[0] // TILE
    columns = rays.shape[1] // TILE
    tiles = rays.reshape(rows, TILE, columns, TILE, 3).transpose(0, 2, 1, 3, 4)
    tiles = np.pad(tiles, ((0, 0), (0, -columns % 16), (0, 0), (0, 0), (0, 0)), mode="edge")
    return _square_table(tiles.reshape(-1, 16, TILE, TILE, 3))


@lru_cache(maxsize=KEPT_NUMBERS)
def _lens_numbers(key: LensKey) -> F64:
    """Return the numbers ``(LENS_SIZE,)`` of a lens with a global shutter."""
    spec = spec_of(key)
    mapped = lens_map(spec)
    numbers = np.zeros(LENS_SIZE)
    numbers[LENS_MIDDLE : LENS_MIDDLE + 2] = mapped.middle
    numbers[LENS_WIDTH], numbers[LENS_HEIGHT] = spec.width, spec.height
    numbers[LENS_COS], numbers[LENS_SIN] = np.cos(mapped.widest_rad), np.sin(mapped.widest_rad)
    numbers[LENS_S_MOST] = mapped.s_most
    numbers[LENS_LEAST], numbers[LENS_MOST] = mapped.px_per_rad
    numbers[LENS_SMALL] = MISSED if mapped.error_px <= EXACT_PX else 0.0
    numbers[LENS_MARGIN] = MARGIN_PX + mapped.error_px
    numbers[LENS_LINEAR : LENS_LINEAR + 4] = mapped.linear.ravel()
    numbers[LENS_BEND] = _bend(spec, mapped.widest_rad)
    numbers[LENS_BENDS] = any(mapped.bent)
    numbers[LENS_BENDS + 1 : LENS_BENDS + 7] = mapped.bent
    polynomial = mapped.polynomial
    slope = np.polynomial.polynomial.polyder(polynomial) * (2 / mapped.s_most)
    numbers[LENS_G : LENS_G + len(polynomial)] = polynomial
    numbers[LENS_SLOPE : LENS_SLOPE + len(slope)] = slope
    numbers.flags.writeable = False
    return numbers


def _bend(spec: CameraSpec, widest_rad: float) -> float:
    """Return by how much a step of one radian across the line of sight is shown beside where the
    slopes of the lens put it, radians: half of its second derivative, the largest in the image.
    """
    form = radial_form(spec)
    angle = np.linspace(0.02, widest_rad, 32)[:, None]
    turn = np.linspace(0, np.pi, 8, endpoint=False)
    step = 0.01

    def shown(x: F64, y: F64) -> F64:
        """Return where the lens shows directions beside those at the angles, without its scale."""
        ray_x = np.sin(angle) + x * np.cos(angle)
        ray_z = np.cos(angle) - x * np.sin(angle)
        across = np.hypot(ray_x, y)
        polar = np.arctan2(across, ray_z)
        radius = form.radius(polar.ravel()).reshape(polar.shape) / across
        return np.stack([ray_x * radius, np.broadcast_to(y * radius, radius.shape)], axis=-1)

    zero = np.zeros(1)
    x, y = step * np.cos(turn), step * np.sin(turn)
    bend = (shown(x, y) + shown(-x, -y)) / 2 - shown(zero, zero)
    slope_x = (shown(zero + step, zero) - shown(zero - step, zero))[..., 0] / (2 * step)
    slope_y = (shown(zero, zero + step) - shown(zero, zero - step))[..., 1] / (2 * step)
    off = np.hypot(bend[..., 0] / slope_x, bend[..., 1] / slope_y)
    return float(off.max() / step**2)


def camera_lens(camera: LensCamera) -> F64:
    """Return a camera's numbers ``(LENS_SIZE,)`` with its shutter."""
    numbers = _lens_numbers(lens_key(camera.spec)).copy()
    if camera.rolling is not None:
        T_middle_start = camera.T_camera_world @ inverse(camera.rolling.T_camera_world_start)
        numbers[LENS_ROLLS] = 1.0
        numbers[LENS_TIME : LENS_TIME + 3] = camera.rolling.time
        numbers[LENS_TURN : LENS_TURN + 3] = -2 * cv2.Rodrigues(T_middle_start[:3, :3])[0].ravel()
        numbers[LENS_SHIFT : LENS_SHIFT + 3] = -2 * T_middle_start[:3, 3]
    return numbers


def node_motion(
    camera: LensCamera, rolling: Rolling, T_world_node: FloatArray, T_world_start: F64
) -> F32:
    """Return how a node moves in the world while a shutter is open, in the camera's axes at its
    middle ``(MOTION,)``: its centre evenly along a line, itself about its centre.
    """
    T = camera.T_camera_world
    middle = T @ T_world_node
    before = T @ T_world_start
    turn = -2 * cv2.Rodrigues(before[:3, :3] @ middle[:3, :3].T)[0].ravel()
    centre = middle[:3, 3]
    speed = 2 * (centre - before[:3, 3])
    camera_half = float(np.linalg.norm((T @ inverse(rolling.T_camera_world_start))[:3, 3]))
    bound = 0.51 * float(np.linalg.norm(turn))
    moved = bound * (float(np.linalg.norm(centre)) + camera_half + 1.0)
    return np.array([*turn, *speed, *centre, bound, moved], dtype=np.float32)
