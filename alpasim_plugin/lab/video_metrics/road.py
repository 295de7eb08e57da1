"""The road in an image, from its semantic map."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from alpasim_plugin.core.types import U8, Bool
from alpasim_plugin.fixers.semantic_map.style import (
    BOX_EDGE_PX,
    COLOURS,
    LINE_PX,
    WIDTH_DEFINED_AT_PX,
)

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
UPRIGHT = ("pole", "sign", "light_red", "light_yellow", "light_green")
ALIKE = 0.999  # cosine between a pixel's colour and one of the map's, at any brightness
AT_THE_SIDE_PX = 2  # columns in which an edge meets the side of the image
DARKEST = 12.0  # length of a colour, levels: rounding turns the direction of darker ones


def road_mask(sdmap: U8) -> Bool:
    """Return which pixels show the road, ``(T, H, W)``, by semantic maps ``(T, H, W, 3)``.

    The map draws the edges and the markings of the road, not its surface: a row's road lies between
    its outermost markings, and goes on to a side of the image in the rows below the one where the
    road's edge meets that side, unless another edge is seen in the same half. Pixels of road users,
    signs and poles are left out. A frame without markings has no road.

    Example:
        >>> sdmap = np.zeros((1, 3, 8, 3), dtype=np.uint8)
        >>> sdmap[0, 1, [2, 6]] = COLOURS["road_boundary"]
        >>> road_mask(sdmap)[0].astype(int).tolist()
        [[0, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1, 1, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0, 0, 0]]
    """
    return np.stack([_road_of_frame(image) for image in sdmap])


def _road_of_frame(image: U8) -> Bool:
    width = image.shape[1]
    faces = faces_of_boxes(image)
    # The grey edges of a box have the direction of white paint: they lie beside its faces
    reach_px = int(np.ceil(BOX_EDGE_PX * width / WIDTH_DEFINED_AT_PX)) + 1
    marking = is_marking(image) & ~_widened(faces, reach_px)
    columns = np.arange(width)
    has_marking = np.any(marking, axis=1, keepdims=True)
    first = np.argmax(marking, axis=1)[:, None]
    last = width - 1 - np.argmax(marking[:, ::-1], axis=1)[:, None]
    first = np.where(has_marking, first, width)
    last = np.where(has_marking, last, -1)
    edge = is_edge(image)
    from_left = _goes_on(edge)[:, None]
    to_right = _goes_on(edge[:, ::-1])[:, None]
    between: Bool = (from_left | (columns >= first)) & (to_right | (columns <= last))
    has_road = has_marking | (from_left & to_right)
    return between & has_road & ~faces & ~_alike(image, UPRIGHT)


def faces_of_boxes(image: U8) -> Bool:
    """Return the pixels ``(H, W)`` of road users: shapes as wide as no line, in other colours than the
    unmistakable ones of the road. Untyped lane lines have nearly the colour of a car.
    """
    unmistakable = tuple(name for name in ON_THE_ROAD if name != "line_untyped")
    shapes = (image.any(axis=-1) & ~_alike(image, unmistakable)).astype(np.uint8)
    line_px = LINE_PX * image.shape[1] / WIDTH_DEFINED_AT_PX
    side = max(int(np.ceil(2.0 * line_px)), 3)  # where two lines meet, they are twice as wide
    cores = cv2.erode(shapes, np.ones((side, side), dtype=np.uint8))
    return _widened(cores.astype(bool), side // 2) & shapes.astype(bool)


def _widened(pixels: Bool, by_px: int) -> Bool:
    kernel = np.ones((2 * by_px + 1, 2 * by_px + 1), dtype=np.uint8)
    widened: Bool = cv2.dilate(pixels.astype(np.uint8), kernel).astype(bool)
    return widened


def is_edge(image: U8) -> Bool:
    """Return which pixels ``(H, W)`` have the colour of the road's edge, magenta, or of its mixture with
    a white line beside it.
    """
    red, green, blue = np.moveaxis(image.astype(np.float32), -1, 0)
    alike = np.abs(red - blue) <= 0.2 * np.maximum(red, blue)
    is_bright = np.minimum(red, blue) >= DARKEST
    magenta: Bool = alike & is_bright & (green <= 0.75 * np.minimum(red, blue))
    return magenta & ~_alike(image, ("pole",))


def _goes_on(edge: Bool) -> Bool:
    """Return in which rows ``(H,)`` the road goes on to the left side of the image: those below the
    first that shows the road's edge ``(H, W)`` at that side, and no edge in the left half.
    """
    meets = np.any(edge[:, :AT_THE_SIDE_PX], axis=1)
    is_below = np.cumsum(meets) > 0
    is_road: Bool = is_below & ~np.any(edge[:, : edge.shape[1] // 2], axis=1)
    return is_road


def is_marking(image: U8) -> Bool:
    """Return which pixels ``(H, W)`` have the colour of something on the road, however faded."""
    return _alike(image, ON_THE_ROAD)


def _alike(image: U8, names: Sequence[str]) -> Bool:
    """Return which pixels ``(H, W)`` have one of the map's colours, however faded."""
    colours = np.array([COLOURS[name] for name in names], dtype=np.float32)
    colours /= np.linalg.norm(colours, axis=1, keepdims=True)
    pixels = image.astype(np.float32)
    length = np.linalg.norm(pixels, axis=-1)
    cosine = (pixels @ colours.T).max(axis=-1)
    alike: Bool = (length >= DARKEST) & (cosine >= ALIKE * length)
    return alike
