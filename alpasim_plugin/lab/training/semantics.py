"""Class masks of a semantic map, recovered from its colours: labels for the semantic loss."""

from __future__ import annotations

from functools import cache

import numpy as np

from alpasim_plugin.core.types import F32, U8
from alpasim_plugin.fixers.semantic_map.style import BOX_COLOURS, COLOURS

CLASSES = (
    "boundary",
    "white line",
    "yellow line",
    "crosswalk",
    "stop line",
    "vehicle",
    "other road user",
)
_LINES = {
    "road_boundary": "boundary",
    "line_white": "white line",
    "line_untyped": "white line",
    "line_yellow": "yellow line",
    "crosswalk": "crosswalk",
    "stop_line": "stop line",
}
_BOXES = {
    "car": "vehicle",
    "truck": "vehicle",
    "pedestrian": "other road user",
    "cyclist": "other road user",
}
DARKEST = 24  # colours fade to black with distance; the hue of darker ones is unreliable


def class_masks(sdmap: U8, cell: int) -> F32:
    """Return the classes present in each cell of a semantic map.

    Args:
        sdmap: ``(H, W, 3)``; H and W are multiples of ``cell``.
        cell: Side of a cell, pixels.

    Returns:
        ``(len(CLASSES), H / cell, W / cell)`` of 0 and 1.
    """
    hues, classes = _prototypes()
    pixels = sdmap.reshape(-1, 3).astype(np.float32)
    value = pixels.max(axis=1, keepdims=True)
    lit = np.flatnonzero(value[:, 0] >= DARKEST)
    nearest = np.argmax(-((pixels[lit, None] / value[lit, None] - hues) ** 2).sum(-1), axis=1)
    h, w = sdmap.shape[:2]
    masks = np.zeros((len(CLASSES), h * w), dtype=np.float32)
    masks[classes[nearest], lit] = 1
    cells = masks.reshape(len(CLASSES), h // cell, cell, w // cell, cell)
    return np.asarray(cells.max(axis=(2, 4)))


@cache
def _prototypes() -> tuple[F32, np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """Return colours scaled to a largest channel of 1, ``(N, 3)``, and the class of each."""
    rows = [(np.array(COLOURS[key], dtype=np.float32), name) for key, name in _LINES.items()]
    for key, name in _BOXES.items():
        front, back = (np.array(colour, dtype=np.float32) for colour in BOX_COLOURS[key])
        rows += [(front + share * (back - front), name) for share in (0.0, 0.35, 0.7, 1.0)]
    hues = np.stack([colour / colour.max() for colour, _ in rows]).astype(np.float32)
    return hues, np.array([CLASSES.index(name) for _, name in rows], dtype=np.int64)
