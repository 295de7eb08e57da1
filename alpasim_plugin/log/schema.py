"""Translate between our types and the messages of a rollout log.

Poses are float32 on the wire: metres keep 1 mm up to about 8 km from the local origin, so a log
must use a local origin. Times are integer microseconds in 64 bits and exact.
"""

import hashlib
import math
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import matrix_from_quat, quat_from_matrix, se3, shifted
from alpasim_plugin.core.types import (
    F64,
    Actor,
    Box,
    CameraSpec,
    EgoState,
    LensModel,
    RenderRequest,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.log.images import ImageEncoding
from alpasim_plugin.log.packed_poses import packed_trajectories, unpacked_trajectory
from alpasim_plugin.log.wire import common_pb2, egodriver_pb2, sensorsim_pb2, traffic_pb2

DIGEST_BITS = 58
EGO = "EGO"
QUAT_NORM_TOLERANCE = 1e-4  # on |q|^2, as AlpaSim's reader checks it
MAX_LOCAL_M = 1e5  # float32 steps are 7.8 mm there


def session_uuid(seed: int, identity: str) -> str:
    """Return the session id of a rollout, a UUID of version 8 (RFC 9562, section 5.8).

    AlpaSim pairs the rollouts of different scenes by the rank of their ids, so an id begins with
    the seed: rollouts of one seed have the same rank in every scene. The rest is a digest, so that
    ids differ between renderers, policies and scenes.

    Args:
        seed: The rollout's seed, 0 to 2^64 - 1.
        identity: Whatever determines the rollout; equal rollouts have equal ids.

    Example:
        >>> session_uuid(2, "a"), session_uuid(10, "a")
        ('00000000-0000-8000-8b2a-5e044b286ef7', '00000000-0000-8000-ab2a-5e044b286ef7')
    """
    digest = int.from_bytes(hashlib.sha256(identity.encode()).digest()) >> (256 - DIGEST_BITS)
    # Layout: 48 bits, version 8, 12 bits, variant 0b10, 62 bits; the seed's 64 bits come first
    # among the free ones.
    high = seed >> 16
    middle = (seed >> 4) & 0xFFF
    low = seed & 0xF
    return str(
        uuid.UUID(
            int=(high << 80)
            | (8 << 76)
            | (middle << 64)
            | (0b10 << 62)
            | (low << DIGEST_BITS)
            | digest
        )
    )


@dataclass(frozen=True)
class RolloutHeader:
    """State what a log says once, at its beginning.

    Attributes:
        scene_id: Scene, by which a scorer finds the map.
        session_uuid: Name of this rollout.
        vehicle: Ego body; gives the box and the offset from rig to box centre.
        actors: Everything that may appear; absent from here means invisible to scorers.
        ego_log: Recorded rig poses, world.
        render_start_us: First shutter close.
        force_gt_us: How long after it the recording is forced.
        control_us: Control period.
        n_steps: Number of control steps.
        seed: Rollout seed.
        versions: Version text by service (``runtime``, ``egodriver``, ``sensorsim``,
            ``controller``, ``physics``, ``traffic``, ``video_model``); services not named are
            logged as skipped.
        digests: Digest of a service's code, settings and weights, by service, where it has one.
    """

    scene_id: str
    session_uuid: str
    vehicle: Vehicle
    actors: tuple[Actor, ...]
    ego_log: Trajectory
    render_start_us: int
    force_gt_us: int
    control_us: int
    n_steps: int
    seed: int = 0
    versions: Mapping[str, str] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)

    @property
    def T_rig_box(self) -> F64:
        """Return the ``(4, 4)`` pose of the ego's box centre in the rig."""
        return T_rig_box(self.vehicle)


def T_rig_box(vehicle: Vehicle) -> F64:
    """Return the ``(4, 4)`` pose of a vehicle's box centre in its rig frame: a pure translation."""
    return shifted(vehicle.rear_axle_to_centre_m, 0.0, vehicle.box.height_m / 2)


# --- to the wire


def wire_poses(xyz: F64, quat: F64, name: str) -> list[common_pb2.Pose]:
    """Return one message a pose.

    Args:
        xyz: ``(N, 3)`` metres.
        quat: ``(N, 4)`` wxyz; normalised here.
        name: Whose poses, for the error.

    Raises:
        InputError: A value is not finite, a quaternion is zero, or a coordinate is too large for
            float32.
    """
    unit_quat = _checked_quats(xyz, quat, name)
    vec = common_pb2.Vec3
    rotation = common_pb2.Quat
    return [
        common_pb2.Pose(vec=vec(x=x, y=y, z=z), quat=rotation(w=w, x=qx, y=qy, z=qz))
        for (x, y, z), (w, qx, qy, qz) in zip(xyz.tolist(), unit_quat.tolist(), strict=True)
    ]


def _checked_quats(xyz: F64, quat: F64, name: str) -> F64:
    """Return quaternions ``(N, 4)`` of length 1, or refuse poses; see `wire_poses`."""
    norm = np.linalg.norm(quat, axis=-1, keepdims=True)
    near, long = np.abs(xyz) < MAX_LOCAL_M, (norm > 0) & (norm < np.inf)  # neither is true of NaN
    if not (near.all() and long.all()):
        i = int(np.argmin(near.all(axis=-1) & long[:, 0]))
        raise InputError(
            f"{name}: pose {i}: position {np.round(xyz[i], 3).tolist()}, quaternion {np.round(quat[i], 6).tolist()}",
            f"give finite poses within {MAX_LOCAL_M / 1000:.0f} km of the scene's local origin: the log stores them in float32",
        )
    return np.asarray(quat / norm, dtype=np.float64)


def wire_pose(transform: F64, name: str) -> common_pb2.Pose:
    """Return the message of one ``(4, 4)`` transform; see `wire_poses`, whose arithmetic it does
    without arrays.
    """
    x, y, z = transform[:3, 3].tolist()
    quat = quat_from_matrix(transform[:3, :3])
    w, qx, qy, qz = quat.tolist()
    norm = math.sqrt(w * w + qx * qx + qy * qy + qz * qz)
    is_near = abs(x) < MAX_LOCAL_M and abs(y) < MAX_LOCAL_M and abs(z) < MAX_LOCAL_M
    if not (is_near and 0.0 < norm < math.inf):  # neither is true of NaN
        return wire_poses(transform[None, :3, 3], quat[None], name)[0]  # which says what is wrong
    return common_pb2.Pose(
        vec=common_pb2.Vec3(x=x, y=y, z=z),
        quat=common_pb2.Quat(w=w / norm, x=qx / norm, y=qy / norm, z=qz / norm),
    )


def wire_trajectory(trajectory: Trajectory, name: str) -> common_pb2.Trajectory:
    """Return the message of a trajectory; see `wire_poses`."""
    return common_pb2.Trajectory.FromString(trajectory_bytes([trajectory], name)[0])


def trajectory_bytes(trajectories: Sequence[Trajectory], name: str) -> list[bytes]:
    """Return the serialised messages of trajectories; see `wire_poses`.

    A message of the log takes them by ``MergeFromString`` where they belong: one that is given to a
    constructor is copied.
    """
    xyz = np.concatenate([trajectory.xyz for trajectory in trajectories])
    quat = np.concatenate([trajectory.quat for trajectory in trajectories])
    t_us = np.concatenate([trajectory.t_us for trajectory in trajectories])
    if len(t_us) and t_us.min() < 0:
        raise InputError(
            f"{name}: a time of {t_us.min()} us", "a log's times are counted from zero upwards"
        )
    lengths = [len(trajectory) for trajectory in trajectories]
    return packed_trajectories(xyz, _checked_quats(xyz, quat, name), t_us, lengths)


def wire_dynamics(state: EgoState) -> common_pb2.DynamicState:
    """Return speeds and accelerations in the rig frame, for planar motion without side slip at the
    rear axle.
    """
    return common_pb2.DynamicState(
        angular_velocity=common_pb2.Vec3(z=state.yaw_rate_radps),
        linear_velocity=common_pb2.Vec3(x=state.speed_mps),
        linear_acceleration=common_pb2.Vec3(
            x=state.accel_mps2, y=state.speed_mps * state.yaw_rate_radps
        ),
        angular_acceleration=common_pb2.Vec3(),
    )


def wire_box(box: Box) -> common_pb2.AABB:
    """Return the message of a box."""
    return common_pb2.AABB(size_x=box.length_m, size_y=box.width_m, size_z=box.height_m)


def wire_camera(
    camera: CameraSpec, name: str | None = None
) -> sensorsim_pb2.AvailableCamerasReturn.AvailableCamera:
    """Return a camera with the pinhole that is really rendered, under its own name or another."""
    return sensorsim_pb2.AvailableCamerasReturn.AvailableCamera(
        intrinsics=wire_intrinsics(camera, name),
        rig_to_camera=wire_pose(camera.T_rig_camera, f"mounting of camera {camera.name!r}"),
        logical_id=name or camera.name,
    )


def wire_intrinsics(camera: CameraSpec, name: str | None = None) -> sensorsim_pb2.CameraSpec:
    """Return the intrinsics of a camera; of a pinhole all twelve distortion coefficients are
    stated, as zeros.
    """
    lens = camera.lens or LensModel("opencv")
    focal = {"focal_length_x": camera.K[0, 0], "focal_length_y": camera.K[1, 1]}
    middle = {"principal_point_x": camera.K[0, 2], "principal_point_y": camera.K[1, 2]}
    spec = sensorsim_pb2.CameraSpec(
        logical_id=name or camera.name,
        resolution_h=camera.height,
        resolution_w=camera.width,
        shutter_type=sensorsim_pb2.ROLLING_TOP_TO_BOTTOM
        if camera.shutter_us
        else sensorsim_pb2.GLOBAL,
    )
    if lens.kind == "opencv":
        k = [*lens.coefficients, *[0.0] * (12 - len(lens.coefficients))]
        opencv = sensorsim_pb2.OpenCVPinholeCameraParam(
            **focal,
            **middle,
            radial_coeffs=[*k[:2], *k[4:8]],
            tangential_coeffs=k[2:4],
            thin_prism_coeffs=k[8:],
        )
        spec.opencv_pinhole_param.CopyFrom(opencv)
    elif lens.kind == "fisheye":
        fisheye = sensorsim_pb2.OpenCVFisheyeCameraParam(
            **focal, **middle, radial_coeffs=lens.coefficients, max_angle=lens.max_angle_rad
        )
        spec.opencv_fisheye_param.CopyFrom(fisheye)
    else:
        kind = sensorsim_pb2.FthetaCameraParam
        c, d, e = lens.linear
        ftheta = kind(
            **middle,
            reference_poly=kind.PIXELDIST_TO_ANGLE
            if lens.pixel_to_angle
            else kind.ANGLE_TO_PIXELDIST,
            angle_to_pixeldist_poly=lens.coefficients,
            pixeldist_to_angle_poly=lens.pixel_to_angle,
            max_angle=lens.max_angle_rad,
        )
        ftheta.linear_cde.linear_c, ftheta.linear_cde.linear_d, ftheta.linear_cde.linear_e = c, d, e
        spec.ftheta_param.CopyFrom(ftheta)
    return spec


def wire_render_request(
    scene_id: str, request: RenderRequest, encoding: ImageEncoding, name: str | None = None
) -> sensorsim_pb2.RGBRenderRequest:
    """Return the message of one frame to render, of the request's camera under its own name or
    another.
    """
    camera = request.camera
    start, end = (wire_pose(T, f"pose of camera {camera.name!r}") for T in request.T_world_camera)
    objects = []
    if request.actors:
        ids = sorted(request.actors)
        first = request.actors if request.exposure is None else request.exposure.actors_start
        start_and_end = [
            wire_poses(stack[:, :3, 3], quat_from_matrix(stack[:, :3, :3]), f"actors {ids}")
            for stack in (np.stack([poses[i] for i in ids]) for poses in (first, request.actors))
        ]
        pair = sensorsim_pb2.PosePair
        objects = [
            sensorsim_pb2.DynamicObject(track_id=i, pose_pair=pair(start_pose=start, end_pose=end))
            for i, start, end in zip(ids, *start_and_end, strict=True)
        ]
    return sensorsim_pb2.RGBRenderRequest(
        scene_id=scene_id,
        resolution_h=camera.height,
        resolution_w=camera.width,
        camera_intrinsics=wire_intrinsics(camera, name),
        frame_start_us=request.t_us - camera.shutter_us,
        frame_end_us=request.t_us,
        sensor_pose=sensorsim_pb2.PosePair(start_pose=start, end_pose=end),
        dynamic_objects=objects,
        image_format=sensorsim_pb2.PNG if encoding == "png" else sensorsim_pb2.JPEG,
        image_quality=95,
    )


def wire_image(
    session_uuid: str, camera: str, start_us: int, end_us: int, data: bytes
) -> egodriver_pb2.RolloutCameraImage:
    """Return the message of one encoded frame; ``end_us`` is its time stamp."""
    image = egodriver_pb2.RolloutCameraImage.CameraImage(
        frame_start_us=start_us, frame_end_us=end_us, image_bytes=data, logical_id=camera
    )
    return egodriver_pb2.RolloutCameraImage(session_uuid=session_uuid, camera_image=image)


def wire_traffic_session(header: RolloutHeader) -> traffic_pb2.TrafficSessionRequest:
    """Return the message that opens a session of road users: the ego first, then every track, and
    when the service takes over.
    """
    quat = header.ego_log.quat
    xyz = header.ego_log.xyz + matrix_from_quat(quat) @ header.T_rig_box[:3, 3]
    ego = wire_trajectory(Trajectory(header.ego_log.t_us, xyz, quat), "the recorded ego")
    objects = [
        traffic_pb2.ObjectTrajectory(
            aabb=wire_box(header.vehicle.box), trajectory=ego, object_id=EGO, is_static=False
        )
    ]
    objects += [
        traffic_pb2.ObjectTrajectory(
            aabb=wire_box(actor.box),
            trajectory=wire_trajectory(actor.track, f"track of actor {actor.actor_id!r}"),
            object_id=actor.actor_id,
            is_static=actor.is_static,
            label_class=actor.label,
        )
        for actor in header.actors
    ]
    return traffic_pb2.TrafficSessionRequest(
        session_uuid=header.session_uuid,
        scene_id=header.scene_id,
        random_seed=header.seed,
        logged_object_trajectories=objects,
        handover_time_us=header.render_start_us + header.force_gt_us,
    )


# --- from the wire


def read_poses(poses: Iterable[common_pb2.Pose], name: str) -> tuple[F64, F64]:
    """Return positions ``(N, 3)`` and unit quaternions ``(N, 4)``, widened to float64.

    Raises:
        InputError: A value is not finite, or a squared quaternion norm is off 1 by more than 1e-4
            (an unset quaternion is all zero).
    """
    # Each attribute access makes a Python object, so vec and quat are fetched once a pose.
    rows = [(v.x, v.y, v.z, q.w, q.x, q.y, q.z) for v, q in ((p.vec, p.quat) for p in poses)]
    return _checked_poses(np.array(rows, dtype=np.float64).reshape(-1, 7), name)


def _checked_poses(table: F64, name: str) -> tuple[F64, F64]:
    """Return the positions and unit quaternions of rows ``(N, 7)``; see `read_poses`."""
    xyz = table[:, :3]
    quat = table[:, 3:]
    square = np.sum(quat * quat, axis=1)
    bad = ~(np.isfinite(xyz).all(axis=1) & (np.abs(square - 1.0) <= QUAT_NORM_TOLERANCE))
    if bad.any():
        i = int(np.argmax(bad))
        raise InputError(
            f"{name}: pose {i}: position {xyz[i].tolist()}, quaternion {quat[i].tolist()} with |q|^2 = {square[i]:.6g}",
            "write the log again with finite positions and unit quaternions (w = 1 where there is no rotation)",
        )
    return xyz, quat / np.sqrt(square)[:, None]


def read_trajectory(message: common_pb2.Trajectory, name: str) -> Trajectory:
    """Return a trajectory.

    Raises:
        InputError: Times do not increase strictly, or a pose is bad (see `read_poses`).
    """
    numbers = unpacked_trajectory(message)
    if numbers is None:
        t_us = increasing_times([pose.timestamp_us for pose in message.poses], name)
        xyz, quat = read_poses((pose.pose for pose in message.poses), name)
    else:
        table, times = numbers
        t_us = increasing_times(times.tolist(), name)
        xyz, quat = _checked_poses(table, name)
    return Trajectory(t_us, xyz, quat)


def increasing_times(times: Sequence[int], name: str) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return times ``(N,)`` int64.

    Raises:
        InputError: They do not increase strictly, or exceed 63 bits.
    """
    t_us = np.array(times, dtype=np.uint64)
    late = np.flatnonzero((t_us[1:] <= t_us[:-1]) | (t_us[1:] > np.iinfo(np.int64).max)) + 1
    if len(late):
        i = int(late[0])
        raise InputError(
            f"{name}: time {times[i]} us at index {i} after {times[i - 1]} us",
            "write the log again with strictly increasing times in microseconds",
        )
    return t_us.astype(np.int64)


def read_transform(pose: common_pb2.Pose, name: str) -> F64:
    """Return the ``(4, 4)`` transform of one pose; see `read_poses`."""
    xyz, quat = read_poses([pose], name)
    return se3(xyz[0], quat[0])


def read_lens(spec: sensorsim_pb2.CameraSpec, title: str) -> LensModel | None:
    """Return the lens that intrinsics describe; None of a pinhole.

    Raises:
        InputError: No intrinsics, or more coefficients than a lens has.
    """
    kind = spec.WhichOneof("camera_param")
    if kind == "opencv_pinhole_param":
        return _opencv(spec.opencv_pinhole_param, title)
    if kind == "opencv_fisheye_param":
        fisheye = spec.opencv_fisheye_param
        return LensModel("fisheye", tuple(fisheye.radial_coeffs), max_angle_rad=fisheye.max_angle)
    if kind == "ftheta_param":
        return _ftheta(spec.ftheta_param)
    raise InputError(
        f"{title}: no intrinsics",
        "fill ftheta_param, opencv_pinhole_param or opencv_fisheye_param",
    )


def _opencv(p: sensorsim_pb2.OpenCVPinholeCameraParam, title: str) -> LensModel | None:
    lengths = (p.radial_coeffs, 6), (p.tangential_coeffs, 2), (p.thin_prism_coeffs, 4)
    if any(len(coefficients) > n for coefficients, n in lengths):
        raise InputError(
            f"{title}: more coefficients than k1..k6, p1, p2, s1..s4",
            "give intrinsics that describe a lens",
        )
    k, t, s = ((*coefficients, *[0.0] * (n - len(coefficients))) for coefficients, n in lengths)
    if not any((*k, *t, *s)):
        return None
    return LensModel("opencv", (*k[:2], *t, *k[2:], *s))


def _ftheta(p: sensorsim_pb2.FthetaCameraParam) -> LensModel:
    forward = tuple(p.angle_to_pixeldist_poly)
    backward = tuple(p.pixeldist_to_angle_poly)
    linear = (1.0, 0.0, 0.0)
    if p.HasField("linear_cde"):
        linear = p.linear_cde.linear_c, p.linear_cde.linear_d, p.linear_cde.linear_e
    goes_back = p.reference_poly == sensorsim_pb2.FthetaCameraParam.PIXELDIST_TO_ANGLE
    if goes_back or not forward:
        return LensModel("ftheta", forward, backward, linear, p.max_angle)
    return LensModel("ftheta", forward, (), linear, p.max_angle)


def read_matrix(spec: sensorsim_pb2.CameraSpec) -> F64:
    """Return ``K`` ``(3, 3)`` of intrinsics; of an f-theta lens, whose polynomial is in pixels, with
    focal lengths of 1.

    Raises:
        InputError: No intrinsics.
    """
    kind = spec.WhichOneof("camera_param")
    if kind is None:
        raise InputError(
            f"camera {spec.logical_id!r}: no intrinsics",
            "fill ftheta_param, opencv_pinhole_param or opencv_fisheye_param",
        )
    p = getattr(spec, kind)
    focal = (1.0, 1.0)
    if kind != "ftheta_param":
        focal = p.focal_length_x, p.focal_length_y
    return np.array(
        [
            [focal[0], 0.0, p.principal_point_x],
            [0.0, focal[1], p.principal_point_y],
            [0.0, 0.0, 1.0],
        ]
    )


def read_camera(camera: sensorsim_pb2.AvailableCamerasReturn.AvailableCamera) -> CameraSpec | None:
    """Return a camera with its lens, or None where no `CameraSpec` can state what it sees: without
    intrinsics, or behind a windshield.

    Raises:
        InputError: More coefficients than a lens has, or a bad mounting.
    """
    spec = camera.intrinsics
    if spec.WhichOneof("camera_param") is None or spec.WhichOneof("external_distortion"):
        return None
    title = f"camera {camera.logical_id!r}"
    return CameraSpec(
        camera.logical_id,
        spec.resolution_w,
        spec.resolution_h,
        read_matrix(spec),
        read_transform(camera.rig_to_camera, f"mounting of {title}"),
        lens=read_lens(spec, title),
    )
