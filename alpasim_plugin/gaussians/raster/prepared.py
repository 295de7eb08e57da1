"""Precompute what does not depend on the camera, so that repeated frames cost only what changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import (
    ALPHA_MIN,
    BUNDLE,
    EXTENT_MAX_SIGMA,
    GEO_EXTENT,
    GEO_FACTOR,
    GEO_PEAK,
    GEO_REACH,
    GEO_SIZE,
    SPHERE_SIZE,
)
from alpasim_plugin.gaussians.raster.project_kernels import colours_in_lanes

Node = tuple["PreparedCloud", npt.NDArray[np.floating] | None]
F32 = npt.NDArray[np.float32]
_LANES = 16


@dataclass(frozen=True, eq=False)
class PreparedCloud:
    """A cloud ready for repeated rendering. Build it with `prepare`; the arrays are private to the
    rasteriser (see `constants`).

    Attributes:
        n_input: Gaussians of the cloud.
        n_kept: Those of them that can reach the alpha cut.
        sh_size: Coefficients per colour.
        means: float64, groups of 3 x 16 lanes; Gaussians are ordered along a space-filling curve,
            so that whole bundles leave the view.
        geometry: float32, groups of GEO_SIZE x 16 lanes.
        sh: float32, groups of sh_size x 3 x 16 lanes.
        index: int64, position of each lane's Gaussian in the cloud given.
        spheres: float64, bounding sphere per bundle.
        sphere: float64 ``(SPHERE_SIZE,)``, bounding sphere of all.
        antialias_px2: See `GaussianCloud`.
    """

    n_input: int
    n_kept: int
    sh_size: int
    means: F64
    geometry: F32
    sh: F32
    index: npt.NDArray[np.int64]
    spheres: F64
    sphere: F64
    antialias_px2: float

    def __len__(self) -> int:
        """Return the number of Gaussians kept."""
        return self.n_kept

    def arrays(self) -> tuple[F64, F32, F32, int, npt.NDArray[np.int64], F64]:
        """Return what `project_part` reads of it."""
        return self.means, self.geometry, self.sh, self.sh_size, self.index, self.spheres


def prepare(cloud: GaussianCloud) -> PreparedCloud:
    """Prepare a cloud for `rasterize_prepared`; costs about as much as drawing a few frames and
    holds its own copy.

    Args:
        cloud: Gaussians in their own frame (the world for a background, the box of an actor).

    Raises:
        InputError: The cloud holds Gaussians that cannot be drawn.
    """
    cloud.require_drawable()
    index = np.flatnonzero(cloud.opacities >= ALPHA_MIN)
    index = index[np.argsort(_morton_codes(cloud.means[index]), kind="stable")]
    n, size = len(index), cloud.sh.shape[1]
    kept = GaussianCloud(
        cloud.means[index],
        cloud.quats[index],
        cloud.scales[index],
        cloud.opacities[index],
        np.empty((n, 1, 3)),
    )
    sh = np.empty((n + (-n % _LANES)) * size * 3, np.float32)
    coefficients = cloud.sh.reshape(-1).view()
    coefficients.flags.writeable = (
        False  # as in a fresh cloud, also where this one was unpickled: one type for compiled code
    )
    colours_in_lanes(coefficients, size * 3, index, sh)
    opacity = kept.opacities.astype(np.float64)
    geometry = np.zeros((n, GEO_SIZE), np.float32)
    geometry[:, GEO_FACTOR : GEO_FACTOR + 9] = (
        kept.rotations() * kept.scales.astype(np.float64)[:, None, :]
    ).reshape(n, 9)
    geometry[:, GEO_PEAK] = (np.log2(opacity) + 4.0) / 8.0
    geometry[:, GEO_EXTENT] = np.minimum(
        EXTENT_MAX_SIGMA, np.sqrt(2 * np.log(np.maximum(opacity / ALPHA_MIN, 1.0)))
    )
    geometry[:, GEO_REACH] = np.maximum(
        np.maximum(*kept.scales[:, :2].T), kept.scales[:, 2]
    )  # numpy is slow along an axis of three
    # A mean of NaN in the lanes that fill up the last group fails every comparison, so they are
    # never drawn.
    means = kept.means.astype(np.float64)
    reach = geometry[:, GEO_REACH]
    return PreparedCloud(
        len(cloud),
        n,
        size,
        _in_lanes(means, np.nan),
        _in_lanes(geometry, 0.0),
        sh,
        np.concatenate([index, np.zeros(-n % _LANES, np.int64)]).astype(np.int64),
        _bounding_spheres(means, reach, BUNDLE),
        _bounding_spheres(means, reach, max(n, 1)) if n else np.zeros(SPHERE_SIZE),
        cloud.antialias_px2,
    )


def _in_lanes(columns: npt.NDArray[np.floating], fill: float) -> npt.NDArray[Any]:
    """Turn ``(N, C)`` into groups of C x 16 lanes, flat."""
    n, width = columns.shape
    padded = np.full((n + (-n % _LANES), width), fill, columns.dtype)
    padded[:n] = columns
    return np.ascontiguousarray(padded.reshape(-1, _LANES, width).transpose(0, 2, 1)).reshape(-1)


def _bounding_spheres(means: F64, reach: F32, bundle: int) -> F64:
    """Return centre and radius of the means and the largest scale of each ``bundle`` Gaussians in a
    row, flat.
    """
    if len(means) == 0:
        return np.zeros(0)
    starts = np.arange(0, len(means), bundle)
    columns = np.ascontiguousarray(means.T)
    centre = (
        np.minimum.reduceat(columns, starts, axis=1) + np.maximum.reduceat(columns, starts, axis=1)
    ) / 2
    x, y, z = columns - centre[:, np.arange(len(means)) // bundle]
    distance = np.sqrt(x * x + y * y + z * z)
    # Slightly enlarged: the radius must also hold after rounding.
    radius = np.maximum.reduceat(distance, starts) * (1 + 1e-9) + 1e-9
    return np.column_stack([*centre, radius, np.maximum.reduceat(reach, starts)]).reshape(-1)


def _morton_codes(points: npt.NDArray[np.floating]) -> npt.NDArray[np.uint64]:
    """Return the positions of points ``(N, 3)`` along a Z-order curve through their bounding box,
    16 bits an axis.
    """
    if len(points) == 0:
        return np.zeros(0, np.uint64)
    columns = np.ascontiguousarray(points.T)
    low = columns.min(axis=1, keepdims=True)
    span = np.maximum(columns.max(axis=1, keepdims=True) - low, 1e-9).max()
    cell = np.minimum((columns - low) / span * 65536.0, 65535.0).astype(np.uint64)
    for shift, mask in (
        (16, 0x0000FF0000FF),
        (8, 0x00F00F00F00F),
        (4, 0x0C30C30C30C3),
        (2, 0x249249249249),
    ):
        cell = (cell | (cell << np.uint64(shift))) & np.uint64(mask)
    return cell[0] | (cell[1] << np.uint64(1)) | (cell[2] << np.uint64(2))
