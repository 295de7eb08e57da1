"""DiFix3D+ and DiffusionHarmonizer: the deployed step from the render, with losses on the image.

    z_r = E(r),  x = z_r / (alpha + sigma),  z_0 = x - t v(x, t),  y' = D(z_0)          `lab.image_fixers.pipeline`
    L   = | y' - y |^2  +  lambda min(d(y', y), c)  +  w L_warp(y')                      on values in [-1, 1]

``r`` render, ``y`` clean frame, ``d`` perceptual distance of an image, ``c`` the largest value
that counts (DiffusionHarmonizer: beyond it there is no gradient), ``L_warp`` of `warping` (its
temporal form). The temporal form encodes the clip ``[r_t, y'_t-1 ... y'_t-4]``, newest first: the
last four outputs are the model's own, rounded to eight bits as they are shown, without gradients.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.lab.image_fixers.pipeline import fixed_step
from alpasim_plugin.lab.image_fixers.settings import RenderLevel
from alpasim_plugin.lab.training.perceptual_term import Distance
from alpasim_plugin.lab.training.warping import flow_between, warping_loss

GREY = 127.5  # levels from 0 to 1 on the scale of [-1, 1]
REFERENCES = 4  # frames of one latent


@dataclass(frozen=True, eq=False)
class RenderStep:
    """The deployed step, with gradients.

    Args:
        net, vae: Transformer and autoencoder.
        level: Noise level that the render is taken to have.
        sees_render: Whether the decoder is conditioned on the render; it is not told the opacity.
    """

    net: CosmosCausalDiT
    vae: TinyVAE
    level: RenderLevel
    sees_render: bool

    def __call__(self, render: Tensor, references: Tensor | None = None) -> Tensor:
        """Fix one frame.

        Args:
            render: ``(B, 3, 1, H, W)`` in [-1, 1].
            references: ``(B, 3, 4, H, W)`` last outputs, newest first; None: none.

        Returns:
            Like ``render``, not clipped.
        """
        z_r = self.vae.encode(
            render if references is None else torch.cat([render, references], dim=2)
        )
        text = z_r.new_zeros(1, 1, self.net.sizes.text_width)
        z_0 = fixed_step(self.net, z_r, self.level, text)
        return self.vae.decode(
            z_0[:, :, :1], render=render if self.sees_render else None, clamp=False
        )

    @torch.no_grad()
    def outputs(self, render: Tensor) -> Tensor:
        """Return what the deployed model shows of a clip from its start ``(B, 3, T, H, W)``; the
        first four frames have no references.
        """
        displayed: list[Tensor] = []
        for t in range(render.shape[2]):
            references = (
                None if t < REFERENCES else torch.cat(displayed[: -REFERENCES - 1 : -1], dim=2)
            )
            displayed.append(eight_bits(self(render[:, :, t : t + 1], references)))
        return torch.cat(displayed, dim=2)


def eight_bits(frames: Tensor) -> Tensor:
    """Round values in [-1, 1] to 256 levels, as images are shown; values beyond are clipped."""
    return frames.clamp(-1, 1).add(1).mul(GREY).round().div(GREY).sub(1)


def newest_first(frames: Tensor) -> Tensor:
    """Return the last four of ``(B, 3, T, H, W)``, in reverse order."""
    return frames[:, :, -REFERENCES:].flip(2)


def picture_losses(
    made: Tensor, clean: Tensor, distance: Distance, perceptual: float, clamp: float | None
) -> dict[str, Tensor]:
    """Return the weighted losses of images ``(B, 3, 1, H, W)`` in [-1, 1].

    Args:
        made: The model's, not clipped.
        clean: The clean frames.
        distance: Perceptual distance of images.
        perceptual: Its weight lambda.
        clamp: The largest distance of an image that counts; None: all.
    """
    distances = distance(made[:, :, 0], clean[:, :, 0])
    counted = distances if clamp is None else distances.clamp(max=clamp)
    return {"picture": (made - clean).square().mean(), "perceptual": perceptual * counted.mean()}


def warp_term(made: Tensor, clean: Tensor, weight: float) -> Mapping[str, Tensor]:
    """Return the weighted warping loss of a prediction ``(B, 3, 1, H, W)`` of the last of the clean
    frames ``(B, 3, T, H, W)``, T >= 5.
    """
    earlier = newest_first(clean[:, :, :-1])
    now = clean[:, :, -1]
    return {
        "warp-farneback": weight * warping_loss(made[:, :, 0], earlier, flow_between(earlier, now))
    }
