"""Embeddings of the transformer: patch tokens, semantic-map tokens and time.

Source: OmniDreams single view (causal HD-map network). Channel order at the input is latent, condition mask, padding mask; the map has
its own patch embedding and is added to the tokens. The time sinusoid is cosine first; its RMS norm feeds the modulation layers
directly, while the two-layer map of the raw sinusoid is the additive term that all modulation layers share.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.nets.layers import Float32Linear, PatchLinear

TIME_SCALE = 0.001
MAX_PERIOD = 10000.0


def sinusoid(t: Tensor, width: int, rounding: torch.dtype = torch.float32) -> Tensor:
    """Embed time steps as cosines then sines.

    Args:
        t: ``(...)`` time steps, 0 to 1000.
        width: Channels, even.
        rounding: Precision in which the original training code holds time: with ``torch.bfloat16``, the step, its scaled value and the
            result are each rounded (937.5 becomes 936).

    Returns:
        ``(..., width)`` float32.
    """
    scaled = (t.to(rounding) * TIME_SCALE).float()
    half = width // 2
    frequency = torch.exp(-math.log(MAX_PERIOD) * torch.arange(half, device=t.device, dtype=torch.float32) / half)
    angle = scaled[..., None] * frequency
    return torch.cat([angle.cos(), angle.sin()], dim=-1).to(rounding).float()


class TimeMap(nn.Module):
    """Map the sinusoid to the modulation term shared by every block: ``Linear(SiLU(Linear(s)))``, no biases, float32."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear_1 = Float32Linear(width, width)
        self.linear_2 = Float32Linear(width, 3 * width)

    def forward(self, s: Tensor) -> Tensor:
        """Map ``(..., width)`` to ``(..., 3 * width)``."""
        out: Tensor = self.linear_2(F.silu(self.linear_1(s)))
        return out


class PatchEmbed(nn.Module):
    """Hold one patch embedding under the checkpoint's key ``proj.1.weight``."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.proj = nn.ModuleList([nn.Identity(), PatchLinear(channels, width)])

    @property
    def linear(self) -> PatchLinear:
        """The embedding itself."""
        layer = self.proj[1]
        assert isinstance(layer, PatchLinear)
        return layer


def embed_latents(embed: PatchLinear, x: Tensor, condition_mask: Tensor | None, padding_mask: Tensor | None) -> Tensor:
    """Embed latents together with their masks.

    A mask that is None is zero, so its columns of the embedding are skipped.

    Args:
        embed: Embedding of C + 2 channels.
        x: ``(B, C, T, H, W)``.
        condition_mask: ``(B, 1, T, H, W)`` or anything that broadcasts to it, 1 where the latent is given.
        padding_mask: ``(B, 1, h, w)`` at any resolution; resized to the latent's by nearest neighbour.

    Returns:
        ``(B, T, N, width)``.
    """
    b, c, t, h, w = x.shape
    tokens = embed.embed(x)
    if condition_mask is not None:
        tokens = tokens + embed.embed(condition_mask.to(x.dtype).expand(b, 1, t, h, w), c)
    if padding_mask is not None:
        resized = F.interpolate(padding_mask.to(x.dtype), size=(h, w), mode="nearest")
        tokens = tokens + embed.embed(resized[:, :, None].expand(b, 1, t, h, w), c + 1)
    return tokens
