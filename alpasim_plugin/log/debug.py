"""What a policy reports about itself in ``Plan.debug``, as rows of ``debug.jsonl``: text, images, heat
maps, boxes and lines.
"""

import base64
import itertools
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.errors import is_interruption
from alpasim_plugin.log.images import encode_image, smaller

WIDTH_PX = 640
MOST_VALUES = 100  # of a plan
MOST_ROWS = 10_000  # of boxes, and of points of a line
NAME_LETTERS = 100
NUMBER_BYTES = 8  # of a coordinate, written
MOST_BYTES = 64 << 20  # of a rollout
FULL = f"not shown from here on: a rollout's {MOST_BYTES >> 20} MiB are full"
# How a value is shown: kind, prefix of its name, dtype, least shape, last size
KINDS: tuple[tuple[str, str, str, tuple[int, ...], int | None], ...] = (
    ("images", "", "uint8", (1, 1, 3), 3),
    ("boxes", "boxes", "", (1, 4), 4),
    ("lines", "line", "", (1, 2), None),
    ("heat", "", "", (4, 4), None),
)


def debug_row(debug: Mapping[str, Any]) -> dict[str, list[list[Any]]]:
    """Return what a policy reports about itself with one plan, by kind; each value follows its name.

    Text is shortened; images are JPEG and heat maps PNG in base64, a heat map followed by its least
    and its greatest value; boxes are ``(N, 4)`` x0, y0, x1, y1 in pixels of the first camera; lines
    are ``(N, 2)`` metres in the rig frame. Of what cannot be shown, the row says why.
    """
    row: dict[str, list[list[Any]]] = {
        kind: [] for kind in ("text", "images", "heat", "boxes", "lines")
    }
    for name, value in itertools.islice(debug.items(), MOST_VALUES):
        try:
            title = str(name)[:NAME_LETTERS]
            kind = kind_of(title, value)
            cells = _cells(kind, value)
        except BaseException as error:  # the value is the policy's, and may do anything
            if is_interruption(error):
                raise
            kind = "text"
            title = "debug"
            cells = [f"not shown: {type(error).__name__}"]
        row[kind].append([title, *cells])
    if len(debug) > MOST_VALUES:
        row["text"].append(["debug", f"not shown: {len(debug) - MOST_VALUES:,} more values"])
    return row


def size_of(row: Mapping[str, list[list[Any]]]) -> int:
    """Return about how many bytes a row takes."""
    cells = (cell for values in row.values() for value in values for cell in value)
    return sum(
        len(cell) if isinstance(cell, str) else NUMBER_BYTES * sum(map(len, cell)) for cell in cells
    )


def _cells(kind: str, value: Any) -> list[Any]:
    """Return a value as it is stored, without its name."""
    if kind == "text":
        return [_words(value)]
    array = np.asarray(value)
    if kind == "images":
        return [base64.b64encode(encode_image(smaller(array, WIDTH_PX), "jpeg", 76)).decode()]
    if kind == "heat":
        return _heat(array)
    whole_rows = array[np.isfinite(array).all(axis=1)]
    return [whole_rows[:, : 4 if kind == "boxes" else 2].astype(np.float64).round(3).tolist()]


def _heat(array: Any) -> list[Any]:
    """Return a heat map as PNG, yellow where values are high, clear where they are low or missing;
    and its ends.
    """
    ends = [f"{value:.3g}" for value in (np.nanmin(array), np.nanmax(array))]
    stride = -(-max(array.shape) // WIDTH_PX)
    small = array[::stride, ::stride]
    finite = np.where(np.isfinite(small), small, np.nan).astype(np.float64)
    low = np.nanmin(finite)
    high = np.nanmax(finite)
    share = np.nan_to_num((finite - low) / ((high - low) or 1.0))
    bgra = np.stack(
        [np.full_like(share, 40), 60 + 170 * share, 0 * share + 250, 200 * share], axis=2
    )
    png = cv2.imencode(".png", bgra.astype(np.uint8))[1].tobytes()
    return [base64.b64encode(png).decode(), *ends]


def kind_of(name: str, value: Any) -> str:
    """Return as what a value is shown: the first of `KINDS` that fits, else ``text``."""
    if not isinstance(value, np.ndarray | list | tuple):
        return "text"
    array = np.asarray(value)
    if array.ndim == 2 and len(array) > MOST_ROWS and array.shape[1] <= 4:
        return "text"
    if array.dtype.kind in "fiub" and array.size > 0 and np.isfinite(array).any():
        for kind, prefix, dtype, least, last in KINDS:
            if (
                name.startswith(prefix)
                and dtype in ("", array.dtype.name)
                and array.ndim == len(least)
                and all(np.greater_equal(array.shape, least))
                and last in (None, array.shape[-1])
            ):
                return kind
    return "text"


def _words(value: Any) -> str:
    """Write numbers, words and short lists; name anything else with its type."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if value is None or isinstance(value, str | int | np.generic):
        return str(value)[:300]
    if not isinstance(value, np.ndarray | list | tuple):
        return f"not shown: {type(value).__name__}"
    array = np.asarray(value)
    if array.dtype.kind in "fiubU" and array.size <= 12:
        return np.array2string(array, precision=3, separator=", ")
    return f"not shown: {type(value).__name__} of shape {array.shape}"
