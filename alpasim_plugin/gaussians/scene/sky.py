"""Paint the sky: a panorama by direction, read through the camera for every frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.geometry import heading_of, se2, wrap_angle
from alpasim_plugin.core.types import F32, F64, I64, FloatArray
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.lens_camera import LensCamera, corner_rays

if TYPE_CHECKING:
    from torch import Tensor

Kind = Literal["clear", "overcast", "dusk"]
# Full turn x elevations from LOW_RAD to HIGH_RAD
WIDTH = 1536
HEIGHT = 384
LOW_RAD = np.radians(-20.0)
HIGH_RAD = np.radians(70.0)
SPAN_PX = np.array([WIDTH, HEIGHT - 1], dtype=np.float32)
PX_PER_RAD = SPAN_PX / np.array([2 * np.pi, LOW_RAD - HIGH_RAD])
BLOCK = 16  # rows that are painted at once
PARTS = 32  # of a pixel, between which colours are interpolated
STEP_PX = 8  # directions are computed this often and interpolated in between
# Of a lens: what is so large between two of them, or of whose azimuths the difference is so large, as
# about the zenith, is computed at every pixel.
STEP_RAD = 0.06
AZIMUTH_STEP_RAD = 0.2

# zenith, middle, horizon, what shows below the horizon where the scene has a hole, cloud, hills
_COLOURS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "clear": (
        (0.30, 0.50, 0.80),
        (0.52, 0.70, 0.90),
        (0.82, 0.89, 0.94),
        (0.37, 0.38, 0.34),
        (0.97, 0.97, 0.97),
        (0.50, 0.56, 0.56),
    ),
    "overcast": (
        (0.62, 0.65, 0.69),
        (0.70, 0.73, 0.76),
        (0.80, 0.82, 0.83),
        (0.34, 0.35, 0.33),
        (0.86, 0.87, 0.88),
        (0.52, 0.55, 0.54),
    ),
    "dusk": (
        (0.23, 0.28, 0.46),
        (0.52, 0.46, 0.56),
        (0.95, 0.70, 0.48),
        (0.27, 0.24, 0.23),
        (0.93, 0.62, 0.52),
        (0.30, 0.29, 0.34),
    ),
}
_CLOUD_SHARE = {"clear": 0.34, "overcast": 0.85, "dusk": 0.45}


class Sky:
    """A sky as a panorama of directions.

    Args:
        panorama: ``(HEIGHT, WIDTH, 3)`` float32, 0..1; row 0 is the highest elevation, column 0
            looks along world +x, columns go left (counter-clockwise seen from above).
    """

    def __init__(self, panorama: F32) -> None:
        # One column repeated at the seam: interpolation never leaves the image.
        self._panorama = np.ascontiguousarray(np.concatenate([panorama, panorama[:, :1]], axis=1))
        self._uploaded: dict[str, list[Tensor]] = {}

    @property
    def panorama(self) -> F32:
        """Return the directions' colours as given."""
        return self._panorama[:, :-1]

    def image(self, camera: PinholeCamera | LensCamera) -> F32:
        """Return the sky behind every pixel, ``(H, W, 3)`` float32, 0..1."""
        if isinstance(camera, LensCamera):
            columns, rows = _places_through_lens(camera)
        else:
            corners = self._places(camera)
            columns, rows = (_upsample(grid, camera.height, camera.width) for grid in corners)
        # All lie within a turn of column 0: what % would give, in a tenth of its time.
        columns += np.float32(WIDTH) * (columns < 0)
        return cv2.remap(self._panorama, columns, np.clip(rows, 0, HEIGHT - 1), cv2.INTER_LINEAR)

    def on_device(self, cameras: Sequence[PinholeCamera | LensCamera], device: str) -> Tensor:
        """Return `image` of cameras that are drawn together ``(V, H, W, 3)`` as a tensor of a device,
        which receives the panorama once; through a lens directions are computed at every pixel.
        """
        import torch.nn.functional as F

        if device not in self._uploaded:
            parts = self._panorama.transpose(2, 0, 1), PX_PER_RAD, 2 / SPAN_PX
            self._uploaded[device] = [upload(part, device) for part in parts]
        panorama, px_per_rad, shares = self._uploaded[device]
        first = cameras[0]
        numbers = upload(np.stack([_seen_from(camera) for camera in cameras]), device)
        rolls = any(camera.rolling is not None for camera in cameras)
        if isinstance(first, LensCamera):
            window = _lens_places_on_device(numbers, first, device, px_per_rad, rolls)
        else:
            window = _pinhole_places_on_device(numbers, first, device, px_per_rad, rolls)
        # OpenCV interpolates at the nearest 32nd of a pixel.
        window = (window * PARTS).round_().div_(PARTS)
        window[:, 0].remainder_(WIDTH)
        images = F.grid_sample(
            panorama.expand(len(cameras), *panorama.shape),
            window.permute(0, 2, 3, 1) * shares - 1,
            mode="bilinear",
            padding_mode="border",
            align_corners=True,
        )
        return images.permute(0, 2, 3, 1)

    def _places(self, camera: PinholeCamera) -> tuple[F64, F64]:
        """Return columns and rows of the panorama at every `STEP_PX`-th pixel corner; columns may
        be negative.
        """
        h = camera.height
        w = camera.width
        u = _steps(w)
        v = _steps(h)
        x = (u - camera.cx) / camera.fx
        y = (v - camera.cy) / camera.fy
        ray = np.stack(
            [*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((len(v), len(u)))], axis=-1
        )
        return _places_of_rays(camera, ray, u[None, :], v[:, None])


def _places_of_rays(
    camera: PinholeCamera | LensCamera, ray: F64, u: FloatArray | I64, v: FloatArray | I64
) -> tuple[F64, F64]:
    """Return columns and rows of the panorama that rays ``(..., 3)`` of a camera at pixels u, v see;
    columns may be negative.
    """
    if camera.rolling is not None:
        a, b, c = camera.rolling.time
        time = np.clip(a * u + b * v + c, -0.5, 0.5)[..., None]
        ray = ray - time * np.cross(camera.motion(np.eye(4), np.eye(4))[:3], ray)
    ray = ray @ camera.T_camera_world[:3, :3]
    elevation = np.arctan2(ray[..., 2], np.hypot(ray[..., 0], ray[..., 1]))
    # Azimuth relative to the optical axis has no seam inside a view narrower than a half turn.
    forward = camera.T_camera_world[2, :3]
    ahead = heading_of(forward)
    azimuth = ahead + wrap_angle(heading_of(ray) - ahead)
    rows = (HIGH_RAD - elevation) * ((HEIGHT - 1) / (HIGH_RAD - LOW_RAD))
    return azimuth * (WIDTH / (2 * np.pi)), rows


def _places_through_lens(camera: LensCamera) -> tuple[F32, F32]:
    """Return columns and rows of the panorama at every pixel of a lens ``(H, W)``: interpolated
    where directions change evenly, and computed where they do not.
    """
    height = camera.height
    width = camera.width
    ray = corner_rays(camera.spec, STEP_PX)
    u, v = np.meshgrid(_steps(width), _steps(height))
    corners = _places_of_rays(camera, ray, u, v)
    columns, rows = (np.ascontiguousarray(_upsample(grid, height, width)) for grid in corners)
    is_uneven = _spread(corners[0]) > AZIMUTH_STEP_RAD * PX_PER_RAD[0]
    for axis in range(3):
        is_uneven |= _spread(ray[..., axis]) > STEP_RAD
    cells = np.repeat(np.repeat(is_uneven, STEP_PX, axis=0), STEP_PX, axis=1)[:height, :width]
    y, x = np.nonzero(cells)
    exact = _places_of_rays(camera, camera.rays()[y, x], x + 0.5, y + 0.5)
    columns[y, x], rows[y, x] = exact
    return columns, rows


def _spread(grid: F64) -> F64:
    """Return by how much the four corners of each cell of a grid differ."""
    cells = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[:-1, 1:], grid[1:, 1:]])
    return np.ptp(cells, axis=0)


def _seen_from(camera: PinholeCamera | LensCamera) -> F64:
    """Return how a camera sees the panorama: the matrix from its pixels, of a lens from its rays, to rays
    whose x is ahead, nine numbers; the place of its origin in the panorama, two; of a rolling shutter
    the time (a, b, c) of a pixel, and the matrix that turns rays in a shutter, before the first.
    """
    ahead = math.atan2(*camera.T_camera_world[2, 1::-1])
    T_camera_ahead = camera.T_camera_world[:3, :3] @ se2(0, 0, ahead)[:3, :3]
    to_rays = np.eye(3) if isinstance(camera, LensCamera) else np.linalg.inv(camera.K)
    time = np.zeros(3)
    turned = np.zeros((3, 3))
    if camera.rolling is not None:
        time = np.array(camera.rolling.time)
        turn = camera.motion(np.eye(4), np.eye(4))[:3]
        turned = -np.cross(turn, np.eye(3)).T @ to_rays
    still = T_camera_ahead.T @ to_rays
    place = np.array([ahead, -HIGH_RAD]) * PX_PER_RAD
    return np.concatenate([still.ravel(), place, time, (T_camera_ahead.T @ turned).ravel()])


def _places_on_device(
    numbers: Tensor, rays: Tensor, px_per_rad: Tensor, pixels: Tensor | None
) -> Tensor:
    """Return columns and rows of the panorama ``(V, 2, P)``, float32.

    Args:
        numbers: ``(V, 23)`` of `_seen_from`.
        rays: ``(3, P)`` in the axes that the numbers are of.
        px_per_rad: `PX_PER_RAD`.
        pixels: ``(3, P)``: u, v, 1; None where no shutter rolls.
    """
    import torch

    ahead = numbers[:, :9].view(-1, 3, 3) @ rays
    if pixels is not None:
        time = (numbers[:, None, 11:14] @ pixels).clamp(-0.5, 0.5)
        ahead = ahead + time * (numbers[:, 14:].view(-1, 3, 3) @ rays)
    x, y, z = ahead.unbind(1)
    angles = torch.stack([torch.atan2(y, x), torch.atan2(z, torch.hypot(x, y))], dim=2)
    return torch.addcmul(numbers[:, None, 9:11], angles, px_per_rad).float().mT


def _pinhole_places_on_device(
    numbers: Tensor, camera: PinholeCamera, device: str, px_per_rad: Tensor, rolls: bool
) -> Tensor:
    """Return `_places_on_device` at every pixel ``(V, 2, H, W)``, computed at `_corners` and
    interpolated in between.
    """
    import torch.nn.functional as F

    corners = _corners(camera.height, camera.width, device)
    flat = corners.flatten(1)
    places = _places_on_device(numbers, flat, px_per_rad, flat if rolls else None)
    coarse = places.reshape(-1, 2, *corners.shape[1:])
    finer = F.interpolate(coarse, scale_factor=STEP_PX, mode="bilinear", align_corners=False)
    first = STEP_PX // 2
    return finer[:, :, first : first + camera.height, first : first + camera.width]


def _lens_places_on_device(
    numbers: Tensor, camera: LensCamera, device: str, px_per_rad: Tensor, rolls: bool
) -> Tensor:
    """Return `_places_on_device` at every pixel of a lens ``(V, 2, H, W)``."""
    from alpasim_plugin.gaussians.raster.lens_on_device import rays_on_device

    pixels = _pixels(camera.height, camera.width, device) if rolls else None
    rays = rays_on_device(camera.spec, device)[:3].flatten(1)
    places = _places_on_device(numbers.float(), rays, px_per_rad.float(), pixels)
    return places.reshape(-1, 2, camera.height, camera.width)


@lru_cache(maxsize=8)
def _pixels(height: int, width: int, device: str) -> Tensor:
    """Return the middles of an image's pixels on a device ``(3, P)``: u, v, 1."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return upload(np.stack([u, v, np.ones_like(u)]).reshape(3, -1).astype(np.float32), device)


def _steps(size: int) -> I64:
    """Return every `STEP_PX`-th pixel corner along an axis, as far as the image goes."""
    return np.arange(-(-size // STEP_PX) + 1) * STEP_PX


@lru_cache(maxsize=8)
def _corners(height: int, width: int, device: str) -> Tensor:
    """Return these corners on a device ``(3, H', W')``: u, v, 1."""
    u, v = np.meshgrid(_steps(width), _steps(height))
    return upload(np.stack([u, v, np.ones_like(u)]).astype(np.float64), device)


def _upsample(grid: FloatArray, height: int, width: int) -> F32:
    """Interpolate values at every `STEP_PX`-th pixel corner to pixel centres."""
    rows, columns = grid.shape
    finer = cv2.resize(
        grid.astype(np.float32), (STEP_PX * columns, STEP_PX * rows), interpolation=cv2.INTER_LINEAR
    )
    first = STEP_PX // 2  # it takes the values for those of the middles of squares
    return finer[first : first + height, first : first + width]


def make_sky(kind: Kind, rng: np.random.Generator) -> Sky:
    """Paint a sky with drifting clouds, a hazy horizon and a line of hills."""
    zenith, middle, horizon, ground, cloud, hills = (np.array(colour) for colour in _COLOURS[kind])
    elevation = np.linspace(HIGH_RAD, LOW_RAD, HEIGHT)
    up = np.clip(elevation / HIGH_RAD, 0, 1)
    t = np.clip(up / 0.35, 0, 1)[:, None]
    high = np.clip((up - 0.35) / 0.65, 0, 1)[:, None]
    column = np.where(
        up[:, None] < 0.35, horizon * (1 - t) + middle * t, middle + (zenith - middle) * high
    )
    octaves = ((4, 12, 0.5), (9, 26, 0.3), (20, 60, 0.15), (44, 130, 0.08))
    noise = np.zeros((HEIGHT, WIDTH))
    for rows, columns, weight in octaves:
        noise += weight * _periodic_noise(rng, rows, columns)
    # Clouds are seen flatter towards the horizon and vanish in its haze.
    threshold = np.quantile(noise, 1 - _CLOUD_SHARE[kind])
    ridge = np.radians(1.2) * (
        1 + 0.8 * _periodic_noise(rng, 1, 24, 1) + 0.3 * _periodic_noise(rng, 1, 120, 1)
    )
    panorama = np.empty((HEIGHT, WIDTH, 3), dtype=np.float32)
    for first in range(0, HEIGHT, BLOCK):  # a block stays in the processor's cache
        part = slice(first, first + BLOCK)
        image = np.repeat(column[part, None, :], WIDTH, axis=1)
        cover = np.clip((noise[part] - threshold) / 0.45, 0, 1) * np.clip(
            (up[part, None] - 0.05) / 0.15, 0, 1
        )
        image += (
            0.85
            * cover[..., None]
            * (cloud * (1 - 0.12 * np.clip(noise[part], 0, 1)[..., None]) - image)
        )
        below = np.clip(
            (np.maximum(ridge, np.radians(0.3)) - elevation[part, None]) / np.radians(0.25), 0, 1
        )
        image += below[..., None] * (hills - image)
        field = np.clip((np.radians(0.0) - elevation[part]) / np.radians(1.5), 0, 1)[:, None, None]
        image += field * (ground - image)
        np.clip(image, 0, 1, out=panorama[part], casting="same_kind")
    return Sky(panorama)


def _periodic_noise(rng: np.random.Generator, rows: int, columns: int, height: int = HEIGHT) -> F64:
    """Return the first ``height`` rows of smooth noise ``(HEIGHT, WIDTH)`` of about unit spread
    whose left and right edges meet.
    """
    small = rng.standard_normal((rows + 2, columns)).astype(np.float32)
    wide = np.concatenate([small[:, -2:], small, small[:, :3]], axis=1)
    at_x = np.broadcast_to(
        (np.arange(WIDTH, dtype=np.float32) * columns / WIDTH + 2)[None, :], (height, WIDTH)
    )
    at_y = np.broadcast_to(
        (np.arange(height, dtype=np.float32) * rows / HEIGHT + 0.5)[:, None], (height, WIDTH)
    )
    return cv2.remap(wide, np.ascontiguousarray(at_x), np.ascontiguousarray(at_y), cv2.INTER_CUBIC)
