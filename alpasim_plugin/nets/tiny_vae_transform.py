"""The fixed transform of the tiny autoencoder: frames as quarter-resolution grids, and 16 DCT components of 4x8x8 pixel groups.

A group is 4 frames of one 8x8 pixel square. Its orthonormal discrete cosine transform over colour, time, row and column has 768 components;
the 16 kept ones are those with the most energy in driving video at 256x144 (eleven clips of eight cameras, 10 and 30 frames per second).
They hold 71 % of the energy beside the mean. Keeping them is an orthogonal projection: analysis after synthesis changes nothing.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.nets.clips import GROUP, SIDE
from alpasim_plugin.nets.frame_layers import Float32Buffers, conv_frames

COLOURS = 3
QUARTER = 4  # side of a grid cell, pixels
CELL = QUARTER * QUARTER  # pixels of a cell

# (colour, time, row, column) frequency and standard deviation over driving video in [-1, 1]
COMPONENTS: tuple[tuple[tuple[int, int, int, int], float], ...] = (
    ((0, 0, 0, 0), 8.0), ((0, 0, 1, 0), 2.0), ((1, 0, 0, 0), 1.8), ((0, 0, 0, 1), 1.2),
    ((0, 0, 2, 0), 1.1), ((0, 1, 0, 0), 1.0), ((0, 0, 1, 1), 0.7), ((0, 0, 3, 0), 0.65),
    ((0, 1, 0, 1), 0.6), ((0, 0, 0, 2), 0.55), ((0, 2, 0, 0), 0.55), ((0, 1, 1, 0), 0.5),
    ((0, 0, 2, 1), 0.5), ((2, 0, 0, 0), 0.4), ((0, 0, 4, 0), 0.45), ((0, 2, 0, 1), 0.45),
)  # fmt: skip
BLACK_OFFSET = -6.8  # mean of the first component: driving video is darker than mid-grey


def to_grid(video: Tensor) -> Tensor:
    """Map frames ``(B, C, 4t, H, W)`` to ``(B, t, H/4, W/4, 4 * 16 * C)``, channels ordered (frame, row, column, colour)."""
    b, c, frames, height, width = video.shape
    cells = video.reshape(b, c, frames // GROUP, GROUP, height // QUARTER, QUARTER, width // QUARTER, QUARTER)
    return cells.permute(0, 2, 4, 6, 3, 5, 7, 1).reshape(b, frames // GROUP, height // QUARTER, width // QUARTER, GROUP * CELL * c)


def from_grid(grid: Tensor) -> Tensor:
    """Rearrange single frames ``(B, T, H/4, W/4, 16 * C)`` out as ``(B, C, T, H, W)``."""
    b, frames, rows, columns, depth = grid.shape
    cells = grid.reshape(b, frames, rows, columns, QUARTER, QUARTER, depth // CELL)
    return cells.permute(0, 6, 1, 2, 4, 3, 5).reshape(b, depth // CELL, frames, rows * QUARTER, columns * QUARTER)


class CosineTransform(Float32Buffers):
    """Analyse grids of 4 frames into the 16 components of every 8x8 square, and synthesise them back.

    Both directions use the same fixed orthonormal kernel, computed in code and not stored in weights. Everything here
    is float32: half precision has an error of one grey level.
    """

    kernel: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("kernel", _kernel().contiguous(memory_format=torch.channels_last), persistent=False)
        self.register_buffer("mean", torch.tensor([BLACK_OFFSET] + [0.0] * (len(COMPONENTS) - 1)), persistent=False)
        self.register_buffer("std", torch.tensor([std for _, std in COMPONENTS]), persistent=False)

    def analyse(self, grid: Tensor) -> Tensor:
        """Map ``(B, t, H/4, W/4, 192)`` to normalised components ``(B, t, H/8, W/8, 16)``."""
        return (self._coefficients(grid) - self.mean) / self.std

    def synthesise(self, components: Tensor) -> Tensor:
        """Map normalised components back to ``(B, t, H/4, W/4, 192)``."""
        return self._sum(components * self.std + self.mean)

    def residue(self, grid: Tensor) -> Tensor:
        """Return the residual of the projection on the components, ``(B, t, H/4, W/4, 192)``: detail that the latent lacks."""
        return grid - self._sum(self._coefficients(grid))

    def _coefficients(self, grid: Tensor) -> Tensor:
        return conv_frames(grid, self.kernel, None, stride=SIDE // QUARTER)

    def _sum(self, coefficients: Tensor) -> Tensor:
        b, t, rows, columns, _ = coefficients.shape
        squares = F.linear(coefficients, self.kernel.permute(2, 3, 1, 0).flatten(0, 2)).view(b, t, rows, columns, 2, 2, -1)
        return squares.permute(0, 1, 2, 4, 3, 5, 6).reshape(b, t, 2 * rows, 2 * columns, -1)


def _kernel() -> Tensor:
    """Return ``(16, 192, 2, 2)``: components by grid channels (frame, row, column, colour) and 2x2 cells."""
    colour, time, space = _cosines(COLOURS), _cosines(GROUP), _cosines(SIDE)
    rows = []
    for (c, t, y, x), _ in COMPONENTS:
        block = torch.einsum("t,y,x,c->tyxc", time[t], space[y], space[x], colour[c])  # (4, 8, 8, 3)
        cells = block.reshape(GROUP, 2, QUARTER, 2, QUARTER, COLOURS).permute(0, 2, 4, 5, 1, 3)
        rows.append(cells.reshape(GROUP * CELL * COLOURS, 2, 2))
    return torch.stack(rows).float()


def _cosines(n: int) -> Tensor:
    """Return the orthonormal DCT-II matrix ``(n, n)``, one frequency a row, float64.

    On the CPU also under another default device: arithmetic on ``meta`` would load torch's compiler, which takes seconds.
    """
    index = torch.arange(n, dtype=torch.float64, device="cpu")
    k, i = index[:, None], index[None]
    matrix = torch.cos(math.pi * (i + 0.5) * k / n) * math.sqrt(2 / n)
    matrix[0] /= math.sqrt(2)
    return matrix
