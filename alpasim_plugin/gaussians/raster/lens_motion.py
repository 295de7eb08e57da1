"""How the nodes of a scene move while the shutter of a lens is open, as the kernels of a CPU and of a
card read it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from alpasim_plugin.core.types import F32, F64, FloatArray
from alpasim_plugin.gaussians.constants import POSE_SHIFT, POSE_TURN
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster.lens_rays import (
    LENS_SHIFT,
    MOTION,
    MOTION_SPEED,
    MOTION_TURN,
    node_motion,
)
from alpasim_plugin.gaussians.raster.stages import write_motion

STRAIGHT_RAD = 1e-5  # a road user that turns less in a shutter moves along a line


class NodeMotions(NamedTuple):
    """How nodes move.

    Attributes:
        numbers: Place of each node's own motion in ``motions``; -1: it does not turn in the world.
        moved: By how much the camera moves in a shutter as each sees it ``(3,)``, metres.
        motions: `lens_rays.node_motion` of those that turn, flat; one of zeros where none does, None
            of a global shutter.
    """

    numbers: list[int]
    moved: list[F64]
    motions: F32 | None


def node_motions(
    T_world_nodes: Sequence[FloatArray | None],
    starts: Sequence[F64 | None],
    camera: LensCamera,
    poses: F64,
    lens: F64,
) -> NodeMotions:
    """Return how nodes move, and write it into the numbers of their poses.

    Args:
        T_world_nodes: Poses at the middle of the shutter; None is the identity.
        starts: Those at its start; None, or fewer: the nodes stand.
        camera: Its shutter may be global.
        poses: Those of `stages.node_poses`.
        lens: `lens_rays.camera_lens`.
    """
    rolling = camera.rolling
    camera_shift = lens[LENS_SHIFT : LENS_SHIFT + 3].copy()
    if rolling is None:
        poses[:, POSE_TURN : POSE_SHIFT + 3] = 0.0
        count = len(T_world_nodes)
        return NodeMotions([-1] * count, [camera_shift] * count, None)
    starts = starts or [None] * len(T_world_nodes)
    write_motion(poses, T_world_nodes, starts, camera)
    numbers: list[int] = []
    moved: list[F64] = []
    motions: list[F32] = []
    for T, start in zip(T_world_nodes, starts, strict=True):
        number = -1
        shift = camera_shift
        if T is not None and start is not None:
            motion = node_motion(camera, rolling, np.asarray(T, dtype=np.float64), start)
            shift = camera_shift - motion[MOTION_SPEED : MOTION_SPEED + 3]
            if np.linalg.norm(motion[MOTION_TURN : MOTION_TURN + 3]) > STRAIGHT_RAD:
                number = len(motions)
                motions.append(motion)
        numbers.append(number)
        moved.append(shift)
    table = np.concatenate(motions) if motions else np.zeros(MOTION, dtype=np.float32)
    return NodeMotions(numbers, moved, table)
