"""Gaussians as an optimiser moves them, the image that they give with its graph, and what the projections
of pinholes and of lenses share for the fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.devices import upload
from alpasim_plugin.gaussians.camera import Posed
from alpasim_plugin.gaussians.cloud import GaussianCloud, logit
from alpasim_plugin.gaussians.constants import EPS2D_PX2, LOG_SCALE_LIMIT
from alpasim_plugin.gaussians.sh import C0, sh_terms

_OPACITY_LIMIT = 1e-6  # opacities of exactly 0 and 1 have no finite logit


class Splats(NamedTuple):
    """Gaussians as an optimiser moves them; any of the tensors may require gradients.

    Attributes:
        means: ``(N, 3)`` metres, world, float32 or (where coordinates are large) float64.
        log_scales: ``(N, 3)`` logarithms of the standard deviations in metres.
        quaternions: ``(N, 4)`` wxyz, of any length but zero.
        logit_opacities: ``(N,)`` opacities before the logistic function.
        sh: ``(N, K, 3)`` colour coefficients, K in 1, 4, 9, 16.
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    logit_opacities: Tensor
    sh: Tensor

    @classmethod
    def from_cloud(cls, cloud: GaussianCloud) -> Splats:
        """Copy a drawable cloud; scales below ``exp(-20)`` m are raised to it and opacities kept
        1e-6 away from 0 and 1.
        """
        scales = np.log(np.maximum(cloud.scales.astype(np.float64), np.exp(-LOG_SCALE_LIMIT)))
        opacities = np.clip(cloud.opacities, _OPACITY_LIMIT, 1 - _OPACITY_LIMIT)
        arrays = (scales, cloud.quats, logit(opacities), cloud.sh)
        return cls(
            torch.as_tensor(np.array(cloud.means, dtype=np.float64)),
            *(torch.as_tensor(np.array(array, dtype=np.float32)) for array in arrays),
        )


@dataclass(frozen=True)
class GradientOutput:
    """One rendered view with its graph.

    Attributes:
        rgb: ``(H, W, 3)``, background included, not clamped.
        alpha: ``(H, W)`` accumulated opacity.
        depth: ``(H, W)`` metres along the optical axis, of a lens from the camera's centre,
            alpha-weighted mean; 0 where alpha is 0.
        index: ``(M,)`` the Gaussians that may reach the image, nearest first; on a GPU all of them,
            whose number the host knows.
        uv: ``(M, 2)`` their centres, pixels; keeps its gradient.
        on_screen: ``(M,)`` bool, which of them do reach it.
        pairs: ``()`` pairs of splat and tile, for which a GPU's lists may have lacked room.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    index: Tensor
    uv: Tensor
    on_screen: Tensor
    pairs: Tensor


# Vectors are tensors (3, N): operations on whole components are several times as fast.


def dot3(a: Tensor, b: Tensor) -> Tensor:
    """Return the dot products of vectors ``(3, N)``."""
    return (a * b).sum(dim=0)


def cross3(a: Tensor, b: Tensor) -> Tensor:
    """Return the cross products of vectors ``(3, N)``."""
    ax, ay, az = a
    bx, by, bz = b
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def colours_of(local: Tensor, sh: Tensor, camera: Posed) -> Tensor:
    """Return the colours ``(N, 3)`` from the camera's side, clamped at 0 below.

    Args:
        local: ``(3, N)`` centres in the camera's frame, metres.
        sh: ``(N, K, 3)`` harmonic coefficients.
        camera: From where.
    """
    world = upload(camera.T_camera_world[:3, :3].T, local.device).float() @ local
    terms = sh_terms(*(world * dot3(world, world).rsqrt()))
    constant, *higher = sh.unbind(1)
    colour = 0.5 + C0 * constant
    for term, coefficients in zip(terms, higher, strict=False):
        colour = colour + term[:, None] * coefficients
    return colour.clamp(min=0)


def screen_covariance(m: Tensor, n: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return C11, C12, C22 and the determinant of the screen covariance ``(M,)``.

    The determinant is a sum of squares (Cauchy-Binet), which does not cancel for needles.
    """
    c11, c12, c22 = dot3(m, m) + EPS2D_PX2, dot3(m, n), dot3(n, n) + EPS2D_PX2
    minors = cross3(m, n)
    return c11, c12, c22, dot3(minors, minors) + EPS2D_PX2 * (c11 + c22 - EPS2D_PX2)
