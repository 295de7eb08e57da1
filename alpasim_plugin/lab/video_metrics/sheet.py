"""Images side by side: input, output of each fixer, ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import U8

TITLE_PX = 18
GAP_PX = 3


def sheet(columns: Mapping[str, Sequence[U8]], rows: Sequence[str]) -> U8:
    """Lay images out as a table with titles.

    Args:
        columns: Title -> one image ``(H, W, 3)`` a row, all of one size.
        rows: Titles of the rows, written into their first image's corner.

    Raises:
        EvaluatorError: Columns of other lengths, or images of other sizes.
    """
    sizes = {picture.shape for column in columns.values() for picture in column}
    if len(sizes) != 1 or any(len(column) != len(rows) for column in columns.values()):
        raise EvaluatorError(
            f"{', '.join(columns)}: sizes {sorted(sizes)}, lengths {[len(column) for column in columns.values()]} for {len(rows)} rows",
            "give each column one image of one size per row",
        )
    parts = []
    for column_index, (title, column) in enumerate(columns.items()):
        head = np.full((TITLE_PX, column[0].shape[1], 3), 255, dtype=np.uint8)
        _write(head, title, (3, TITLE_PX - 5), (0, 0, 0))
        cells = [np.array(picture) for picture in column]
        if column_index == 0:
            for cell, text in zip(cells, rows, strict=True):
                _write(cell, text, (3, 13), (255, 255, 255))
        parts.append(np.concatenate([head, *(_below(cell) for cell in cells)]))
    gap = np.full((parts[0].shape[0], GAP_PX, 3), 255, dtype=np.uint8)
    return np.concatenate([piece for part in parts for piece in (part, gap)][:-1], axis=1)


def _below(cell: U8) -> U8:
    return np.concatenate([cell, np.full((GAP_PX, cell.shape[1], 3), 255, dtype=np.uint8)])


def _write(image: U8, text: str, position: tuple[int, int], colour: tuple[int, int, int]) -> None:
    if colour == (255, 255, 255):
        cv2.putText(
            image, text, position, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 3, cv2.LINE_AA
        )
    cv2.putText(image, text, position, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
