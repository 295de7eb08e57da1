"""What images of all stages are judged by alike."""

from __future__ import annotations

from alpasim_plugin.core.types import U8

BLACK_MAX = 10  # uint8 sRGB value, 0..255: an image is black when no channel of any pixel is above it; AlpaSim's img_is_black


def is_black(rgb: U8) -> bool:
    """Return whether every value of ``(H, W, 3)`` pixels is at most `BLACK_MAX`; an image without pixels is black.

    Example:
        >>> import numpy as np
        >>> is_black(np.full((4, 4, 3), 10, np.uint8)), is_black(np.full((4, 4, 3), 11, np.uint8))
        (True, False)
    """
    return int(rgb.max(initial=0)) <= BLACK_MAX
