"""What a policy reports about itself in ``Plan.debug``, as rows of ``debug.jsonl``: text, images, heat
maps, boxes and lines.
"""

import base64
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.log.images import encode_image, smaller

WIDTH_PX = 640
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
    are ``(N, 2)`` metres in the rig frame.
    """
    row: dict[str, list[list[Any]]] = {
        kind: [] for kind in ("text", "images", "heat", "boxes", "lines")
    }
    for name, value in debug.items():
        kind = kind_of(name, value)
        array: Any = np.asarray(value) if kind != "text" else None
        if kind == "text":
            cells: list[Any] = [_words(value)]
        elif kind == "images":
            cells = [base64.b64encode(encode_image(smaller(array, WIDTH_PX), "jpeg", 76)).decode()]
        elif kind == "heat":
            ends = [f"{value:.3g}" for value in (np.nanmin(array), np.nanmax(array))]
            # Yellow where values are high, clear where they are low or missing.
            finite = np.where(np.isfinite(array), array, np.nan).astype(np.float64)
            low = np.nanmin(finite)
            high = np.nanmax(finite)
            share = np.nan_to_num((finite - low) / ((high - low) or 1.0))
            bgra = np.stack(
                [np.full_like(share, 40), 60 + 170 * share, 0 * share + 250, 200 * share], axis=2
            )
            cells = [
                base64.b64encode(cv2.imencode(".png", bgra.astype(np.uint8))[1].tobytes()).decode(),
                *ends,
            ]
        else:
            whole_rows = array[np.isfinite(array).all(axis=1)]
            cells = [
                whole_rows[:, : 4 if kind == "boxes" else 2].astype(np.float64).round(3).tolist()
            ]
        row[kind].append([str(name), *cells])
    return row


def kind_of(name: str, value: Any) -> str:
    """Return as what a value is shown: the first of `KINDS` that fits, else ``text``."""
    if not isinstance(value, np.ndarray | list | tuple):
        return "text"
    array = np.asarray(value)
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
