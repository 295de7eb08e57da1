"""Errors of the semantic map in training: pixels are the evidence, the map is a hint.

A map may be missing, lack its lane markings, lie beside the road, or be that of another
street. A fixer that has seen all of these believes a map only where the image agrees with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from alpasim_plugin.core.types import U8, Bool
from alpasim_plugin.fixers.semantic_map.style import COLOURS

Kind = Literal["true", "missing", "unpainted", "shifted", "other"]
CHANCES: dict[Kind, float] = {
    "true": 0.58,
    "missing": 0.12,
    "unpainted": 0.12,
    "shifted": 0.12,
    "other": 0.06,
}
SHIFT_PX = (8.0, 3.0)  # spread along x and y, at 256 pixels across
TURN_DEG = 1.5  # of the turn
ZOOM = 0.03  # of the scale's logarithm
PAINT = ("line_untyped", "line_white", "line_yellow", "line_other")
ALIKE = 0.985  # cosine between a pixel's colour and that of lane markings, at any brightness


@dataclass(frozen=True)
class MapError:
    """What is wrong with the map of an episode.

    Attributes:
        kind: See `CHANCES`; "other" shows the map of another sequence.
        shift_px: Of a shifted map, along x and y, at 256 pixels across.
        turn_deg, zoom: Of a shifted map, about the middle of the image.
    """

    kind: Kind
    shift_px: tuple[float, float]
    turn_deg: float
    zoom: float


def draw_map_error(rng: np.random.Generator) -> MapError:
    """Draw the error of an episode's map."""
    kind = list(CHANCES)[int(rng.choice(len(CHANCES), p=list(CHANCES.values())))]
    dx, dy, turn, zoom = rng.standard_normal(4)
    return MapError(
        kind, (SHIFT_PX[0] * dx, SHIFT_PX[1] * dy), TURN_DEG * turn, float(np.exp(ZOOM * zoom))
    )


def with_error(sdmap: U8, error: MapError) -> U8:
    """Return maps ``(T, H, W, 3)`` as the error shows them; that of another sequence is chosen by
    the caller.
    """
    if error.kind == "missing":
        return np.zeros_like(sdmap)
    if error.kind == "unpainted":
        return np.where(is_paint(sdmap)[..., None], np.uint8(0), sdmap)
    if error.kind != "shifted":
        return sdmap
    height, width = sdmap.shape[1:3]
    turned = cv2.getRotationMatrix2D((width / 2, height / 2), error.turn_deg, error.zoom)
    turned[:, 2] += np.array(error.shift_px) * width / 256
    return np.stack(
        [
            cv2.warpAffine(
                np.ascontiguousarray(image), turned, (width, height), flags=cv2.INTER_LINEAR
            )
            for image in sdmap
        ]
    )


def is_paint(sdmap: U8) -> Bool:
    """Return which pixels of maps ``(..., H, W, 3)`` show lane markings, at any brightness."""
    colour = sdmap.astype(np.float32)
    length = np.linalg.norm(colour, axis=-1)
    paint_colours = np.array([COLOURS[name] for name in PAINT], dtype=np.float32)
    paint_colours /= np.linalg.norm(paint_colours, axis=1, keepdims=True)
    alike = (colour @ paint_colours.T).max(axis=-1) > ALIKE * length
    painted: Bool = alike & (length > 0)
    return painted
