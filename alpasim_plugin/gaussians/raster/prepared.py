"""Precompute what does not depend on the camera, so that repeated frames cost only what changes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F32, F64, I64, FloatArray
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import (
    ALPHA_MIN,
    EXTENT_MAX_SIGMA,
    GEO_EXTENT,
    GEO_FACTOR,
    GEO_PEAK,
    GEO_SIZE,
)

Node = tuple["PreparedCloud", FloatArray | None]
_LANES = 16


@dataclass(frozen=True, eq=False)
class PreparedCloud:
    """A cloud ready for repeated rendering. Build it with `prepare`; the arrays are private to the
    rasteriser (see `constants`).

    Attributes:
        n_input: Gaussians of the cloud.
        sh_size: Coefficients per colour.
        means: float64, groups of 3 x 16 lanes.
        geometry: float32, groups of GEO_SIZE x 16 lanes.
        sh: float32, groups of sh_size x 3 x 16 lanes.
        index: int64, position of each lane's Gaussian in the cloud given.
        antialias_px2: See `GaussianCloud`.
    """

    n_input: int
    sh_size: int
    means: F64
    geometry: F32
    sh: F32
    index: I64
    antialias_px2: float

    def arrays(self) -> tuple[F64, F32, F32, int, I64]:
        """Return what `project_part` reads of it."""
        return self.means, self.geometry, self.sh, self.sh_size, self.index


def prepare(cloud: GaussianCloud) -> PreparedCloud:
    """Prepare a cloud for `rasterize_prepared`; costs about as much as drawing a few frames and
    holds its own copy. Gaussians below the alpha cut are left out.

    Args:
        cloud: Gaussians in their own frame (the world for a background, the box of an actor).

    Raises:
        InputError: The cloud holds Gaussians that cannot be drawn.
    """
    cloud.require_drawable()
    index = np.flatnonzero(cloud.opacities >= ALPHA_MIN)
    kept = cloud.take(index)
    factor = kept.rotations() * kept.scales.astype(np.float64)[:, None, :]
    return packed(
        len(cloud), index, kept.means, factor, kept.opacities, kept.sh, cloud.antialias_px2
    )


def packed(
    n_input: int,
    index: I64,
    means: FloatArray,
    factor: F64,
    opacities: FloatArray,
    sh: FloatArray,
    antialias_px2: float = 0.0,
) -> PreparedCloud:
    """Return Gaussians as the kernels read them.

    Args:
        n_input: Gaussians of the cloud that they are chosen from.
        index: ``(N,)`` their positions in it.
        means: ``(N, 3)``.
        factor: ``(N, 3, 3)`` whose product with its transpose is the covariance.
        opacities: ``(N,)`` at the alpha cut or above.
        sh: ``(N, K, 3)``.
        antialias_px2: See `GaussianCloud`.
    """
    n = len(index)
    size = sh.shape[1]
    opacity = opacities.astype(np.float64)
    geometry = np.zeros((n, GEO_SIZE), dtype=np.float32)
    geometry[:, GEO_FACTOR : GEO_FACTOR + 9] = factor.reshape(n, 9)
    geometry[:, GEO_PEAK] = (np.log2(opacity) + 4.0) / 8.0
    extent = np.sqrt(2 * np.log(np.maximum(opacity / ALPHA_MIN, 1.0)))
    geometry[:, GEO_EXTENT] = np.minimum(EXTENT_MAX_SIGMA, extent)
    # A mean of NaN in the lanes that fill up the last group fails every comparison, so they are
    # never drawn.
    return PreparedCloud(
        n_input,
        size,
        _in_lanes(means.astype(np.float64), np.nan),
        _in_lanes(geometry, 0.0),
        _in_lanes(sh.reshape(n, size * 3).astype(np.float32), 0.0),
        np.concatenate([index, np.zeros(-n % _LANES, dtype=np.int64)]).astype(np.int64),
        antialias_px2,
    )


def _in_lanes(columns: FloatArray, fill: float) -> npt.NDArray[Any]:
    """Turn ``(N, C)`` into groups of C x 16 lanes, flat."""
    n, width = columns.shape
    padded = np.full((n + (-n % _LANES), width), fill, dtype=columns.dtype)
    padded[:n] = columns
    return np.ascontiguousarray(padded.reshape(-1, _LANES, width).transpose(0, 2, 1)).reshape(-1)
