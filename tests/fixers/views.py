"""A pinhole camera, and small parts of maps for it to look at."""

import numpy as np

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Box, CameraSpec, LaneMap, Marking
from tests.camera_builders import ahead

AHEAD = ahead(0.0)
PIN = CameraSpec("pin", 256, 144, np.array([[128.0, 0, 128], [0, 128, 72], [0, 0, 1]]), AHEAD)
BIG = CameraSpec("big", 1280, 720, np.array([[640.0, 0, 640], [0, 640, 360], [0, 0, 1]]), AHEAD)
EMPTY = LaneMap({})
CAR = Box(4.5, 1.9, 1.6)


def at(x=0.0, y=0.0, z=1.5, yaw=0.0):
    """Pose of a camera that stands at x, y, z in the world and looks along the yaw."""
    return se2(x, y, yaw, z) @ AHEAD


def line(*points):
    return np.array(points, dtype=float)


def marked(*lines_and_paints):
    """A map of lane markings alone."""
    return LaneMap({}, markings=tuple(Marking(*pair) for pair in lines_and_paints))
