"""Where a fixed picture comes from, as facts of its frame: recorded frames, the render, or the fixer itself."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, F64, GUESSED_SHARE, RECORDED_SHARE, TRUST_CELLS, U8

MADE_UP = 0.25  # a pixel that differs from the render by so much, of a range of 2, is the fixer's own altogether
CELL_PX, MOST_COLUMNS = 16, 32  # side of a cell; a picture wider than 512 pixels has larger ones
LEVELS = 15  # a share is a hexadecimal digit


def trust(output: F32, render: F32, recorded: F32) -> dict[str, float | str]:
    """Return where a picture comes from, as facts of its frame.

    Args:
        output, render: ``(H, W, 3)`` in [-1, 1], what the fixer made, and of what.
        recorded: ``(H, W)`` share of the references in each pixel.

    Returns:
        `RECORDED_SHARE` and `GUESSED_SHARE`: means over the picture. `TRUST_CELLS`: both by cell, as `trust_cells` reads it. Sums are
        numpy's, in double precision: those of torch depend in their last bits on the number of threads, and facts must not.
    """
    apart = np.abs(output - render)
    own = (apart[..., 0] + apart[..., 1] + apart[..., 2]) * np.float32(1 / (3 * MADE_UP))
    guessed = np.minimum(own, 1) * (1 - recorded)
    height, width = recorded.shape
    side = max(CELL_PX, -(-width // MOST_COLUMNS))
    edges = [np.arange(0, length, side) for length in (height, width)]

    def by_cell(shares: F32) -> F64:
        """Return the mean of every cell."""
        sums = np.add.reduceat(np.add.reduceat(shares, edges[0], axis=0, dtype=np.float64), edges[1], axis=1)
        means: F64 = sums / np.outer(*(np.diff(edge, append=length) for edge, length in zip(edges, (height, width), strict=True)))
        return means

    digits = np.rint(np.stack([by_cell(recorded), by_cell(guessed)], axis=-1) * LEVELS).astype(int)
    text = "".join(f"{digit:x}" for digit in digits.ravel().tolist())
    means = {name: float(shares.mean(dtype=np.float64)) for name, shares in ((RECORDED_SHARE, recorded), (GUESSED_SHARE, guessed))}
    return {**means, TRUST_CELLS: f"{digits.shape[1]}x{digits.shape[0]}:{text}"}


def trust_cells(text: str) -> U8:
    """Return the shares of every cell of a picture ``(rows, columns, 2)``, recorded and guessed, in fifteenths.

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
        found = f"{text[:40]!r}"
        raise InputError(
            "reading where a picture comes from", TRUST_CELLS, found, "run the rollout again: its frames.jsonl is damaged"
        ) from error
