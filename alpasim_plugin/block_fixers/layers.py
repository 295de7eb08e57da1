"""Small layers shared by the transformer's parts: float32 islands, RMS norm, patch order.

Three places stay in float32 whatever the network's precision: the time embedding, the modulation
made from it, and the rotary positions. `Float32Linear` keeps the first two there even under
autocast or after ``net.to(torch.bfloat16)``.

Embeddings of the transformer: patch tokens, semantic-map tokens and time.

Source: OmniDreams single view (causal HD-map network). Channel order at the input is latent,
    condition mask, padding mask; the map has
its own patch embedding and is added to the tokens. The time sinusoid is cosine first; its RMS norm
feeds the modulation layers directly, while the two-layer map of the raw sinusoid is the additive
term that all modulation layers share.
"""

import math
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.devices import autocast

NORM_EPS = 1e-6
PATCH = 2  # latent pixels per token side; one latent frame per token in time
TIME_SCALE = 0.001
MAX_PERIOD = 10000.0


class Float32Linear(nn.Linear):
    """Apply a bias-free linear map in float32, whatever the dtype of its weights and input."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, bias=False)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(..., inputs)`` to ``(..., outputs)`` float32."""
        with autocast(input.device):
            return F.linear(input.float(), self.weight.float())


class RMSNorm(nn.Module):
    """Divide by the root mean square over the last axis and scale by a learned gain, in float32."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(..., width)`` to the same shape and dtype."""
        return F.rms_norm(x.float(), (x.shape[-1],), self.weight.float(), NORM_EPS).to(x.dtype)


def layer_norm(x: Tensor) -> Tensor:
    """Normalise the last axis to zero mean and unit variance; the network's layer norms have no
    parameters.
    """
    return F.layer_norm(x, (x.shape[-1],), eps=NORM_EPS)


def unpatchify(tokens: Tensor, height: int, width: int) -> Tensor:
    """Join 2x2 patches, channel fastest: the order of the output layer, which differs from the
    input's.

    Args:
        tokens: ``(B, T, H/2 * W/2, 4 * C)`` with the last axis ordered (row, column, channel).
        height, width: Latent size.

    Returns:
        ``(B, C, T, H, W)``.
    """
    b, t, _, depth = tokens.shape
    grid = tokens.reshape(
        b, t, height // PATCH, width // PATCH, PATCH, PATCH, depth // (PATCH * PATCH)
    )
    return grid.permute(0, 6, 1, 2, 4, 3, 5).reshape(b, -1, t, height, width)


class PatchLinear(nn.Linear):
    """Patch embedding."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__(channels * PATCH * PATCH, width, bias=False)

    def embed(self, video: Tensor) -> Tensor:
        """Map ``(B, channels, T, H, W)`` to ``(B, T, N, width)``."""
        b, c, t, h, w = video.shape
        grid = video.reshape(b, c, t, h // PATCH, PATCH, w // PATCH, PATCH)
        return self(
            grid.permute(0, 2, 3, 5, 1, 4, 6).reshape(
                b, t, (h // PATCH) * (w // PATCH), c * PATCH * PATCH
            )
        )


def sinusoid(t: Tensor, width: int) -> Tensor:
    """Embed time steps as cosines then sines.

    Args:
        t: ``(...)`` time steps, 0 to 1000.
        width: Channels, even.

    Returns:
        ``(..., width)`` float32.
    """
    scaled = t.float() * TIME_SCALE
    half = width // 2
    frequency = torch.exp(
        -math.log(MAX_PERIOD) * torch.arange(half, device=t.device, dtype=torch.float32) / half
    )
    angle = scaled[..., None] * frequency
    return torch.cat([angle.cos(), angle.sin()], dim=-1)


class TimeMap(nn.Module):
    """Map the sinusoid to the modulation term shared by every block: ``Linear(SiLU(Linear(s)))``,
    no biases, float32.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear_1 = Float32Linear(width, width)
        self.linear_2 = Float32Linear(width, 3 * width)

    def forward(self, s: Tensor) -> Tensor:
        """Map ``(..., width)`` to ``(..., 3 * width)``."""
        return self.linear_2(F.silu(self.linear_1(s)))


class PatchEmbed(nn.Module):
    """Hold one patch embedding under the checkpoint's key ``proj.1.weight``."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.proj = nn.ModuleList([nn.Identity(), PatchLinear(channels, width)])

    @property
    def linear(self) -> PatchLinear:
        """The embedding itself."""
        return cast(PatchLinear, self.proj[1])
