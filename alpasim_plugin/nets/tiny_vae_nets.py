"""The learned parts of the tiny autoencoder: residual corrections of the latent (encoder) and of the image (decoder).

Layout ``(B, T, H, W, C)`` as everywhere inside the codecs. The last layer of both parts is initialised to zero, so an untrained network
adds nothing. Attribute names (``fold``, ``grow``, ``see_colour``, ...) are keys of the shipped weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.nets.clips import GROUP
from alpasim_plugin.nets.frame_layers import FrameConv, PointwiseConv, channels_to_frames, conv_frames, run_layers
from alpasim_plugin.nets.streaming_state import StreamingState
from alpasim_plugin.nets.tiny_vae_transform import CELL, COLOURS, COMPONENTS

SLOPE = 0.1  # of the leaky ReLU
LATENT = len(COMPONENTS)
PIXELS = CELL * COLOURS  # values of one grid cell of one frame
DROPPED = GROUP - 1  # padding frames of the first group


@dataclass(frozen=True)
class TinySizes:
    """Channels of the tiny autoencoder, by part and fraction of the resolution.

    Args:
        encoder_quarter, encoder_eighth: Encoder, once per latent.
        decoder_eighth, decoder_quarter: Decoder, once per latent.
        decoder_frame: Decoder at a quarter of the resolution, once per frame: most of the cost. Multiples of 16 use SIMD fully.
    """

    encoder_quarter: int = 64
    encoder_eighth: int = 96
    decoder_eighth: int = 96
    decoder_quarter: int = 64
    decoder_frame: int = 48

    @classmethod
    def read(cls, tensors: Mapping[str, Tensor], doing: str, source: str, do: str) -> TinySizes:
        """Read the widths off biases.

        Raises:
            InputError: One of the biases is missing.
        """
        keys = {
            "encoder_quarter": "encoder.stem.bias", "encoder_eighth": "encoder.fold.bias", "decoder_eighth": "decoder.stem.bias",
            "decoder_quarter": "decoder.quarter.bias", "decoder_frame": "decoder.mix.last.bias",
        }  # fmt: skip
        missing = [key for key in keys.values() if key not in tensors]
        if missing:
            raise InputError(doing, f"{source} ({len(tensors)} tensors)", f"missing: {', '.join(missing)}", do)
        return cls(**{field.name: tensors[keys[field.name]].numel() for field in fields(cls)})


def activation() -> nn.LeakyReLU:
    """Return the activation layer, in place; leaky, since units that die under a plain ReLU do not recover in a network this small."""
    return nn.LeakyReLU(SLOPE, inplace=True)


class TemporalResidualBlock(nn.Module):
    """Residual block of two convolutions over a frame and its predecessor."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = FrameConv(2 * width, width)
        self.last = FrameConv(width, width)

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, T, H, W, C)`` to the same shape; the first frame's predecessor is zero."""
        out: Tensor = self.last(F.leaky_relu_(self.first(torch.cat([x, streaming.shift(x)], dim=-1)), SLOPE))
        return F.leaky_relu_(out.add_(x), SLOPE)


class Downsample(nn.Conv2d):
    """2x2 convolution with stride 2."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 2, stride=2)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, H/2, W/2, outputs)``."""
        return conv_frames(input, self.weight, self.bias, stride=2)


class Upsample(PointwiseConv):
    """Linear map of one cell to 2x2 cells (pixel shuffle) with one shared bias."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, 4 * outputs, axes=0, bias=False)
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, 2H, 2W, outputs)``."""
        b, t, rows, columns, _ = x.shape
        assert self.bias is not None
        four = F.linear(x, self.weight, self.bias.repeat(4)).view(b, t, rows, columns, 2, 2, -1)
        return four.permute(0, 1, 2, 4, 3, 5, 6).reshape(b, t, 2 * rows, 2 * columns, -1)


class TinyVAEEncoder(nn.Module):
    """Predict the correction of the cosine components from grids of 4 frames."""

    def __init__(self, sizes: TinySizes) -> None:
        super().__init__()
        quarter, eighth = sizes.encoder_quarter, sizes.encoder_eighth
        self.stem = FrameConv(GROUP * PIXELS, quarter)
        self.near = TemporalResidualBlock(quarter)
        self.fold = Downsample(quarter, eighth)
        self.far = nn.ModuleList([TemporalResidualBlock(eighth), TemporalResidualBlock(eighth)])
        self.head = FrameConv(eighth, LATENT)

    def next(self, grid: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, t, H/4, W/4, 192)`` to ``(B, t, H/8, W/8, 16)``."""
        return run_layers((self.stem, activation(), self.near, self.fold, activation(), *self.far, self.head), grid, streaming)


class TinyVAEDecoder(nn.Module):
    """Predict corrections of the synthesised frames from latents and, if given, the render."""

    def __init__(self, sizes: TinySizes) -> None:
        super().__init__()
        eighth, quarter, frame = sizes.decoder_eighth, sizes.decoder_quarter, sizes.decoder_frame
        self.stem = FrameConv(LATENT, eighth)
        self.far = nn.ModuleList([TemporalResidualBlock(eighth), TemporalResidualBlock(eighth)])
        self.quarter = Upsample(eighth, quarter)
        self.near = TemporalResidualBlock(quarter)
        self.grow = PointwiseConv(quarter, GROUP * frame, axes=0)
        self.see_colour = PointwiseConv(PIXELS, frame, axes=0, bias=False)
        self.see_opacity = PointwiseConv(CELL, frame, axes=0, bias=False)
        self.mix = TemporalResidualBlock(frame)
        self.head = FrameConv(frame, PIXELS + CELL)

    def next(self, z: Tensor, condition: tuple[Tensor, Tensor | None] | None, streaming: StreamingState) -> tuple[Tensor, Tensor | None]:
        """Map latents to corrections.

        Args:
            z: ``(B, t, H/8, W/8, 16)``.
            condition: Colours of the render times its opacity ``(B, T, H/4, W/4, 48)``, and the opacity ``(B, T, H/4, W/4, 16)`` or
                None for opaque; None without a render.
            streaming: Cached frames.

        Returns:
            Correction of the frames ``(B, T, H/4, W/4, 48)``, and the gate of the render's detail ``(B, T, H/4, W/4, 16)`` with a render;
            T is 4t, or 4t - 3 at the start of a video.
        """
        latent_rate = (self.stem, activation(), *self.far, self.quarter, activation(), self.near, self.grow)
        x = channels_to_frames(run_layers(latent_rate, z, streaming), GROUP)[:, DROPPED if streaming.first else 0 :]
        if condition is not None:
            covered = self.see_opacity.weight.sum(1) if condition[1] is None else self.see_opacity(condition[1])
            x = x + self.see_colour(condition[0]) + covered
        x = self.mix.next(F.leaky_relu_(x, SLOPE), streaming)
        if condition is None:
            assert self.head.bias is not None
            return conv_frames(x, self.head.weight[:PIXELS], self.head.bias[:PIXELS], padding=1), None
        out = self.head(x)
        return out[..., :PIXELS], 2 * torch.sigmoid(out[..., PIXELS:])
