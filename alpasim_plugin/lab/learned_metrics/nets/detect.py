"""Detections of the judges on a clip: arrays in, lanes and cuboids out; no tensor leaves, so
nothing is trained through a judge.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, U8, CameraSpec
from alpasim_plugin.lab.learned_metrics.nets.cuboid_net import decode
from alpasim_plugin.lab.learned_metrics.nets.ground_view import ground_view
from alpasim_plugin.lab.learned_metrics.nets.lane_net import join_lines
from alpasim_plugin.lab.learned_metrics.types import Cuboid, Lane3D

BATCH = 8  # frames at a time
MULTIPLE = 16  # of an image's sides, for the cuboid judge
LEAST_SCORE = 0.1  # of a box


def find_lanes(net: nn.Module, frames: U8, camera: CameraSpec) -> list[list[Lane3D]]:
    """Return the lanes of every frame ``(T, H, W, 3)`` of a camera; needs its mounting, since lanes
    live on the ground.

    Raises:
        InputError: Frames of another size than the camera's.
    """
    _require_size(frames, camera.width, camera.height)
    view, out = ground_view(camera), []
    with torch.inference_mode():
        for at in range(0, len(frames), BATCH):
            ground = np.stack([view(np.asarray(frame)) for frame in frames[at : at + BATCH]])
            out += [join_lines(cells) for cells in net(torch.from_numpy(ground)).numpy()]
    return out


def find_cuboids(net: nn.Module, frames: U8, K: F64) -> list[list[Cuboid]]:
    """Return the vehicles of every frame ``(T, H, W, 3)``, at the camera's own focal length; ``K``
    in pixels.

    Raises:
        InputError: Sides that are no multiples of 16.
    """
    if frames.shape[1] % MULTIPLE or frames.shape[2] % MULTIPLE:
        raise InputError(
            f"a clip: frames of {frames.shape[2]}x{frames.shape[1]}",
            f"give sides that are multiples of {MULTIPLE}",
        )
    out = []
    with torch.inference_mode():
        for at in range(0, len(frames), BATCH):
            images = (
                torch.from_numpy(np.array(frames[at : at + BATCH])).permute(0, 3, 1, 2).float()
                / 127.5
                - 1
            )
            out += [decode(cells, K, frames.shape[2], LEAST_SCORE) for cells in net(images).numpy()]
    return out


def _require_size(frames: U8, width: int, height: int) -> None:
    if frames.shape[1:3] != (height, width):
        raise InputError(
            f"a clip: frames of {frames.shape[2]}x{frames.shape[1]}, a camera of {width}x{height}",
            "give the camera that took the frames",
        )
