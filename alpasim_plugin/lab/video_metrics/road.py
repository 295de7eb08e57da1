"""The road in an image, from its semantic map."""

from __future__ import annotations

import cv2
import numpy as np

from alpasim_plugin.core.types import U8, Bool
from alpasim_plugin.fixers.semantic_map.style import BOX_EDGE_PX, COLOURS, WIDTH_DEFINED_AT_PX

ON_THE_ROAD = (
    "road_boundary",
    "line_untyped",
    "line_white",
    "line_yellow",
    "line_other",
    "stop_line",
    "crosswalk",
    "road_marking",
    "intersection",
)
ALIKE = 0.999  # cosine between a pixel's colour and one of the map's, at any brightness
DARKEST = 12.0  # length of a colour, levels: rounding turns the direction of darker ones


def road_mask(sdmap: U8) -> Bool:
    """Return which pixels show the road, ``(T, H, W)``, by semantic maps ``(T, H, W, 3)``.

    The map draws the edges and the markings of the road, not its surface: a row's road lies between
    its outermost markings. Pixels of road users, signs and poles are left out. A frame without
    markings has no road.

    Example:
        >>> sdmap = np.zeros((1, 3, 8, 3), dtype=np.uint8)
        >>> sdmap[0, 1, [2, 6]] = COLOURS["road_boundary"]
        >>> road_mask(sdmap)[0].astype(int).tolist()
        [[0, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1, 1, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0, 0, 0]]
    """
    return np.stack([_road_of_frame(image) for image in sdmap])


def _road_of_frame(image: U8) -> Bool:
    width = image.shape[1]
    inked = image.any(axis=-1)
    marking = is_marking(image)
    other = inked & ~marking
    # The grey edges of a box have the direction of white paint: they lie beside its faces
    reach_px = int(np.ceil(BOX_EDGE_PX * width / WIDTH_DEFINED_AT_PX)) + 1
    kernel = np.ones((2 * reach_px + 1, 2 * reach_px + 1), dtype=np.uint8)
    near_other = cv2.dilate(other.astype(np.uint8), kernel).astype(bool)
    marking &= ~near_other
    columns = np.arange(width)
    first = np.argmax(marking, axis=1)[:, None]
    last = width - 1 - np.argmax(marking[:, ::-1], axis=1)[:, None]
    has_marking = np.any(marking, axis=1, keepdims=True)
    between: Bool = (columns >= first) & (columns <= last) & has_marking
    return between & ~other


def is_marking(image: U8) -> Bool:
    """Return which pixels ``(H, W)`` have the colour of something on the road, however faded."""
    colours = np.array([COLOURS[name] for name in ON_THE_ROAD], dtype=np.float32)
    colours /= np.linalg.norm(colours, axis=1, keepdims=True)
    pixels = image.astype(np.float32)
    length = np.linalg.norm(pixels, axis=-1)
    cosine = (pixels @ colours.T).max(axis=-1)
    alike: Bool = (length >= DARKEST) & (cosine >= ALIKE * length)
    return alike
