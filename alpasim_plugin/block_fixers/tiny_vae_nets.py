"""The fixed transform of the tiny autoencoder: frames as quarter-resolution grids, and 16 DCT
components of 4x8x8 pixel groups.

A group is 4 frames of one 8x8 pixel square. Its orthonormal discrete cosine transform over colour,
time, row and column has 768 components; the 16 kept ones are those with the most energy in driving
video at 256x144 (eleven clips of eight cameras, 10 and 30 frames per second). They hold 71 % of the
energy beside the mean. Keeping them is an orthogonal projection: analysis after synthesis changes
nothing.

The learned parts of the tiny autoencoder: residual corrections of the latent (encoder) and of the
image (decoder).

Layout ``(B, T, H, W, C)`` as everywhere inside the codecs. The last layer of both parts is
initialised to zero, so an untrained network adds nothing. Attribute names (``fold``, ``grow``,
``see_colour``, ...) are keys of the shipped weights.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.block_fixers.clips import DROPPED, GROUP, SIDE
from alpasim_plugin.block_fixers.codec_weights import first_axes
from alpasim_plugin.block_fixers.streaming import (
    FrameConv,
    PointwiseConv,
    StreamingState,
    channels_to_frames,
    conv_frames,
    run_layers,
    spread,
)

COLOURS = 3
QUARTER = 4  # side of a grid cell, pixels
CELL = QUARTER * QUARTER  # pixels of a cell
# (colour, time, row, column) frequency and standard deviation over driving video in [-1, 1]
COMPONENTS: tuple[tuple[tuple[int, int, int, int], float], ...] = (
    ((0, 0, 0, 0), 8.0),
    ((0, 0, 1, 0), 2.0),
    ((1, 0, 0, 0), 1.8),
    ((0, 0, 0, 1), 1.2),
    ((0, 0, 2, 0), 1.1),
    ((0, 1, 0, 0), 1.0),
    ((0, 0, 1, 1), 0.7),
    ((0, 0, 3, 0), 0.65),
    ((0, 1, 0, 1), 0.6),
    ((0, 0, 0, 2), 0.55),
    ((0, 2, 0, 0), 0.55),
    ((0, 1, 1, 0), 0.5),
    ((0, 0, 2, 1), 0.5),
    ((2, 0, 0, 0), 0.4),
    ((0, 0, 4, 0), 0.45),
    ((0, 2, 0, 1), 0.45),
)
BLACK_OFFSET = -6.8  # mean of the first component: driving video is darker than mid-grey
SLOPE = 0.1  # of the leaky ReLU
LATENT = len(COMPONENTS)
PIXELS = CELL * COLOURS  # values of one grid cell of one frame


def to_grid(video: Tensor) -> Tensor:
    """Map frames ``(B, C, 4t, H, W)`` to ``(B, t, H/4, W/4, 4 * 16 * C)``, channels ordered (frame,
    row, column, colour).
    """
    b, c, frames, height, width = video.shape
    cells = video.reshape(
        b, c, frames // GROUP, GROUP, height // QUARTER, QUARTER, width // QUARTER, QUARTER
    )
    return cells.permute(0, 2, 4, 6, 3, 5, 7, 1).reshape(
        b, frames // GROUP, height // QUARTER, width // QUARTER, GROUP * CELL * c
    )


def from_grid(grid: Tensor) -> Tensor:
    """Rearrange single frames ``(B, T, H/4, W/4, 16 * C)`` out as ``(B, C, T, H, W)``."""
    b, frames, rows, columns, depth = grid.shape
    cells = grid.reshape(b, frames, rows, columns, QUARTER, QUARTER, depth // CELL)
    return cells.permute(0, 6, 1, 2, 4, 3, 5).reshape(
        b, depth // CELL, frames, rows * QUARTER, columns * QUARTER
    )


class CosineTransform(nn.Module):
    """Analyse grids of 4 frames into the 16 components of every 8x8 square, and synthesise them
    back.

    Both directions use the same fixed orthonormal kernel, computed in code and not stored in
    weights, on the CPU also under a default device of ``meta``. Everything here is float32: half precision has an error of one grey level.
    """

    kernel: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        colour = _cosines(COLOURS)
        time = _cosines(GROUP)
        space = _cosines(SIDE)
        rows = []
        for (c, t, y, x), _ in COMPONENTS:
            # (4, 8, 8, 3)
            block = torch.einsum("t,y,x,c->tyxc", time[t], space[y], space[x], colour[c])
            cells = block.reshape(GROUP, 2, QUARTER, 2, QUARTER, COLOURS).permute(0, 2, 4, 5, 1, 3)
            rows.append(cells.reshape(GROUP * CELL * COLOURS, 2, 2))
        self.register_buffer(
            "kernel",
            torch.stack(rows).float().contiguous(memory_format=torch.channels_last),
            persistent=False,
        )
        mean = [BLACK_OFFSET] + [0.0] * (LATENT - 1)
        std = [std for _, std in COMPONENTS]
        self.register_buffer("mean", torch.tensor(mean, device="cpu"), persistent=False)
        self.register_buffer("std", torch.tensor(std, device="cpu"), persistent=False)

    def analyse(self, grid: Tensor) -> Tensor:
        """Map ``(B, t, H/4, W/4, 192)`` to normalised components ``(B, t, H/8, W/8, 16)``."""
        return (self._coefficients(grid) - self.mean) / self.std

    def synthesise(self, components: Tensor) -> Tensor:
        """Map normalised components back to ``(B, t, H/4, W/4, 192)``."""
        return self._sum(components * self.std + self.mean)

    def residue(self, grid: Tensor) -> Tensor:
        """Return the residual of the projection on the components, ``(B, t, H/4, W/4, 192)``:
        detail that the latent lacks.
        """
        return grid - self._sum(self._coefficients(grid))

    def _coefficients(self, grid: Tensor) -> Tensor:
        return conv_frames(grid, self.kernel, None, stride=SIDE // QUARTER)

    def _sum(self, coefficients: Tensor) -> Tensor:
        return spread(F.linear(coefficients, self.kernel.permute(2, 3, 1, 0).flatten(0, 2)))


def _cosines(n: int) -> Tensor:
    """Return the orthonormal DCT-II matrix ``(n, n)``, one frequency a row, float64.

    On the CPU also under another default device: arithmetic on ``meta`` would load torch's
    compiler, which takes seconds.
    """
    index = torch.arange(n, dtype=torch.float64, device="cpu")
    k = index[:, None]
    i = index[None]
    matrix = torch.cos(math.pi * (i + 0.5) * k / n) * math.sqrt(2 / n)
    matrix[0] /= math.sqrt(2)
    return matrix


@dataclass(frozen=True)
class TinySizes:
    """Channels of the tiny autoencoder, by part and fraction of the resolution.

    Args:
        encoder_quarter, encoder_eighth: Encoder, once per latent.
        decoder_eighth, decoder_quarter: Decoder, once per latent.
        decoder_frame: Decoder at a quarter of the resolution, once per frame: most of the cost.
            Multiples of 16 use SIMD fully.
    """

    encoder_quarter: int = 64
    encoder_eighth: int = 96
    decoder_eighth: int = 96
    decoder_quarter: int = 64
    decoder_frame: int = 48

    @classmethod
    def read(cls, tensors: Mapping[str, Tensor], source: str, do: str) -> TinySizes:
        """Read the widths off biases.

        Raises:
            InputError: One of the biases is missing.
        """
        layers = (
            "encoder.stem",
            "encoder.fold",
            "decoder.stem",
            "decoder.quarter",
            "decoder.mix.last",
        )
        return cls(*first_axes(tensors, [f"{layer}.bias" for layer in layers], source, do))


def activation() -> nn.LeakyReLU:
    """Return the activation layer, in place; leaky, since units that die under a plain ReLU do not
    recover in a network this small.
    """
    return nn.LeakyReLU(SLOPE, inplace=True)


class TemporalResidualBlock(nn.Module):
    """Residual block of two convolutions over a frame and its predecessor."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = FrameConv(2 * width, width)
        self.last = FrameConv(width, width)

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, T, H, W, C)`` to the same shape; the first frame's predecessor is zero."""
        out = self.first(torch.cat([x, streaming.shift(x)], dim=-1))
        out = self.last(F.leaky_relu_(out, SLOPE))
        return F.leaky_relu_(out.add_(x), SLOPE)


class Upsample(PointwiseConv):
    """Linear map of one cell to 2x2 cells (pixel shuffle) with one shared bias."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, 4 * outputs, axes=0, bias=False)
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, 2H, 2W, outputs)``."""
        assert self.bias is not None
        return spread(F.linear(x, self.weight, self.bias.repeat(4)))


class TinyVAEEncoder(nn.Module):
    """Predict the correction of the cosine components from grids of 4 frames."""

    def __init__(self, sizes: TinySizes) -> None:
        super().__init__()
        quarter = sizes.encoder_quarter
        eighth = sizes.encoder_eighth
        self.stem = FrameConv(GROUP * PIXELS, quarter)
        self.near = TemporalResidualBlock(quarter)
        self.fold = FrameConv(quarter, eighth, side=2, stride=2, around=0)
        self.far = nn.ModuleList([TemporalResidualBlock(eighth), TemporalResidualBlock(eighth)])
        self.head = FrameConv(eighth, LATENT)

    def next(self, grid: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, t, H/4, W/4, 192)`` to ``(B, t, H/8, W/8, 16)``."""
        return run_layers(
            (self.stem, activation(), self.near, self.fold, activation(), *self.far, self.head),
            grid,
            streaming,
        )


class TinyVAEDecoder(nn.Module):
    """Predict corrections of the synthesised frames from latents and, if given, the render."""

    def __init__(self, sizes: TinySizes) -> None:
        super().__init__()
        eighth = sizes.decoder_eighth
        quarter = sizes.decoder_quarter
        frame = sizes.decoder_frame
        self.stem = FrameConv(LATENT, eighth)
        self.far = nn.ModuleList([TemporalResidualBlock(eighth), TemporalResidualBlock(eighth)])
        self.quarter = Upsample(eighth, quarter)
        self.near = TemporalResidualBlock(quarter)
        self.grow = PointwiseConv(quarter, GROUP * frame, axes=0)
        self.see_colour = PointwiseConv(PIXELS, frame, axes=0, bias=False)
        self.see_opacity = PointwiseConv(CELL, frame, axes=0, bias=False)
        self.mix = TemporalResidualBlock(frame)
        self.head = FrameConv(frame, PIXELS + CELL)

    def next(
        self, z: Tensor, condition: tuple[Tensor, Tensor] | None, streaming: StreamingState
    ) -> tuple[Tensor, Tensor]:
        """Map latents to corrections.

        Args:
            z: ``(B, t, H/8, W/8, 16)``.
            condition: Colours of the render times its opacity ``(B, T, H/4, W/4, 48)``, and the
                opacity ``(B, T, H/4, W/4, 16)``; None without a render.
            streaming: Cached frames.

        Returns:
            Correction of the frames ``(B, T, H/4, W/4, 48)``, and the gate of the render's detail
            ``(B, T, H/4, W/4, 16)``; T is 4t, or 4t - 3 at the start of a video.
        """
        latent_rate = (
            self.stem,
            activation(),
            *self.far,
            self.quarter,
            activation(),
            self.near,
            self.grow,
        )
        x = channels_to_frames(run_layers(latent_rate, z, streaming), GROUP)[
            :, DROPPED if streaming.first else 0 :
        ]
        if condition is not None:
            colours, opacity = condition
            x = x + self.see_colour(colours) + self.see_opacity(opacity)
        out = self.head(self.mix.next(F.leaky_relu_(x, SLOPE), streaming))
        return out[..., :PIXELS], 2 * torch.sigmoid(out[..., PIXELS:])
