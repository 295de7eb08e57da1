"""Where a fixed image comes from, as facts of its frame: recorded frames, the render, or the
fixer itself.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.types import F32, GUESSED_SHARE, RECORDED_SHARE, TRUST_CELLS

# a pixel that differs from the render by so much, of a range of 2, is the fixer's own altogether
MADE_UP = 0.25
CELL_PX = 16  # side of a cell
MOST_COLUMNS = 32  # an image wider than 512 pixels has larger ones
LEVELS = 15  # a share is a hexadecimal digit


def cell_px(width: int) -> int:
    """Return the side of a cell of images of a width, pixels."""
    return max(CELL_PX, -(-width // MOST_COLUMNS))


def trust_sums(output: Tensor, render: Tensor, recorded: Tensor) -> Tensor:
    """Add up by cell how much of each image is recorded, and how much is the fixer's own.

    Args:
        output, render: ``(B, H, W, 3)`` in [-1, 1], what the fixer made, and of what.
        recorded: ``(B, H, W, 1)`` share of the references in each pixel.

    Returns:
        ``(B, rows, columns, 2)``, recorded and guessed pixels of each cell. A cell is added
        up in one order, so that the facts do not depend on the number of threads.
    """
    height, width = recorded.shape[1:3]
    side = cell_px(width)
    red, green, blue = (output - render).abs_().unbind(-1)
    recorded_share = recorded[..., 0]
    guessed = ((red + green + blue) / (3 * MADE_UP)).clamp_(max=1).mul_(1 - recorded_share)
    whole = F.pad(
        torch.stack([recorded_share, guessed], dim=1), (0, -width % side, 0, -height % side)
    )
    return F.avg_pool2d(whole, side).permute(0, 2, 3, 1) * side**2


def trust_facts(sums: F32, height: int, width: int) -> dict[str, float | str]:
    """Return where an image comes from, as facts of its frame.

    Args:
        sums: ``(rows, columns, 2)`` of one image, see `trust_sums`.
        height, width: Of the image, pixels.

    Returns:
        `RECORDED_SHARE` and `GUESSED_SHARE`: means over the image. `TRUST_CELLS`: both by cell,
        ``COLUMNSxROWS:`` and two hexadecimal digits a cell, recorded and guessed in fifteenths,
        row by row from the top.
    """
    side = cell_px(width)
    heights = np.diff(np.arange(0, height, side), append=height)
    widths = np.diff(np.arange(0, width, side), append=width)
    pixels = np.outer(heights, widths)
    digits = np.rint(sums / pixels[..., None] * LEVELS).astype(np.uint8)
    recorded, guessed = sums.sum(axis=(0, 1)) / (height * width)
    text = digits.tobytes().hex()[1::2]  # of a byte's two digits the second: it is at most fifteen
    return {
        RECORDED_SHARE: float(recorded),
        GUESSED_SHARE: float(guessed),
        TRUST_CELLS: f"{sums.shape[1]}x{sums.shape[0]}:{text}",
    }
