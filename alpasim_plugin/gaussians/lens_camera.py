"""Describe a camera with a lens: each of its pixels looks along a ray of its own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from alpasim_plugin.cameras.image_map import ImageMap, image_map, with_lens
from alpasim_plugin.cameras.lens import Rays, rays_at, rays_of
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, I64, Bool, CameraSpec, LensModel
from alpasim_plugin.gaussians.camera import Posed, Rolling
from alpasim_plugin.gaussians.cloud import require_rigid

LensKey = tuple[int, int, tuple[float, ...], LensModel]
KEPT_LENSES = 16
BOUNDED_BY_PLANES_RAD = np.deg2rad(75.0)


@dataclass(frozen=True, eq=False)
class LensCamera(Posed):
    """A camera through whose lens Gaussians are drawn along each pixel's ray; axes as of
    `PinholeCamera`.

    Attributes:
        spec: Its size, ``K`` and lens; a pinhole without a lens is drawn along its rays as well.
        T_camera_world: ``(4, 4)`` rigid transform that maps world points, metres, to camera points;
            of a rolling shutter at its middle.
        rolling: Its shutter; None: all pixels are exposed at once.

    Raises:
        InputError: A transform that is not rigid, or values that make no lens.
    """

    spec: CameraSpec
    T_camera_world: F64
    rolling: Rolling | None = None

    def __post_init__(self) -> None:
        T = np.asarray(self.T_camera_world, dtype=np.float64)
        object.__setattr__(self, "T_camera_world", T)
        object.__setattr__(self, "spec", with_lens(self.spec))
        require_rigid(T)
        lens_map(self.spec)

    @classmethod
    def from_pose(cls, spec: CameraSpec, T_world_camera: F64) -> LensCamera:
        """Build a camera from its pose, the transform that maps camera points to the world."""
        return cls(spec, inverse(np.asarray(T_world_camera, dtype=np.float64)))

    @property
    def width(self) -> int:
        """Return the image's width, pixels."""
        return self.spec.width

    @property
    def height(self) -> int:
        """Return the image's height, pixels."""
        return self.spec.height

    @property
    def fx(self) -> float:
        """Return pixels per radian on the axis, to the right."""
        return lens_rays(self.spec).focal[0]

    @property
    def fy(self) -> float:
        """Return pixels per radian on the axis, downwards."""
        return lens_rays(self.spec).focal[1]

    @property
    def visible(self) -> Bool:
        """Return where the lens sees anything, ``(H, W)``."""
        return lens_rays(self.spec).visible.reshape(self.height, self.width)

    def rays(self) -> F64:
        """Return the directions ``(H, W, 3)`` of unit length of the pixels, in the camera's axes."""
        return lens_rays(self.spec).ray.reshape(self.height, self.width, 3)

    def unprojected(self, rows: I64, columns: I64, distance: F64) -> F64:
        """Return the points ``(N, 3)`` in the camera's axes that pixels show at distances ``(N,)``
        from its centre.
        """
        return np.asarray(self.rays()[rows, columns] * distance[:, None], dtype=np.float64)

    def above_horizon(self) -> Bool:
        """Return which pixels ``(H, W)`` look up, towards +z of the world."""
        return self.rays() @ self.T_camera_world[:3, 2] > 0

    def in_view(self, centre: F64, radius: F64) -> Bool:
        """Return which spheres ``(N, 3)``, ``(N,)`` in the world may meet what the image shows; of
        a rolling shutter those as well that come into it by `Rolling.reach_px`.
        """
        p = centre @ self.T_camera_world[:3, :3].T + self.T_camera_world[:3, 3]
        distance = np.linalg.norm(p, axis=1)
        angle = np.arctan2(np.linalg.norm(p[:, :2], axis=1), p[:, 2])
        around = np.arcsin(np.clip(radius / np.maximum(distance, 1e-9), 0.0, 1.0))
        moved_rad = 0.0
        if self.rolling is not None:
            moved_rad = self.rolling.reach_px / max(self.fx, self.fy)
        visible = angle - around <= lens_map(self.spec).widest_rad + moved_rad
        low, high = lens_slopes(self.spec)
        if np.isfinite(low).all() and moved_rad == 0.0:
            for axis in range(2):
                for slope, sign in ((low[axis], 1.0), (high[axis], -1.0)):
                    outside = sign * (slope * p[:, 2] - p[:, axis])
                    visible &= outside <= radius * np.hypot(1.0, slope)
        return np.asarray((distance <= radius) | visible, dtype=np.bool_)


def lens_key(spec: CameraSpec) -> LensKey:
    """Return what the rays of a camera with a lens depend on."""
    assert spec.lens is not None, "a camera without a lens"
    return spec.width, spec.height, tuple(map(float, spec.K.ravel())), spec.lens


def spec_of(key: LensKey) -> CameraSpec:
    """Return a camera with the lens of a key."""
    width, height, K, lens = key
    return CameraSpec("lens", width, height, np.array(K).reshape(3, 3), np.eye(4), 0, lens)


def lens_map(spec: CameraSpec) -> ImageMap:
    """Return where a camera's lens shows directions, kept for the next camera with that lens."""
    return _lens_map(lens_key(spec))


def lens_rays(spec: CameraSpec) -> Rays:
    """Return what the pixels of a camera with a lens see, as unit vectors, kept likewise."""
    return _lens_rays(lens_key(spec))


def blind_part(spec: CameraSpec) -> Bool | None:
    """Return where a camera sees nothing ``(height, width)``; None where it sees everywhere."""
    if spec.lens is None:
        return None
    visible = lens_rays(spec).visible.reshape(spec.height, spec.width)
    return None if visible.all() else ~visible


def lens_slopes(spec: CameraSpec) -> tuple[F64, F64]:
    """Return the least and greatest ``x / z`` and ``y / z`` that a camera's lens shows, infinite
    where it sees so far from its axis that planes bound nothing, kept likewise.
    """
    return _lens_slopes(lens_key(spec))


def corner_rays(spec: CameraSpec, step: int) -> F64:
    """Return the rays ``(rows, columns, 3)`` of every ``step``-th corner of a camera's pixels, as
    far as its image goes, kept likewise.
    """
    return _corner_rays(lens_key(spec), step)


@lru_cache(maxsize=KEPT_LENSES)
def _lens_slopes(key: LensKey) -> tuple[F64, F64]:
    rays = lens_rays(spec_of(key))
    if rays.widest_rad > BOUNDED_BY_PLANES_RAD:
        return np.full(2, -np.inf), np.full(2, np.inf)
    ray = rays.ray[rays.visible]
    slopes = ray[:, :2] / ray[:, 2:]
    pixel = 1.0 / lens_map(spec_of(key)).px_per_rad[0] / np.cos(rays.widest_rad) ** 2
    return slopes.min(axis=0) - pixel, slopes.max(axis=0) + pixel


@lru_cache(maxsize=KEPT_LENSES)
def _corner_rays(key: LensKey, step: int) -> F64:
    spec = spec_of(key)
    u, v = np.meshgrid(*(np.arange(-(-size // step) + 1) * step for size in key[:2]))
    corners = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    ray = rays_at(spec, corners).ray
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    ray.flags.writeable = False
    return ray.reshape(*u.shape, 3)


@lru_cache(maxsize=KEPT_LENSES)
def _lens_map(key: LensKey) -> ImageMap:
    return image_map(spec_of(key))


@lru_cache(maxsize=KEPT_LENSES)
def _lens_rays(key: LensKey) -> Rays:
    rays = rays_of(spec_of(key))
    unit = rays.ray / np.linalg.norm(rays.ray, axis=1, keepdims=True)
    unit.flags.writeable = False
    return Rays(unit, rays.visible, rays.focal)
