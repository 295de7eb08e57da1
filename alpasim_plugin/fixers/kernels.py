"""A tiny case that makes numba compile the kernels of what a fixer reads: the semantic map, the cells of pixels."""

from __future__ import annotations

import numpy as np
import torch

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Box, CameraSpec, LaneMap
from alpasim_plugin.fixers.gather import gather_cells_cpu
from alpasim_plugin.nets.pixel_generator import CELL, PixelState
from alpasim_plugin.semantic_map.draw import draw_map
from alpasim_plugin.semantic_map.prepare import ActorBox, prepare_map

SIDE_PX = 16
AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # camera axes in a rig that looks along x


def draw_and_gather() -> None:
    """Draw a line and a car, and gather a picture's cells."""
    edge = np.array([[2.0, -1.0, 0.0], [9.0, 1.0, 0.0]])
    camera = CameraSpec("front", SIDE_PX, SIDE_PX, np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), AHEAD)
    car = ActorBox(se2(5.0, 0.0, 0.0, 0.8), Box(4.5, 1.9, 1.6), "car")
    draw_map(prepare_map(LaneMap({}, road_edges=(edge,))), camera, AHEAD, [car], threads=1)
    image = torch.zeros(1, SIDE_PX, SIDE_PX, 3)
    state = PixelState(image, image, image[:, ::CELL, ::CELL], image, image)
    gather_cells_cpu(image, image[..., :1], image, state, image + 1)
