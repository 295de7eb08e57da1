"""What one render request says: where and when a camera looks, and through which lens.

Any lens is rendered by the pinholes that cover it, then resampled (`cameras.lens`). Where the asked
size is not that of the calibration, a pinhole scales per axis; an f-theta lens scales its principal
point per axis and its polynomial by the mean of both factors, as AlpaSim's own overlay does.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from alpasim_plugin.alpasim.server.lens_cache import lenses
from alpasim_plugin.cameras.lens import (
    DO_THIS,
    WIDEST_RAD,
    Lens,
    lens_of,
    place_in_lens,
    resized,
    sides_of,
)
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import se3
from alpasim_plugin.core.types import F32, F64, U8, CameraSpec
from alpasim_plugin.log.schema import read_lens, read_matrix
from alpasim_plugin.log.wire import common_pb2, sensorsim_pb2

QUAT_NORM_TOLERANCE = 1e-4  # of the squared norm, as AlpaSim checks it
MAX_SIDE_PX = 8192
MAX_PIXELS = 1 << 24
MAX_TIME_US = 2**62


@dataclass(frozen=True)
class View:
    """One requested frame.

    Attributes:
        scene_id, camera: What is looked at, and by which camera (its logical id).
        width, height: Requested pixels.
        start_us, t_us: Shutter start and end.
        T_world_camera: ``(2, 4, 4)`` at shutter start and end.
        objects: Pose of every dynamic object's box centre at shutter start and end, ``(2, 4, 4)``
            by track id.
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
        InputError: No size, one that no camera has, a shutter that ends before it starts, a pose
            that is not finite or whose quaternion is no unit quaternion, or a track twice.
    """
    camera = request.camera_intrinsics.logical_id
    title = f"scene {request.scene_id!r}, camera {camera!r} at {request.frame_end_us} us"
    sides = request.resolution_w, request.resolution_h
    if not (min(sides) > 0 and max(sides) <= MAX_SIDE_PX and sides[0] * sides[1] <= MAX_PIXELS):
        raise InputError(
            f"{title}: {request.resolution_w} x {request.resolution_h} pixels",
            f"ask for 1 to {MAX_SIDE_PX} pixels a side, and {MAX_PIXELS} in all",
        )
    if not request.frame_start_us <= request.frame_end_us < MAX_TIME_US:
        raise InputError(
            f"{title}: a shutter from {request.frame_start_us} to {request.frame_end_us} us",
            "give microseconds that do not fall",
        )
    objects = {
        o.track_id: read_pair(o.pose_pair, f"{title}, track {o.track_id!r}")
        for o in request.dynamic_objects
    }
    if len(objects) != len(request.dynamic_objects):
        raise InputError(f"{title}: a track id twice", "send every dynamic object once")
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
        read_pair(request.sensor_pose, title),
        objects,
        _digest(request.camera_intrinsics.SerializeToString(deterministic=True) + size),
        _digest(content.SerializeToString(deterministic=True)),
    )


def read_pair(pair: sensorsim_pb2.PosePair, title: str) -> F64:
    """Return ``(2, 4, 4)`` of a pose pair; see `read_view`."""
    return np.stack([read_pose(pose, title) for pose in (pair.start_pose, pair.end_pose)])


def read_pose(pose: common_pb2.Pose, title: str) -> F64:
    """Return the ``(4, 4)`` matrix of a pose; see `read_view`."""
    v = pose.vec
    q = pose.quat
    xyz = np.array([v.x, v.y, v.z], dtype=np.float64)
    quat = np.array([q.w, q.x, q.y, q.z], dtype=np.float64)
    square = float(quat @ quat)
    if not (np.isfinite(xyz).all() and abs(square - 1.0) <= QUAT_NORM_TOLERANCE):
        raise InputError(
            f"{title}: position {xyz.tolist()}, quaternion {quat.tolist()} with |q|^2 = {square:.6g}",
            "give finite positions and unit quaternions (w = 1 where there is no rotation)",
        )
    return se3(xyz, quat / np.sqrt(square))


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).digest()


def read_sides(spec: sensorsim_pb2.CameraSpec, width: int, height: int) -> tuple[Lens, ...]:
    """Return the lens of a request by the pinholes that cover it.

    Args:
        spec: Intrinsics at the calibrated size.
        width, height: Asked pixels.

    Raises:
        InputError: No intrinsics, values that make no lens, a windshield model, or a view of more
            than 110 degrees from the axis.
    """
    variant = ("sides", width, height)
    return lenses.get(spec, variant, lambda: sides_of(camera_of(spec, width, height)))


@dataclass(frozen=True, eq=False)
class Straight:
    """The pinhole that shows all that a lens sees, in as many columns as the lens's image has.

    Attributes:
        K: ``(3, 3)``.
        size: Its width and height.
        place: ``(height, width, 2)`` float32 place in the lens's image of every pixel; None where
            the lens is that pinhole.
    """

    K: F64
    size: tuple[int, int]
    place: F32 | None

    def image(self, lens_image: U8) -> U8:
        """Return the pinhole's image of the lens's ``(H, W, 3)``; black where the lens sees
        nothing.
        """
        if self.place is None:
            return lens_image
        return cv2.remap(
            lens_image, self.place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )


def straight_of(spec: sensorsim_pb2.CameraSpec, width: int, height: int) -> Straight:
    """Return the pinhole for the images ``(height, width)`` of a lens, as far as one plane can carry
    what it sees; see `read_sides`.
    """
    variant = ("straight", width, height)
    return lenses.get(spec, variant, lambda: _straight(spec, width, height))


def _straight(spec: sensorsim_pb2.CameraSpec, width: int, height: int) -> Straight:
    camera = camera_of(spec, width, height)
    if camera.lens is not None:
        widest_rad = min(camera.lens.max_angle_rad or WIDEST_RAD, WIDEST_RAD)
        camera = replace(camera, lens=replace(camera.lens, max_angle_rad=widest_rad))
    lens = lens_of(camera)
    if lens.resample is None:
        return Straight(lens.K, lens.cover, None)
    size = width, max(round(lens.cover[1] * width / lens.cover[0]), 1)
    K = np.diag([*(np.array(size) / lens.cover), 1.0]) @ lens.K
    pinhole = replace(lens, K=K, cover=size)
    place, is_visible = place_in_lens(camera, pinhole)
    place[~is_visible] = -1e6
    return Straight(K, size, place)


def camera_of(spec: sensorsim_pb2.CameraSpec, width: int, height: int) -> CameraSpec:
    """Return a request's camera at the asked size; see `read_sides`."""
    title = f"camera {spec.logical_id!r}"
    if spec.resolution_w == 0 or spec.resolution_h == 0:
        raise InputError(f"{title}: no calibrated resolution", "fill resolution_w and resolution_h")
    if width * height > MAX_PIXELS:
        raise InputError(
            f"{title}: {width} x {height} pixels", f"ask for at most {MAX_PIXELS} in all"
        )
    if spec.WhichOneof("external_distortion") is not None:
        raise InputError(
            f"{title}: a windshield model",
            "it cannot be rendered here: put a renderer that can behind --upstream",
        )
    lens = read_lens(spec, title)
    K = read_matrix(spec)
    if not (lens or (np.isfinite(K).all() and min(K[0, 0], K[1, 1]) > 0)):
        raise InputError(f"{title}: focal lengths {K[0, 0]:.4g}, {K[1, 1]:.4g}", DO_THIS)
    size = spec.resolution_w, spec.resolution_h
    return resized(CameraSpec(spec.logical_id, *size, K, np.eye(4), lens=lens), width, height)
