"""Describe an ideal pinhole camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.gaussians.cloud import require_rigid
from alpasim_plugin.gaussians.constants import SLOPE_MARGIN


@dataclass(frozen=True, eq=False)
class Rolling:
    """A rolling shutter of a camera whose pose is that of the middle of the shutter.

    Attributes:
        T_camera_world_start: ``(4, 4)`` at shutter start.
        actors_start: Actor id to ``T_world_box`` at shutter start.
        time: ``(a, b, c)``: the pixel (u, v) is exposed ``a u + b v + c`` shutters after its middle.
        reach_px: By how many pixels things move at most.
    """

    T_camera_world_start: F64
    actors_start: Mapping[str, F64]
    time: tuple[float, float, float]
    reach_px: float


class Posed:
    """What is common to cameras at a pose, with or without a rolling shutter."""

    T_camera_world: F64
    rolling: Rolling | None

    @property
    def centre_world(self) -> F64:
        """Return the camera centre ``(3,)``, metres, world."""
        return -self.T_camera_world[:3, :3].T @ self.T_camera_world[:3, 3]

    def motion(self, T_world_node: F64, T_world_start: F64) -> F64:
        """Return how a node moves as the camera sees it while the shutter is open: a rotation
        vector and a shift, ``(6,)``; for each point p, ``turn x p + shift`` in a shutter.

        Args:
            T_world_node: ``(4, 4)`` at the middle of the shutter.
            T_world_start: ``(4, 4)`` at its start.
        """
        assert self.rolling is not None, "nothing moves in a global shutter"
        before = self.rolling.T_camera_world_start @ T_world_start
        M = before @ inverse(self.T_camera_world @ T_world_node)
        turn = cv2.Rodrigues(M[:3, :3])[0].ravel()
        shift = M[:3, 3] - 0.5 * np.cross(turn, M[:3, 3])
        return -2.0 * np.concatenate([turn, shift])  # half a shutter lies between


@dataclass(frozen=True, eq=False)
class PinholeCamera(Posed):
    """A pinhole camera in OpenCV axes: x right, y down, z forward; the centre of pixel (row i,
    column j) is (j + 0.5, i + 0.5).

    Attributes:
        width: Pixels.
        height: Pixels.
        K: ``(3, 3)`` intrinsics in pixels, no skew.
        T_camera_world: ``(4, 4)`` rigid transform that maps world points, metres, to camera points.
        whole: `slope_limits` of the image that this is a window of; None: it is a whole image.
        rolling: Its shutter; None: all pixels are exposed at once.

    Raises:
        InputError: A size below 1, intrinsics with skew or without positive focal lengths, or a
            transform that is not rigid.
    """

    width: int
    height: int
    K: F64
    T_camera_world: F64
    whole: tuple[float, float, float, float] | None = None
    rolling: Rolling | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.asarray(self.K, dtype=np.float64))
        object.__setattr__(
            self, "T_camera_world", np.asarray(self.T_camera_world, dtype=np.float64)
        )
        if self.width < 1 or self.height < 1:
            raise InputError(
                f"{self.width} x {self.height} pixels: no pixel",
                "give at least one",
            )
        k = self.K
        upper = (
            k.shape == (3, 3)
            and np.isfinite(k).all()
            and k[0, 1] == 0
            and k[1, 0] == 0
            and np.array_equal(k[2], [0, 0, 1])
        )
        if not upper or k[0, 0] <= 0 or k[1, 1] <= 0:
            raise InputError(
                "the intrinsics K" + ": " + np.array2string(k, separator=", ").replace("\n", ""),
                "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels with fx, fy > 0",
            )
        require_rigid(self.T_camera_world)

    @classmethod
    def from_pose(
        cls, width: int, height: int, K: npt.ArrayLike, T_world_camera: F64
    ) -> PinholeCamera:
        """Build a camera from its pose, the transform that maps camera points to the world."""
        return cls(
            width,
            height,
            np.asarray(K, dtype=np.float64),
            inverse(np.asarray(T_world_camera, dtype=np.float64)),
        )

    def window(self, rows: slice, columns: slice) -> PinholeCamera:
        """Return the camera of a part of the image: its pixels show what those of the whole
        do.
        """
        K = self.K.copy()
        K[:2, 2] -= columns.start, rows.start
        size = columns.stop - columns.start, rows.stop - rows.start
        return PinholeCamera(*size, K, self.T_camera_world, self.slope_limits())

    def widened(self, by_px: float) -> PinholeCamera:
        """Return the camera of an image with so many more pixels on each side."""
        more = int(np.ceil(by_px))
        return self.window(slice(-more, self.height + more), slice(-more, self.width + more))

    @property
    def fx(self) -> float:
        """Return the horizontal focal length, pixels."""
        return float(self.K[0, 0])

    @property
    def fy(self) -> float:
        """Return the vertical focal length, pixels."""
        return float(self.K[1, 1])

    @property
    def cx(self) -> float:
        """Return the principal point's column, pixels."""
        return float(self.K[0, 2])

    @property
    def cy(self) -> float:
        """Return the principal point's row, pixels."""
        return float(self.K[1, 2])

    def above_horizon(self) -> Bool:
        """Return which pixels ``(H, W)`` look up, towards +z of the world."""
        v, u = np.mgrid[0 : self.height, 0 : self.width] + 0.5
        up = self.T_camera_world[:3, 2]
        return (u - self.cx) / self.fx * up[0] + (v - self.cy) / self.fy * up[1] + up[2] > 0

    def unprojected(self, rows: I64, columns: I64, depth: F64) -> F64:
        """Return the points ``(N, 3)`` in the camera's axes that pixels show at depths ``(N,)``."""
        x = (columns + 0.5 - self.cx) / self.fx
        y = (rows + 0.5 - self.cy) / self.fy
        return np.column_stack([x * depth, y * depth, depth])

    def slope_limits(self) -> tuple[float, float, float, float]:
        """Return the bounds (x low, x high, y low, y high) of x/z and y/z inside the covariance's
        Jacobian.

        They lie 30 % of the half view outside the image's edges, so that splats just out of view do
        not become streaks.
        """
        if self.whole is not None:
            return self.whole
        margin_x = SLOPE_MARGIN * self.width / (2 * self.fx)
        margin_y = SLOPE_MARGIN * self.height / (2 * self.fy)
        return (
            -(self.cx / self.fx + margin_x),
            (self.width - self.cx) / self.fx + margin_x,
            -(self.cy / self.fy + margin_y),
            (self.height - self.cy) / self.fy + margin_y,
        )
