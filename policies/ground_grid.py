"""Inverse perspective mapping: a fixed grid of ground points and their pixels in the image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import PolicyError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F32, F64, U8, Bool, CameraSpec

FAR_M = 100.0
NEAR_M = 4.5
HALF_WIDTH_M = 8.0
CELL_M = 0.05
MAX_ROWS = 72


@dataclass(frozen=True)
class GroundGrid:
    """Rows across the road, about one per image row, so that no image row is read twice and none is skipped.

    The ground is the plane z = 0 of the rig. ``x_m`` grows with the row index, ``y_m`` falls with the column index (left to right as in
    the image).
    """

    x_m: F64  # (R,) metres, rig
    y_m: F64  # (C,) metres, rig, from +HALF_WIDTH_M down
    map_u: F32  # (R, C) pixel column of each ground point
    map_v: F32  # (R, C)
    inside: Bool  # (R, C) the point is in the image
    pixel_m: F64  # (R,) width of one pixel on the ground
    row_m: F64  # (R,) length of one grid row along the road
    camera_xz: tuple[float, float]  # metres, rig: where along the rig the camera stands, and how high
    camera_y: float  # metres, rig
    focal_px: float
    sight_index: npt.NDArray[np.intp]  # (R, U) column of the grid that image column u sees on each row

    def warp(self, image: U8) -> U8:
        """Return the image over the grid ``(R, C, 3)`` or ``(R, C)``; 0 outside the image."""
        return np.asarray(cv2.remap(image, self.map_u, self.map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0))

    def sight_column(self, y_m: F64, rows: npt.NDArray[np.intp]) -> F64:
        """Return the image columns ``(N, K)``, counted from the middle of `sight_index`, of lateral positions (N, K) on rows (N,)."""
        distance = (self.x_m - self.camera_xz[0])[rows][:, None]
        return np.asarray(self.sight_index.shape[1] / 2 - (y_m - self.camera_y) / distance * self.focal_px)

    def column_of(self, y_m: F64) -> F64:
        """Return fractional columns of lateral positions; may lie outside the grid."""
        return np.asarray((self.y_m[0] - y_m) / CELL_M)


def make_grid(camera: CameraSpec) -> GroundGrid:
    """Lay the grid for a camera.

    Raises:
        PolicyError: The camera does not see the ground between `NEAR_M` and `FAR_M` in front of the rear axle.
    """
    T_camera_rig = inverse(camera.T_rig_camera)
    x_camera, height = float(camera.T_rig_camera[0, 3]), float(camera.T_rig_camera[2, 3])
    near = max(NEAR_M, x_camera + 1.0)
    candidates = np.geomspace(near, FAR_M, 2000)
    rows_v = _project(camera, T_camera_rig, np.stack([candidates, 0 * candidates, 0 * candidates], axis=1))[:, 1]
    v = rows_v[[0, -1]]
    if height < 0.3 or not np.isfinite(v).all() or v[0] - v[1] < 8 or v[1] > camera.height - 8:
        raise PolicyError(
            "setting up the view of the road",
            f"camera {camera.name!r} {height:.2f} m above the ground",
            f"the ground from {near:.1f} to {FAR_M:.0f} m ahead falls on image rows {v[0]:.1f} to {v[1]:.1f} of {camera.height}",
            "give the policy a front camera that sees the road",
        )
    first, last = min(v[0], camera.height - 1.0), v[1]
    n = int(min(MAX_ROWS, max(first - last, 8) + 1))
    # Equal steps in the image row are steps of x^2 on the ground: each grid row has its own image row.
    x = np.asarray(np.interp(-np.linspace(first, last, n), -rows_v, candidates), dtype=np.float64)
    y = HALF_WIDTH_M - CELL_M * np.arange(round(2 * HALF_WIDTH_M / CELL_M) + 1, dtype=np.float64)
    points = np.stack([np.repeat(x, len(y)), np.tile(y, len(x)), np.zeros(len(x) * len(y))], axis=1)
    uv = _project(camera, T_camera_rig, points).reshape(len(x), len(y), 2)
    inside = (uv[..., 0] >= 0) & (uv[..., 0] <= camera.width - 1) & (uv[..., 1] >= 0) & (uv[..., 1] <= camera.height - 1)
    distance = x - x_camera
    f, y_camera = float(camera.K[0, 0]), float(camera.T_rig_camera[1, 3])
    column = np.arange(camera.width) + 0.5 - camera.width / 2
    sight = (HALF_WIDTH_M - y_camera + column[None, :] * distance[:, None] / f) / CELL_M
    return GroundGrid(
        x,
        y,
        uv[..., 0].astype(np.float32),
        uv[..., 1].astype(np.float32),
        inside,
        np.asarray(np.hypot(distance, height) / f, dtype=np.float64),
        np.asarray(np.gradient(x)),
        (x_camera, height),
        y_camera,
        f,
        np.clip(np.rint(sight), 0, len(y) - 1).astype(np.intp),
    )


def _project(camera: CameraSpec, T_camera_rig: F64, points: F64) -> F64:
    """Return pixel coordinates (N, 2) of rig points (N, 3); pixel centres at integers. NaN behind the camera."""
    at = points @ T_camera_rig[:3, :3].T + T_camera_rig[:3, 3]
    z = np.where(at[:, 2] > 0.1, at[:, 2], np.nan)
    uvw = at @ camera.K.T
    return np.asarray(uvw[:, :2] / z[:, None] - 0.5)
