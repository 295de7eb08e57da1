"""What the detectors among the judges find in one frame: lane lines on the ground, and cuboids;
with the projection of a cuboid.

Lanes live in the rig frame (x forward, y left): the paper's ground frame with y forward and x right
is the same plane, its lateral axis turned. Cuboids live in the camera's axes (x right, y down, z
forward), as in the monocular detectors of mmdetection3d, but with the origin in the middle of the
box.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.map_types import F64

# Distances ahead at which lanes are compared: 3, 5 ... 59 m. The paper's 3, 5 ... 60 cannot end at
# 60 with a step of 2.
FORWARD_M: F64 = np.arange(3.0, 60.0, 2.0)
NEAREST_CORNER_M = 0.5  # a box with a corner nearer than this is dropped (paper)


@dataclass(frozen=True)
class Lane3D:
    """A lane line on the ground.

    Args:
        lateral_m: ``(29,)`` position to the left of the rig at `FORWARD_M`; NaN where the line is
            not visible.
        score: 0 to 1.
    """

    lateral_m: F64
    score: float


@dataclass(frozen=True)
class Cuboid:
    """A detected road user: centre, sizes and yaw in the camera's axes.

    Args:
        label: Class.
        score: 0 to 1.
        x_m, y_m, z_m: Middle of the box.
        length_m, height_m, width_m: Full sizes.
        yaw_rad: About the camera's y axis; 0: the length lies along x, a quarter turn to the right
            looks at the camera.
    """

    label: str
    score: float
    x_m: float
    y_m: float
    z_m: float
    length_m: float
    height_m: float
    width_m: float
    yaw_rad: float


def cuboid_corners(cuboid: Cuboid) -> F64:
    """Return the eight corners ``(8, 3)`` in the camera's axes."""
    signs = np.array([[(i >> 2 & 1) - 0.5, (i >> 1 & 1) - 0.5, (i & 1) - 0.5] for i in range(8)])
    c, s = np.cos(cuboid.yaw_rad), np.sin(cuboid.yaw_rad)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    sizes = np.array([cuboid.length_m, cuboid.height_m, cuboid.width_m])
    return np.asarray((signs * sizes) @ turn.T + np.array([cuboid.x_m, cuboid.y_m, cuboid.z_m]))


def hull_pixels(cuboid: Cuboid, K: F64) -> F64 | None:
    """Return the convex outline ``(N, 2)`` of a cuboid in the image, pixels; None where a corner is
    nearer than 0.5 m.
    """
    corners = cuboid_corners(cuboid)
    if corners[:, 2].min() < NEAREST_CORNER_M:
        return None
    uv = (corners @ K.T)[:, :2] / corners[:, 2:]
    return np.asarray(cv2.convexHull(uv.astype(np.float32))[:, 0], dtype=np.float64)
