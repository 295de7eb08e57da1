"""Read an ASL log of any writer into a `RolloutLog`.

Reads what AlpaSim's evaluation reads and ignores the rest. Nothing is ever unpickled: the driver's
unstructured debug bytes stay unread.
"""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.limits import BODY_M
from alpasim_plugin.core.types import Actor, Box, LoggedImage, LoggedPlan, RolloutLog, Trajectory
from alpasim_plugin.log.asl import AslReader
from alpasim_plugin.log.fields import ASL, take_newer_fields
from alpasim_plugin.log.schema import (
    EGO,
    increasing_times,
    read_camera,
    read_poses,
    read_trajectory,
    read_transform,
)
from alpasim_plugin.log.wire import common_pb2, egodriver_pb2, logging_pb2


@dataclass
class _Collected:
    """What one pass over the entries gathers."""

    path: Path
    metadata: logging_pb2.RolloutMetadata | None = None
    poses: dict[str, list[tuple[int, common_pb2.Pose]]] = field(default_factory=dict)
    requests: list[egodriver_pb2.DriveRequest] = field(default_factory=list)
    plans: list[LoggedPlan] = field(default_factory=list)
    images: list[LoggedImage] = field(default_factory=list)
    route: egodriver_pb2.Route = field(default_factory=egodriver_pb2.Route)
    static_ids: set[str] = field(default_factory=set)
    counts: Counter[str] = field(default_factory=Counter)
    newer: list[str] = field(default_factory=list)
    seed: int = 0
    info: dict[str, Any] = field(
        default_factory=lambda: {
            "empty_plans": 0,
            "terminated": False,
            "cameras": (),
            "other_cameras": (),
        }
    )


def read_asl(path: Path | str, images: bool = True) -> RolloutLog:
    """Read a rollout log.

    Args:
        path: The ``.asl`` file.
        images: Keep the encoded camera images; False saves their memory.

    Returns:
        The rollout. ``warnings`` lists a truncated last entry and fields, kinds of entries among
        them, of a newer version of the format; ``info``
        holds ``entries`` (count by kind), ``n_steps``, ``empty_plans`` and ``unanswered`` (drive
        requests without a plan), ``terminated`` (the driver ended the rollout), ``cameras``
        (`CameraSpec` of each with its lens), ``other_cameras`` (names of those that none states), ``versions``,
        ``digests`` (of what a service is made of, by service),
        and ``undefined_actors`` (poses of ids that the header does not define are left out).

    Raises:
        InputError: Missing, empty or damaged file, no metadata first, no ego poses, times that do
            not increase, or a bad quaternion.
    """
    path = Path(path)
    reader = AslReader(path)
    got = _Collected(path)
    for entry in reader:
        kind = entry.WhichOneof("log_entry") or "unknown"
        got.counts[kind] += 1
        if got.metadata is None and kind != "rollout_metadata":
            raise _bad(
                path, f"first entry is {kind}", "give a whole log: rollout_metadata comes first"
            )
        got.newer += take_newer_fields(entry)
        _collect(got, kind, entry)
        if kind == "driver_camera_image" and images:
            image = entry.driver_camera_image.camera_image
            got.images.append(
                LoggedImage(
                    image.logical_id, image.frame_start_us, image.frame_end_us, image.image_bytes
                )
            )
    warnings = [reader.truncated] if reader.truncated else []
    warnings += [f"{path}: {note}" for note in ASL.notes(got.newer)]
    return _assemble(got, tuple(warnings))


def _collect(got: _Collected, kind: str, entry: logging_pb2.LogEntry) -> None:
    """Keep what a rollout is made of; images are the caller's to keep."""
    if kind == "rollout_metadata":
        if got.metadata is not None:
            raise InputError(f"{got.path}: a second rollout_metadata", "give one rollout a file")
        got.metadata = entry.rollout_metadata
    elif kind == "actor_poses":
        t_us = entry.actor_poses.timestamp_us
        for pose in entry.actor_poses.actor_poses:
            got.poses.setdefault(pose.actor_id, []).append((t_us, pose.actor_pose))
    elif kind == "driver_request":
        got.requests.append(entry.driver_request)
    elif kind == "route_request":
        got.route = entry.route_request.route
    elif kind == "driver_return":
        _driver_return(got, entry.driver_return)
    elif kind == "driver_session_request":
        got.seed = entry.driver_session_request.random_seed
    elif kind == "traffic_session_request":
        objects = entry.traffic_session_request.logged_object_trajectories
        got.static_ids.update(
            trajectory.object_id for trajectory in objects if trajectory.is_static
        )
    elif kind == "available_cameras_return":
        cameras = entry.available_cameras_return.available_cameras
        specs = {camera.logical_id: read_camera(camera) for camera in cameras}
        got.info["cameras"] = tuple(spec for spec in specs.values() if spec is not None)
        got.info["other_cameras"] = tuple(name for name, spec in specs.items() if spec is None)


def _driver_return(got: _Collected, message: egodriver_pb2.DriveResponse) -> None:
    """Pair first in, first out; a response without poses is a driver that is not ready yet."""
    if not got.requests:
        raise InputError(
            f"{got.path}: a driver_return without a driver_request",
            "give a whole log",
        )
    request = got.requests.pop(0)
    if message.terminate_session:
        got.info["terminated"] = True
    if not message.trajectory.poses:
        got.info["empty_plans"] += 1
        return
    location = f"{got.path}, plan at {request.time_now_us} us"
    samples = tuple(
        read_trajectory(sample, f"{location}, sample {i}")
        for i, sample in enumerate(message.debug_info.sampled_trajectories)
    )
    got.plans.append(
        LoggedPlan(
            request.time_now_us,
            request.time_query_us,
            read_trajectory(message.trajectory, location),
            samples,
            np.array([[point.x, point.y] for point in got.route.waypoints]).reshape(-1, 2),
        )
    )


def _assemble(got: _Collected, warnings: tuple[str, ...]) -> RolloutLog:
    """Turn what was gathered into a `RolloutLog`."""
    path = got.path
    metadata = _checked_metadata(got)
    session = metadata.session_metadata
    actors = _defined_actors(got, metadata)
    return RolloutLog(
        scene_id=session.scene_id,
        session_uuid=session.session_uuid,
        ego_box=_box(metadata.actor_definitions.actor_aabb[0].aabb, path, EGO),
        T_rig_box=read_transform(
            metadata.transform_ego_coords_rig_to_aabb, f"{path}, offset from rig to box"
        ),
        ego=_track(got.poses[EGO], f"{path}, poses of {EGO}"),
        actors=actors,
        plans=tuple(got.plans),
        images=tuple(sorted(got.images, key=lambda image: image.end_us)),
        ego_log=read_trajectory(
            metadata.ego_rig_recorded_ground_truth_trajectory, f"{path}, recorded ego poses"
        ),
        start_us=session.start_timestamp_us,
        render_start_us=session.render_start_timestamp_us,
        force_gt_us=metadata.force_gt_duration,
        control_us=session.control_timestep_us,
        seed=got.seed,
        info=_info(got, metadata),
        warnings=warnings,
    )


def _checked_metadata(got: _Collected) -> logging_pb2.RolloutMetadata:
    """Return the metadata of a log that defines the ego first, and has poses of it.

    Raises:
        InputError: It is not so.
    """
    if got.metadata is None:
        raise _bad(got.path, "no rollout_metadata", "give a whole log")
    definitions = got.metadata.actor_definitions.actor_aabb
    if not definitions or definitions[0].actor_id != EGO:
        first = definitions[0].actor_id if definitions else "nothing"
        raise _bad(
            got.path,
            f"actor definitions begin with {first}",
            f"define {EGO} first: its size is read from there",
        )
    if EGO not in got.poses:
        raise _bad(
            got.path,
            f"no actor_poses of {EGO}",
            "run the rollout again; nothing can be scored without them",
        )
    return got.metadata


def _defined_actors(got: _Collected, metadata: logging_pb2.RolloutMetadata) -> dict[str, Actor]:
    """Return the road users that the metadata define behind the ego, and that have poses."""
    actors = {}
    for definition in metadata.actor_definitions.actor_aabb[1:]:
        actor_id = definition.actor_id
        if actor_id not in got.poses:
            continue
        actors[actor_id] = Actor(
            actor_id,
            definition.actor_label,
            _box(definition.aabb, got.path, actor_id),
            _track(got.poses[actor_id], f"{got.path}, poses of actor {actor_id!r}"),
            is_static=actor_id in got.static_ids,
        )
    return actors


def _info(got: _Collected, metadata: logging_pb2.RolloutMetadata) -> dict[str, Any]:
    """Return ``info`` of a log, see `read_asl`."""
    defined = {definition.actor_id for definition in metadata.actor_definitions.actor_aabb}
    versions = {
        member.name.removesuffix("_version"): version.version_id
        for member, version in metadata.version_ids.ListFields()
    }
    digests = {
        member.name.removesuffix("_version"): version.git_hash
        for member, version in metadata.version_ids.ListFields()
    }
    return {
        "entries": dict(got.counts),
        "n_steps": metadata.session_metadata.n_sim_steps,
        "unanswered": len(got.requests),
        "undefined_actors": tuple(sorted(set(got.poses) - defined)),
        "versions": versions,
        "digests": digests,
        **got.info,
    }


def _track(poses: list[tuple[int, common_pb2.Pose]], location: str) -> Trajectory:
    t_us = increasing_times([t for t, _ in poses], location)
    xyz, quat = read_poses((pose for _, pose in poses), location)
    return Trajectory(t_us, xyz, quat)


def _box(aabb: common_pb2.AABB, path: Path, actor: str) -> Box:
    """Return a box; sizes are float32 on the wire and shown with its seven digits, so that 4.855
    stays 4.855.
    """
    box = Box(
        *(
            float(np.format_float_positional(np.float32(size_m)))
            for size_m in (aabb.size_x, aabb.size_y, aabb.size_z)
        )
    )
    for side in (box.length_m, box.width_m):
        BODY_M.check(side, f"{path}, box of actor {actor!r}")
    return box


def _bad(path: Path, problem: str, do_this: str) -> InputError:
    return InputError(f"{path}: {problem}", do_this)
