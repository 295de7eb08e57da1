"""What the differentiable rasterisers take and return."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.cloud import GaussianCloud, logit
from alpasim_plugin.gaussians.constants import LOG_SCALE_LIMIT
from alpasim_plugin.gaussians.sh import SH_SIZES

_OPACITY_LIMIT = 1e-6  # opacities of exactly 0 and 1 have no finite logit


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians as an optimiser moves them; any of the tensors may require gradients.

    Attributes:
        means: ``(N, 3)`` metres, world, float32 or (where coordinates are large) float64.
        log_scales: ``(N, 3)`` logarithms of the standard deviations in metres.
        quaternions: ``(N, 4)`` wxyz, of any length but zero.
        logit_opacities: ``(N,)`` opacities before the logistic function.
        sh: ``(N, K, 3)`` colour coefficients, K in 1, 4, 9, 16.

    Raises:
        InputError: Shapes disagree.
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    logit_opacities: Tensor
    sh: Tensor

    def __post_init__(self) -> None:
        n = self.means.shape[0] if self.means.ndim else -1
        found = {name: tuple(tensor.shape) for name, tensor in vars(self).items()}
        wanted = ((n, 3), (n, 3), (n, 4), (n,))
        colours = [(n, size, 3) for size in SH_SIZES]
        if n < 0 or tuple(found.values())[:4] != wanted or found["sh"] not in colours:
            raise InputError(
                f"{n} means: {', '.join((f'{name} {shape}' for name, shape in found.items()))}",
                "give means (N,3), log_scales (N,3), quaternions (N,4), logit_opacities (N,) and sh (N,K,3) with K in 1, 4, 9, 16",
            )

    def __len__(self) -> int:
        """Return N."""
        return int(self.means.shape[0])

    @classmethod
    def from_cloud(cls, cloud: GaussianCloud, dtype: torch.dtype = torch.float32) -> Splats:
        """Copy a cloud; scales below ``exp(-20)`` m are raised to it and opacities kept 1e-6 away
        from 0 and 1.

        Raises:
            InputError: The cloud holds Gaussians that cannot be drawn.
        """
        cloud.require_drawable()
        scales = np.log(np.maximum(cloud.scales.astype(np.float64), np.exp(-LOG_SCALE_LIMIT)))
        logits = logit(
            np.clip(cloud.opacities.astype(np.float64), _OPACITY_LIMIT, 1 - _OPACITY_LIMIT)
        )
        arrays = (cloud.means, scales, cloud.quats, logits, cloud.sh)
        return cls(*(torch.as_tensor(np.array(a), dtype=dtype) for a in arrays))


@dataclass(eq=False)
class ScreenStatistics:
    """What density control needs to know of one view.

    Attributes:
        radii: ``(N,)`` int32, half the longer side of the box around the drawn ellipse, pixels,
            rounded up; 0 where a Gaussian does not reach the image.
        gradient_norm: ``(N,)`` float32, length of the gradient of the loss by the mean in pixels;
            None until the backward pass has run.
    """

    radii: Tensor
    gradient_norm: Tensor | None = None


@dataclass(frozen=True, eq=False)
class GradientOutput:
    """One rendered view with its graph.

    Attributes:
        rgb: ``(H, W, 3)``, background included, not clamped.
        alpha: ``(H, W)`` accumulated opacity.
        depth: ``(H, W)`` metres along the optical axis, alpha-weighted mean; 0 where alpha is 0.
        screen: Radii and, after the backward pass, gradients on the screen.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    screen: ScreenStatistics
