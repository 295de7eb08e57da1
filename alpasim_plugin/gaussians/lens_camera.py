"""Describe a camera with a lens: each of its pixels looks along a ray of its own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from alpasim_plugin.cameras.image_map import ImageMap, image_map, with_lens
from alpasim_plugin.cameras.lens import Rays, rays_of
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, Bool, CameraSpec, LensModel
from alpasim_plugin.gaussians.camera import Posed, Rolling
from alpasim_plugin.gaussians.cloud import require_rigid

LensKey = tuple[int, int, tuple[float, ...], LensModel]
KEPT_LENSES = 16


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

    def above_horizon(self) -> Bool:
        """Return which pixels ``(H, W)`` look up, towards +z of the world."""
        return self.rays() @ self.T_camera_world[:3, 2] > 0


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


@lru_cache(maxsize=KEPT_LENSES)
def _lens_map(key: LensKey) -> ImageMap:
    return image_map(spec_of(key))


@lru_cache(maxsize=KEPT_LENSES)
def _lens_rays(key: LensKey) -> Rays:
    rays = rays_of(spec_of(key))
    unit = rays.ray / np.linalg.norm(rays.ray, axis=1, keepdims=True)
    unit.flags.writeable = False
    return Rays(unit, rays.visible, rays.focal)
