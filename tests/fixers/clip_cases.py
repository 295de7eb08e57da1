"""Small clips shared by the tests of fixers."""

import cv2
import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import Frame

SIZE = (32, 48)  # height, width
STEP_US = 100_000


def moving_picture(
    count,
    size=SIZE,
    key="picture",
    holes=True,
    camera="front",
):
    """Return frames of a smooth texture that slides by, with a soft-edged hole in their opacity."""
    height, width = size
    texture = (
        stream("tests", 0, key).integers(0, 256, (height + 64, width + 64, 3)).astype(np.float32)
    )
    texture = cv2.normalize(
        cv2.GaussianBlur(texture, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX
    ).astype(np.uint8)
    out = []
    for i in range(count):
        y = (i * 1) % 64
        x = (i * 3) % 64
        alpha = np.ones(size, dtype=np.float32)
        if holes:
            alpha[: height // 2, : width // 3] = 0.0
            alpha[height // 2 :, : width // 6] = 0.5
        out.append(
            Frame(
                i * STEP_US,
                camera,
                np.ascontiguousarray(texture[y : y + height, x : x + width]),
                alpha,
            )
        )
    return out


def maps_of(frames):
    """Return a map per frame, different from the frame."""
    return [255 - frame.rgb[::-1].copy() for frame in frames]


def pixels(frames):
    return np.stack([frame.rgb for frame in frames])
