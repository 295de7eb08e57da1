"""What the log's cameras saw: which Gaussians a reconstruction could have learned, and where there
was sky.

A transparent pixel of a reconstruction is open sky or a hole; alpha alone cannot tell them apart.
Pipelines on recorded drives fill the sky from segmented log images (OneFixer, App. A). Here the log
views' own alpha is that segmentation. The sky is far away, so a view of it is carried to another
camera by rotation alone; within half the views' spacing the skyline moves by less than a pixel of
the small views beyond some 20 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F32, F64, I64, Bool
from alpasim_plugin.gaussians.camera import PinholeCamera

TOLERANCE, MARGIN_M = (
    0.06,
    0.3,
)  # a point this share of depth, plus this, behind the surface that was seen still counts as seen
EDGE_SHARE = 0.05  # a Gaussian just outside the image still shows in it
NEAR_M = 0.2


class LogView:
    """Depth as one log camera saw it.

    Args:
        camera: The camera, usually of small size.
        depth: ``(H, W)`` metres.
        alpha: ``(H, W)``; up to one half nothing hides what is behind: it is sky.
    """

    def __init__(self, camera: PinholeCamera, depth: F32, alpha: F32) -> None:
        self.camera = camera
        self.sky: F32 = (alpha <= 0.5).astype(np.float32)
        # The farthest surface of the neighbouring pixels: what shows beside an occluder's edge from
        # a metre on counts as seen.
        farthest = cv2.dilate(depth, np.ones((3, 3), dtype=np.uint8))
        self.limit: F32 = np.where(
            alpha > 0.5, farthest * (1 + TOLERANCE) + MARGIN_M, np.inf
        ).astype(np.float32)


class LogViews:
    """All log views, queried at once."""

    def __init__(self, views: Sequence[LogView]) -> None:
        self.views = tuple(views)
        cameras = [view.camera for view in self.views]
        self._T = np.array([c.T_camera_world[:3] for c in cameras]).reshape(-1, 3, 4)
        self._K = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras]).reshape(-1, 4)
        self._size = np.array([[c.width, c.height] for c in cameras], dtype=np.int64).reshape(-1, 2)
        self._first = np.concatenate([[0], np.cumsum(np.prod(self._size, axis=1))]).astype(np.int64)
        self._limit = (
            np.concatenate([view.limit.ravel() for view in self.views])
            if self.views
            else np.zeros(0, dtype=np.float32)
        )

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.views)

    def see(self, points: F64, size_m: F64) -> Bool:
        """Return which points ``(N, 3)`` of radius ``size_m (N,)`` any view saw; all of them where
        there is no view.
        """
        if not self.views:
            return np.ones(len(points), dtype=bool)
        seen = np.zeros(len(points), dtype=np.bool_)
        points, size_m = (
            np.ascontiguousarray(points, dtype=np.float64),
            np.ascontiguousarray(size_m, dtype=np.float64),
        )
        _see(points, size_m, self._T, self._K, self._size, self._first, self._limit, seen)
        return seen


@njit(cache=True, nogil=True)
def _see(
    points: F64, size_m: F64, T: F64, K: F64, size: I64, first: I64, limit: F32, seen: Bool
) -> None:
    """Test every point against the views in turn, beginning with the one that saw the point before
    it: neighbours share views.
    """
    n_views = T.shape[0]
    latest = 0
    for i in range(points.shape[0]):
        px = points[i, 0]
        py = points[i, 1]
        pz = points[i, 2]
        for k in range(n_views):
            j = (latest + k) % n_views
            z = T[j, 2, 0] * px + T[j, 2, 1] * py + T[j, 2, 2] * pz + T[j, 2, 3]
            if z <= NEAR_M:
                continue
            x = T[j, 0, 0] * px + T[j, 0, 1] * py + T[j, 0, 2] * pz + T[j, 0, 3]
            y = T[j, 1, 0] * px + T[j, 1, 1] * py + T[j, 1, 2] * pz + T[j, 1, 3]
            width, height = size[j, 0], size[j, 1]
            u, v = np.floor(K[j, 0] * x / z + K[j, 2]), np.floor(K[j, 1] * y / z + K[j, 3])
            edge = EDGE_SHARE * width
            if u < -edge or u >= width + edge or v < -edge or v >= height + edge:
                continue
            row = min(max(int(v), 0), height - 1)
            column = min(max(int(u), 0), width - 1)
            if z < limit[first[j] + row * width + column] + size_m[i]:
                seen[i] = True
                latest = j
                break


@dataclass(frozen=True, eq=False)
class SkyView:
    """Where one logged camera saw sky: ``sky (H, W)`` float32, 1 where it did."""

    camera: PinholeCamera
    sky: F32


class SkyMask:
    """Sky mask from the nearest log view of a similar direction.

    Args:
        views: Of cameras that may look in different directions; without any, nothing is sky.
    """

    def __init__(self, views: Sequence[LogView | SkyView]) -> None:
        self._views = tuple(views)
        T = np.array([inverse(view.camera.T_camera_world) for view in views]).reshape(-1, 4, 4)
        self._axes, self._eyes = T[:, :3, 2], T[:, :3, 3]  # (V, 3) world

    def share(self, camera: PinholeCamera) -> F32:
        """Return how much of every pixel ``(H, W)`` is sky, 0 to 1; beyond the view's border its
        outermost pixels go on.
        """
        if not self._views:
            return np.zeros((camera.height, camera.width), dtype=np.float32)
        T = inverse(camera.T_camera_world)
        R, eye = T[:3, :3], T[:3, 3]
        turned_away = self._axes @ R[:, 2] < 0.5
        nearest = int(np.argmin(np.linalg.norm(self._eyes - eye, axis=1) + 1e6 * turned_away))
        view = self._views[nearest]
        half = np.array(
            [[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]
        )  # the warp counts from pixel centres, cameras from the corner
        to_view = (
            np.linalg.inv(half)
            @ view.camera.K
            @ view.camera.T_camera_world[:3, :3]
            @ R
            @ np.linalg.inv(camera.K)
            @ half
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        warped = cv2.warpPerspective(
            view.sky,
            to_view,
            (camera.width, camera.height),
            flags=flags,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(warped, dtype=np.float32)
