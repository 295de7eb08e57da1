"""One deterministic step from a render at a fixed time: the samplers of DiFix3D+ and DiffusionHarmonizer.

Both take the render for a clean image with noise of a fixed level, ``z_r = alpha z_0 + sigma eps``, though none is added, and denoise it
once. Divided by ``alpha + sigma`` that is a point of the straight path of flow matching, ``x = (1 - t) z_0 + t eps``, with

    t = sigma / (alpha + sigma),   x = z_r / (alpha + sigma),   z_0 = x - t v(x, t).

DiFix3D+: step 199 of Stable Diffusion's 1000 (scaled linear betas), ``z_0 = (z_r - sigma eps_hat) / alpha``. DiffusionHarmonizer:
``alpha = 1``, ``sigma = 0.25``, so that ``z_0 = 0.8 z_r - 0.2 v(0.8 z_r, 0.2)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from alpasim_plugin.errors import InputError
from alpasim_plugin.nets.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.nets.sampling import flow_step
from alpasim_plugin.nets.schedule import TABLE


@dataclass(frozen=True)
class RenderLevel:
    """The noise level that a render is taken to have: ``z_r = alpha z_0 + sigma eps``.

    Example:
        >>> harmonizer = RenderLevel(1.0, 0.25)
        >>> harmonizer.t, harmonizer.scale, harmonizer.network_t
        (0.2, 0.8, 200.0)

    Raises:
        InputError: Values that are not positive.
    """

    alpha: float
    sigma: float

    def __post_init__(self) -> None:
        if not (self.alpha > 0 and self.sigma > 0):
            found = f"alpha {self.alpha:g}, sigma {self.sigma:g}"
            raise InputError("choosing the noise level of a render", "alpha and sigma", found, "give values above 0")

    @property
    def t(self) -> float:
        """Time on the straight path, 0 to 1."""
        return self.sigma / (self.alpha + self.sigma)

    @property
    def scale(self) -> float:
        """Factor from the render's latents to the point on the path."""
        return 1 / (self.alpha + self.sigma)

    @property
    def network_t(self) -> float:
        """Time input of the network, a whole number of 0 to 1000."""
        return float(round(TABLE * self.t))


def fixed_step(net: CosmosCausalDiT, z_r: Tensor, level: RenderLevel, text: Tensor | TextContext) -> Tensor:
    """Predict clean latents from those of a render; attention goes over all latents, and there is no map.

    Args:
        net: The network, or a copy folded at ``level.network_t``.
        z_r: ``(B, C, T, H, W)``; T is 1 for a single image, 2 for an image with its references.
        level: The render's noise level.
        text: Prompt.

    Returns:
        Like ``z_r``.
    """
    x = level.scale * z_r
    v = net(x, level.network_t, text, torch.zeros_like(x), block_latents=None)
    return flow_step(x, v, level.t)
