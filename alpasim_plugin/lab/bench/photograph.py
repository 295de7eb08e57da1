"""A photograph of a drive at sides that fixers accept."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import U8, Photograph
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.renderers.recorded import photograph_camera, photograph_image

SIDE_PX = 16


def posed_photograph(
    photograph: Photograph, width: int, height: int | None = None
) -> tuple[PinholeCamera, U8]:
    """Read a photograph at sides that are multiples of 16, as fixers need; its height is cut at the
    middle.

    Args:
        photograph: The photograph.
        width: Pixels across at most, never more than it has.
        height: Pixels down at most; None keeps what there is.

    Returns:
        Its camera, and its image ``(H, W, 3)``.
    """
    whole = photograph_camera(photograph, min(width, photograph.width) // SIDE_PX * SIDE_PX)
    kept = max(SIDE_PX, min(height or whole.height, whole.height) // SIDE_PX * SIDE_PX)
    top = (whole.height - kept) // 2
    K = whole.K - np.array([[0, 0, 0], [0, 0, top], [0, 0, 0]])
    image = photograph_image(photograph, whole)[top : top + kept]
    return PinholeCamera(whole.width, kept, K, whole.T_camera_world), np.ascontiguousarray(image)
