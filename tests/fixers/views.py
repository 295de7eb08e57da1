"""A pinhole and an f-theta camera, and small parts of maps for them to look at."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Box, CameraSpec, FTheta, LaneMap
from alpasim_plugin.fixers.semantic_map.draw import FThetaCamera
from alpasim_plugin.fixers.semantic_map.prepare import MapExtras

# Camera axes in a rig that looks along x.
AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
PIN = CameraSpec("pin", 256, 144, np.array([[128.0, 0, 128], [0, 128, 72], [0, 0, 1]]), AHEAD)
FISH = FThetaCamera(
    "fish", 256, 144, 128.0, 72.0, FTheta((0.0, 1 / 122), (0.0, 122.0, 0.0, -4.0), 1.2)
)
EMPTY = LaneMap({})
CAR = Box(4.5, 1.9, 1.6)


def at(x=0.0, y=0.0, z=1.5, yaw=0.0):
    """Pose of a camera that stands at x, y, z in the world and looks along the yaw."""
    return se2(x, y, yaw, z) @ AHEAD


def line(*points):
    return np.array(points, dtype=float)


def fixed_lines(*lines):
    return MapExtras(lane_lines=tuple(lines))
