"""Where a fixed picture comes from, as facts of its frame: recorded frames, the render, or the
fixer itself.
"""

# Numba's decorators are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

from __future__ import annotations

import numpy as np
from numba import njit

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, GUESSED_SHARE, RECORDED_SHARE, TRUST_CELLS, U8

# a pixel that differs from the render by so much, of a range of 2, is the fixer's own altogether
MADE_UP = 0.25
CELL_PX, MOST_COLUMNS = 16, 32  # side of a cell; a picture wider than 512 pixels has larger ones
LEVELS = 15  # a share is a hexadecimal digit


def trust(output: F32, render: F32, recorded: F32) -> dict[str, float | str]:
    """Return where a picture comes from, as facts of its frame.

    Args:
        output, render: ``(H, W, 3)`` in [-1, 1], what the fixer made, and of what.
        recorded: ``(H, W)`` share of the references in each pixel.

    Returns:
        `RECORDED_SHARE` and `GUESSED_SHARE`: means over the picture. `TRUST_CELLS`: both by cell,
        as `trust_cells` reads it. Sums are in double precision and in one order: those of torch
        depend in their last bits on the number of threads, and facts must not.
    """
    height, width = recorded.shape
    side = max(CELL_PX, -(-width // MOST_COLUMNS))
    sums = np.zeros((-(-height // side), -(-width // side), 2))
    _add_shares(*(np.ascontiguousarray(x) for x in (output, render, recorded)), side, sums)
    pixels = np.outer(
        *(np.diff(np.arange(0, length, side), append=length) for length in (height, width))
    )
    digits = np.rint(sums / pixels[..., None] * LEVELS).astype(np.uint8)
    recorded_share, guessed_share = (
        float(share) for share in sums.sum(axis=(0, 1)) / recorded.size
    )
    text = digits.tobytes().hex()[1::2]  # of a byte's two digits the second: it is at most fifteen
    return {
        RECORDED_SHARE: recorded_share,
        GUESSED_SHARE: guessed_share,
        TRUST_CELLS: f"{sums.shape[1]}x{sums.shape[0]}:{text}",
    }


@njit(cache=True, nogil=True)
def _add_shares(output, render, recorded, side, sums):
    """Add the recorded and the made-up share of every pixel to its cell, in double precision and
    row by row.
    """
    scale = np.float32(1 / (3 * MADE_UP))
    height, width = recorded.shape
    for row in range(height):
        for first in range(0, width, side):
            cell = sums[row // side, first // side]
            for column in range(first, min(first + side, width)):
                apart = abs(output[row, column, 0] - render[row, column, 0])
                apart += abs(output[row, column, 1] - render[row, column, 1])
                apart += abs(output[row, column, 2] - render[row, column, 2])
                share = recorded[row, column]
                cell[0] += share
                cell[1] += min(apart * scale, np.float32(1.0)) * (np.float32(1.0) - share)


def trust_cells(text: str) -> U8:
    """Return the shares of every cell of a picture ``(rows, columns, 2)``, recorded and guessed, in
    fifteenths.

    Args:
        text: ``COLUMNSxROWS:`` and two hexadecimal digits a cell, row by row from the top.

    Raises:
        InputError: It is no such text.

    Example:
        >>> trust_cells("2x1:f00a").tolist()
        [[[15, 0], [0, 10]]]
    """
    size, _, digits = text.partition(":")
    try:
        columns, rows = (int(part) for part in size.split("x"))
        return np.array([int(digit, 16) for digit in digits], np.uint8).reshape(rows, columns, 2)
    except ValueError as error:
        raise InputError(
            f"{TRUST_CELLS}: {text[:40]!r}",
            "run the rollout again: its frames.jsonl is damaged",
        ) from error
