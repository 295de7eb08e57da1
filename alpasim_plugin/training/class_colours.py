"""Show actors in the colours of other classes on a semantic map that is drawn already.

Training scenes hold cars and few others, a deployed fixer meets buses, cyclists and people. A network that meets a class's colour for the
first time after training lets it shine through into the picture; so some clips are learned from with their cars in another class's colours.

A box's pixel is a mixture of its class's front and back colour, darker with distance: ``a * front + b * back`` with ``a, b >= 0``. The two
numbers are solved for and put to the other class's colours. Most paint and the grey edges of boxes lie outside the car's mixtures; lane
lines of no known type lie close to one, so whatever is nearer to a paint's colour, at any darkness, than to the mixtures stays.
"""

from __future__ import annotations

import numpy as np

from alpasim_plugin.errors import InputError
from alpasim_plugin.semantic_map.style import BOX_COLOURS, COLOURS
from alpasim_plugin.types import F32, U8

FROM = "car"
OTHERS = ("truck", "cyclist", "pedestrian", "other")
PAINT_OFF = 1.0  # levels; rounding alone takes a paint's pixel this far from its colour's line through black
OFF, OFF_SHARE = 4.0, 0.06  # a pixel may lie this far (levels, and share of its length) from a mixture of the two colours


def swap_class_colours(sdmap: U8, kind: str) -> U8:
    """Return a semantic map whose cars have the colours of another class.

    Args:
        sdmap: ``(..., H, W, 3)`` drawn in the colours of `map_style.BOX_COLOURS`.
        kind: Class whose colours they take.

    Returns:
        A new array; pixels that are no car's are equal bit for bit.

    Raises:
        InputError: A class without colours.
    """
    if kind not in BOX_COLOURS:
        raise InputError("recolouring a semantic map", f"class {kind!r}", "it has no colours", f"choose one of {', '.join(BOX_COLOURS)}")
    old, new = (np.array(BOX_COLOURS[name], np.float32) for name in (FROM, kind))  # (2, 3): front, back
    out = sdmap.copy()
    inked = sdmap.any(axis=-1)
    pixels = sdmap[inked].astype(np.float32)
    shares = pixels @ np.linalg.pinv(old)
    off = np.linalg.norm(pixels - shares @ old, axis=-1)
    length = np.linalg.norm(pixels, axis=-1)
    small = OFF / np.linalg.norm(old[0])  # rounding may make a share of nothing a little less
    mixed = (off <= OFF + OFF_SHARE * length) & (shares >= -small).all(axis=-1)
    mixed[mixed] = _paint_distance(pixels[mixed]) > np.maximum(off[mixed], PAINT_OFF)
    pixels[mixed] = np.clip(np.rint(shares[mixed] @ new), 0, 255)
    out[inked] = pixels.astype(np.uint8)
    return out


def _paint_distance(pixels: F32) -> F32:
    """Return how far pixels ``(N, 3)`` are from the nearest colour of a paint at some darkness, in levels ``(N,)``."""
    colours = np.array(list(COLOURS.values()), np.float32)
    directions = colours / np.linalg.norm(colours, axis=1, keepdims=True)
    nearest = np.full(len(pixels), np.inf, np.float32)
    for direction in directions:  # one at a time: all at once takes 18 times the memory of the map
        nearest = np.minimum(nearest, np.linalg.norm(pixels - np.outer(pixels @ direction, direction), axis=1))
    return nearest
