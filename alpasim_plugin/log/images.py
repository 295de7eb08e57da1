"""Encode and decode the camera images of a log."""

from typing import Literal

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import images
from alpasim_plugin.core.types import U8

ImageEncoding = Literal["png", "jpeg"]
COMPRESSION = cv2.IMWRITE_PNG_COMPRESSION, 1
STRATEGY = cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY
FILTER = cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG


def encode_image(rgb: U8, encoding: ImageEncoding = "png", quality: int = 95) -> bytes:
    """Encode ``(H, W, 3)`` uint8 sRGB; PNG is exact, JPEG keeps colour at full resolution.

    Raises:
        InputError: Not an HWC uint8 image.
    """
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
        raise InputError(
            f"array {rgb.shape} {rgb.dtype}: not (H, W, 3) uint8",
            "give an sRGB image as uint8",
        )
    options = {
        # A log is written while the loop runs. One filter for all rows, and no search for
        # repetitions, which rendered images hardly have, take less than half of the time of
        # libpng's own choices at its lowest level. Of filters that are as fast, averages leave
        # least.
        "png": [*COMPRESSION, *STRATEGY, *FILTER],
        "jpeg": [
            cv2.IMWRITE_JPEG_QUALITY,
            quality,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
        ],
    }[encoding]
    done, data = cv2.imencode(
        {"png": ".png", "jpeg": ".jpg"}[encoding], cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options
    )
    if not done:
        raise InputError(
            f"array {rgb.shape} as {encoding}: the encoder refused",
            "use a smaller image",
        )
    return data.tobytes()


def decode_image(data: bytes, name: str = "a camera image") -> U8:
    """Decode PNG or JPEG to ``(H, W, 3)`` uint8 sRGB. The size is the image's own, never the
    requested one.

    Raises:
        InputError: Not a whole image.
    """
    bgr = images.decode_image(data, name, "store PNG or JPEG images in the log")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def smaller(rgb: U8, width_px: int) -> U8:
    """Return an image no wider than this, with its shape kept."""
    height, width = rgb.shape[:2]
    if width <= width_px:
        return rgb
    size = (width_px, max(1, round(height * width_px / width)))
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
