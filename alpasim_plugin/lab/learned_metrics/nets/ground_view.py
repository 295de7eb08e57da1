"""The ground ahead of the rig as seen by a camera: the plane z = 0 on a grid of 1 m by 0.1 m, the
input of the lane judge.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F32, F64, U8, CameraSpec

ROWS, COLUMNS = 58, 216
ROW_M, COLUMN_M = 1.0, 0.1
FIRST_ROW_M = 2.5  # two rows lie around each of 3, 5 ... 59 m
HALF_WIDTH_M = COLUMNS * COLUMN_M / 2
CELL_M = 4 * COLUMN_M  # of the network's output


class GroundView:
    """A grid of ground points and their pixels.

    Args:
        camera: Lens and mounting.
        shift_m: The grid is moved so far to the left of the rig.
    """

    def __init__(self, camera: CameraSpec, shift_m: float = 0.0) -> None:
        x = FIRST_ROW_M + ROW_M * np.arange(ROWS)
        y = HALF_WIDTH_M - COLUMN_M * (np.arange(COLUMNS) + 0.5) + shift_m
        T = inverse(camera.T_rig_camera)
        at = (
            T[:3, 0] * x[:, None, None] + T[:3, 1] * y[None, :, None] + T[:3, 3]
        )  # (R, C, 3) camera axes
        ahead = at[..., 2] > 0.5
        uv = (at @ camera.K.T)[..., :2] / np.where(ahead, at[..., 2], 1.0)[
            ..., None
        ] - 0.5  # pixel centres at integers
        u, v = uv[..., 0], uv[..., 1]
        self.inside: F32 = (
            ahead
            & (u >= -0.5)
            & (u <= camera.width - 0.5)
            & (v >= -0.5)
            & (v <= camera.height - 0.5)
        ).astype(np.float32)
        self.map_u: F32 = np.where(ahead, u, -1e4).astype(np.float32)
        self.map_v: F32 = np.where(ahead, v, -1e4).astype(np.float32)

    def __call__(self, image: U8) -> F32:
        """Return ``(4, 58, 216)``: RGB in [-1, 1], 0 outside the image, and 1 where the point is
        inside.
        """
        seen = cv2.remap(
            image, self.map_u, self.map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).astype(np.float32)
        rgb = (seen / np.float32(127.5) - 1) * self.inside[..., None]
        return np.concatenate([np.moveaxis(rgb, -1, 0), self.inside[None]])


@lru_cache(maxsize=64)
def _cached(key: tuple[int, int, bytes, bytes]) -> GroundView:
    width, height, K, T = key
    lens: F64 = np.frombuffer(K, dtype=np.float64).reshape(3, 3)
    return GroundView(
        CameraSpec("camera", width, height, lens, np.frombuffer(T, dtype=np.float64).reshape(4, 4))
    )


def ground_view(camera: CameraSpec) -> GroundView:
    """Return the view of a camera, made once per lens and mounting."""
    K, T = (
        np.ascontiguousarray(m, dtype=np.float64).tobytes() for m in (camera.K, camera.T_rig_camera)
    )
    return _cached((camera.width, camera.height, K, T))
