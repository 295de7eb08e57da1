"""What one render request says about where and when a camera looks."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import se3
from alpasim_plugin.core.types import F64
from alpasim_plugin.wire import common_pb2, sensorsim_pb2

DOING = "reading a render request"
QUAT_NORM_TOLERANCE = 1e-4  # of the squared norm, as AlpaSim checks it
MAX_SIDE_PX, MAX_PIXELS = 8192, 1 << 24
MAX_TIME_US = 2**62


@dataclass(frozen=True)
class View:
    """One requested frame.

    Attributes:
        scene_id, camera: What is looked at, and by which camera (its logical id).
        width, height: Requested pixels.
        start_us, t_us: Shutter start and end.
        T_world_camera: ``(2, 4, 4)`` at shutter start and end.
        objects: Pose of every dynamic object's box centre at shutter start and end, ``(2, 4, 4)`` by track id.
        lens: Digest of intrinsics and size: frames of one lens share a history.
        key: Digest of the whole request but the image format: equal keys are one frame.
    """

    scene_id: str
    camera: str
    width: int
    height: int
    start_us: int
    t_us: int
    T_world_camera: F64
    objects: Mapping[str, F64]
    lens: bytes
    key: bytes


def read_view(request: sensorsim_pb2.RGBRenderRequest) -> View:
    """Check a request and return its view.

    Raises:
        InputError: No size, one that no camera has, a shutter that ends before it starts, a pose that is not finite or whose quaternion
            is no unit quaternion, or a track twice.
    """
    camera = request.camera_intrinsics.logical_id
    what = f"scene {request.scene_id!r}, camera {camera!r} at {request.frame_end_us} us"
    sides = request.resolution_w, request.resolution_h
    if not (min(sides) > 0 and max(sides) <= MAX_SIDE_PX and sides[0] * sides[1] <= MAX_PIXELS):
        found = f"{request.resolution_w} x {request.resolution_h} pixels"
        raise InputError(DOING, what, found, f"ask for 1 to {MAX_SIDE_PX} pixels a side, and {MAX_PIXELS} in all")
    if not request.frame_start_us <= request.frame_end_us < MAX_TIME_US:
        found = f"a shutter from {request.frame_start_us} to {request.frame_end_us} us"
        raise InputError(DOING, what, found, "give microseconds that do not fall")
    objects = {o.track_id: read_pair(o.pose_pair, f"{what}, track {o.track_id!r}") for o in request.dynamic_objects}
    if len(objects) != len(request.dynamic_objects):
        raise InputError(DOING, what, "a track id twice", "send every dynamic object once")
    content = sensorsim_pb2.RGBRenderRequest()
    content.CopyFrom(request)
    content.ClearField("image_format")
    content.ClearField("image_quality")
    size = f"{request.resolution_w}x{request.resolution_h}".encode()
    return View(
        request.scene_id,
        camera,
        request.resolution_w,
        request.resolution_h,
        request.frame_start_us,
        request.frame_end_us,
        read_pair(request.sensor_pose, what),
        objects,
        _digest(request.camera_intrinsics.SerializeToString(deterministic=True) + size),
        _digest(content.SerializeToString(deterministic=True)),
    )


def read_pair(pair: sensorsim_pb2.PosePair, what: str) -> F64:
    """Return ``(2, 4, 4)`` of a pose pair; see `read_view`."""
    return np.stack([read_pose(pose, what) for pose in (pair.start_pose, pair.end_pose)])


def read_pose(pose: common_pb2.Pose, what: str) -> F64:
    """Return the ``(4, 4)`` matrix of a pose; see `read_view`."""
    v, q = pose.vec, pose.quat
    xyz, quat = np.array([v.x, v.y, v.z], dtype=np.float64), np.array([q.w, q.x, q.y, q.z], dtype=np.float64)
    square = float(quat @ quat)
    if not (np.isfinite(xyz).all() and abs(square - 1.0) <= QUAT_NORM_TOLERANCE):
        found = f"position {xyz.tolist()}, quaternion {quat.tolist()} with |q|^2 = {square:.6g}"
        raise InputError(DOING, what, found, "give finite positions and unit quaternions (w = 1 where there is no rotation)")
    return se3(xyz, quat / np.sqrt(square))


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).digest()
