"""What a card's kernels read of cameras with a lens: the rays of its pixels, its numbers, and the poses of
what is drawn, with the motions of a rolling shutter.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.types import F64, CameraSpec, FloatArray
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.constants import POSE_ANTIALIAS, POSE_SHIFT, POSE_SIZE, POSE_TURN
from alpasim_plugin.gaussians.lens_camera import (
    KEPT_LENSES,
    LensCamera,
    LensKey,
    lens_key,
    lens_rays,
    spec_of,
)
from alpasim_plugin.gaussians.raster.lens_motion import node_motions
from alpasim_plugin.gaussians.raster.lens_rays import LENS_BENDS, MOTION, camera_lens
from alpasim_plugin.gaussians.raster.lens_records import LONG, SHORT
from alpasim_plugin.gaussians.raster.stages import node_poses

if TYPE_CHECKING:
    from torch import Tensor

# float64 per node: its pose as of `constants`, by how much the camera moves in a shutter as the node sees
# it, the place of its motion (-1: it does not turn in the world), and by how many radians and metres things
# move in a shutter.
MOVED = POSE_SIZE
NODE_MOTION = MOVED + 3
MOVES_RAD = NODE_MOTION + 1
MOVES_M = NODE_MOTION + 2
LENS_POSE = MOVES_M + 1
RAY = 4  # planes of an image: direction x, y, z, and 1 where the lens sees anything


class PlacedNode(NamedTuple):
    """A cloud in a view.

    Attributes:
        T_world_node, T_world_start: ``(4, 4)`` at the middle of the shutter and at its start; None:
            the identity, and a node that stands.
        antialias_px2: See `GaussianCloud`.
    """

    T_world_node: FloatArray | None
    T_world_start: F64 | None
    antialias_px2: float


class LensNumbers(NamedTuple):
    """What kernels read of views through one lens.

    Attributes:
        poses: ``(N, LENS_POSE)`` of the nodes of all views.
        lenses: ``(V, LENS_SIZE)``.
        motions: ``(M, MOTION)`` of the nodes that turn, one of zeros where none does.
    """

    poses: F64
    lenses: F64
    motions: F64


def lens_numbers(
    views: Sequence[tuple[LensCamera, Sequence[PlacedNode]]], near_m: float
) -> LensNumbers:
    """Return what the kernels read of views.

    Raises:
        InputError: A transform is not rigid.
    """
    poses = [np.zeros((0, LENS_POSE))]
    motions = [np.zeros((0, MOTION))]
    lenses = []
    for camera, nodes in views:
        lens = camera_lens(camera)
        lenses.append(lens)
        placed, moving = _poses(camera, nodes, lens, near_m, sum(map(len, motions)))
        poses.append(placed)
        motions.append(moving)
    table = np.concatenate(motions) if sum(map(len, motions)) else np.zeros((1, MOTION))
    return LensNumbers(np.concatenate(poses), np.array(lenses), table)


def _poses(
    camera: LensCamera, nodes: Sequence[PlacedNode], lens: F64, near_m: float, before: int
) -> tuple[F64, F64]:
    """Return the poses of a view's nodes ``(N, LENS_POSE)`` and their motions ``(M, MOTION)``, which
    follow so many of other views.
    """
    T_world_nodes = [node.T_world_node for node in nodes]
    poses = node_poses(T_world_nodes, camera, near_m)
    poses[:, POSE_ANTIALIAS] = [node.antialias_px2 for node in nodes]
    starts = [node.T_world_start for node in nodes]
    numbers, moved, motions = node_motions(T_world_nodes, starts, camera, poses, lens)
    places = np.array(numbers, dtype=np.float64)
    places[places >= 0] += before
    moving = np.zeros((0, MOTION)) if motions is None else motions.reshape(-1, MOTION)
    turn_rad = np.linalg.norm(poses[:, POSE_TURN : POSE_TURN + 3], axis=1)
    shift_m = np.linalg.norm(poses[:, POSE_SHIFT : POSE_SHIFT + 3], axis=1)
    columns = [poses, np.reshape(moved, (-1, 3)), places, turn_rad, shift_m]
    return np.column_stack(columns), moving.astype(np.float64)


def with_lens(camera: PinholeCamera | LensCamera) -> LensCamera:
    """Return a camera of a launch whose others have a lens."""
    assert isinstance(camera, LensCamera), "views of one launch are all through a lens, or none is"
    return camera


def bends(lens: F64) -> bool:
    """Return whether a lens, ``(LENS_SIZE,)``, has tangential or thin prism terms."""
    return bool(lens[LENS_BENDS])


def record_length(rolls: bool) -> int:
    """Return how many numbers the record of a splat has."""
    return LONG if rolls else SHORT


def rays_on_device(camera: CameraSpec, device: str) -> Tensor:
    """Return the planes ``(RAY, H, W)`` float32 of what the pixels of a camera with a lens look along,
    on a device, kept for the next camera with that lens.
    """
    return _rays_on_device(lens_key(camera), device)


@lru_cache(maxsize=KEPT_LENSES)
def _rays_on_device(key: LensKey, device: str) -> Tensor:
    spec = spec_of(key)
    rays = lens_rays(spec)
    planes = np.empty((RAY, spec.height, spec.width), dtype=np.float32)
    planes[:3] = rays.ray.T.reshape(3, spec.height, spec.width)
    planes[3] = rays.visible.reshape(spec.height, spec.width)
    return upload(planes, device)
