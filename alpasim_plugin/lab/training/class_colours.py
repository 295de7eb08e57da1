"""Class-colour augmentation: replace the colours of cars on a drawn semantic map by those of
another class.

Training scenes contain mostly cars; a deployed fixer meets buses, cyclists and pedestrians. A
network that has never seen the colour of a class copies it into the image. The augmentation trains
on clips whose cars have the colours of another class.

The colour of a box pixel is a non-negative combination of its class's front and back colour, ``a *
front + b * back``, darker with distance. ``a`` and ``b`` are solved for and applied to the other
class's colours. Most lane markings and the grey box edges are not such combinations; untyped lane
lines are close to one, so pixels nearer to a marking's colour, at any brightness, are not changed.
"""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, U8
from alpasim_plugin.fixers.semantic_map.style import BOX_COLOURS, COLOURS

FROM = "car"
OTHERS = ("truck", "cyclist", "pedestrian", "other")
# levels; distance that rounding causes between a marking's pixel and its colour's line through
# black
PAINT_OFF = 1.0
OFF = 4.0  # tolerance of the fit, levels
OFF_SHARE = 0.06  # further tolerance, a share of the pixel's length


def swap_class_colours(sdmap: U8, kind: str) -> U8:
    """Return a semantic map with the cars in the colours of another class.

    Args:
        sdmap: ``(..., H, W, 3)`` drawn in the colours of `semantic_map.style.BOX_COLOURS`.
        kind: Class whose colours replace them.

    Returns:
        A new array; other pixels are unchanged.

    Raises:
        InputError: A class without colours.
    """
    if kind not in BOX_COLOURS:
        raise InputError(
            f"class {kind!r}: it has no colours",
            f"choose one of {', '.join(BOX_COLOURS)}",
        )
    # (2, 3): front, back
    old, new = (np.array(BOX_COLOURS[name], dtype=np.float32) for name in (FROM, kind))
    out = sdmap.copy()
    inked = sdmap.any(axis=-1)
    pixels = sdmap[inked].astype(np.float32)
    shares = pixels @ np.linalg.pinv(old)
    off = np.linalg.norm(pixels - shares @ old, axis=-1)
    length = np.linalg.norm(pixels, axis=-1)
    small = OFF / np.linalg.norm(old[0])  # rounding may make a zero share slightly negative
    mixed = (off <= OFF + OFF_SHARE * length) & (shares >= -small).all(axis=-1)
    mixed[mixed] = _paint_distance(pixels[mixed]) > np.maximum(off[mixed], PAINT_OFF)
    pixels[mixed] = np.clip(np.rint(shares[mixed] @ new), 0, 255)
    out[inked] = pixels.astype(np.uint8)
    return out


def _paint_distance(pixels: F32) -> F32:
    """Return the distance of pixels ``(N, 3)`` to the nearest marking colour at any brightness, in
    levels ``(N,)``.
    """
    colours = np.array(list(COLOURS.values()), dtype=np.float32)
    directions = colours / np.linalg.norm(colours, axis=1, keepdims=True)
    nearest = np.full(len(pixels), np.inf, dtype=np.float32)
    # One at a time: vectorised, it takes 18 times the memory of the map
    for direction in directions:
        nearest = np.minimum(
            nearest, np.linalg.norm(pixels - np.outer(pixels @ direction, direction), axis=1)
        )
    return nearest
