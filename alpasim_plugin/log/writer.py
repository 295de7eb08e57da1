"""Write a rollout as an ASL log that AlpaSim's own tools score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin import __version__
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import (
    interpolate,
    inverse,
    quat_from_matrix,
    se3,
    trajectory_from_poses,
)
from alpasim_plugin.core.types import F64, CameraSpec, EgoState, Frame, RenderRequest, Trajectory
from alpasim_plugin.log.asl import AslFile
from alpasim_plugin.log.images import ImageEncoding, encode_image
from alpasim_plugin.log.schema import (
    EGO,
    RolloutHeader,
    trajectory_bytes,
    wire_box,
    wire_camera,
    wire_dynamics,
    wire_image,
    wire_pose,
    wire_poses,
    wire_render_request,
    wire_traffic_session,
    wire_trajectory,
)
from alpasim_plugin.log.wire import (
    api_version,
    common_pb2,
    controller_pb2,
    egodriver_pb2,
    logging_pb2,
    sensorsim_pb2,
)

_SERVICES = ("runtime", "egodriver", "sensorsim", "physics", "traffic", "controller", "video_model")


class AslWriter:
    """Append the entries of one rollout, in the order AlpaSim's runtime writes them.

    ``begin`` first; then for every step ``render_request``, ``camera_image``, ``ego_trajectory``,
    ``route``, ``driver_request``, ``driver_return``, ``controller_request``, ``controller_return``
    and the ``actor_poses`` of the next instant; last ``finish``. Only ``begin``, ``actor_poses``
    and the driver pair are needed for scoring. Until ``finish`` the file is called ``PATH.part``.

    Example:
        >>> with AslWriter("rollout.asl", header) as log:  # doctest: +SKIP
        ...     log.begin(cameras)
        ...     log.actor_poses(t_us, T_world_rig, {"car": T_world_box})
    """

    def __init__(self, path: Path | str, header: RolloutHeader) -> None:
        """Open the log; the folder must exist.

        Raises:
            InputError: An actor bears the ego's name, or two actors the same one.
            InfrastructureError: The file cannot be created.
        """
        names = [actor.actor_id for actor in header.actors]
        if EGO in names or len(set(names)) < len(names):
            raise InputError(
                f"scene {header.scene_id!r}: actor ids {sorted({n for n in names if n == EGO or names.count(n) > 1})} are taken or repeated",
                f"give every actor an id of its own; {EGO!r} is the ego's",
            )
        self.header = header
        self._known = frozenset(names)
        self._uuid = header.session_uuid
        self._T_rig_box = header.T_rig_box
        self._file = AslFile(path)

    # --- start

    def begin(self, cameras: Sequence[CameraSpec]) -> None:
        """Write everything that precedes the first step; ``cameras`` are those that the policy
        receives.

        AlpaSim logs the poses at the first recorded ego pose too when it lies before the first
        frame; the road users' are those of their tracks.
        """
        header = self.header
        listed = [wire_camera(camera) for camera in cameras]
        self._write(rollout_metadata=self._metadata())
        self._write(
            available_cameras_request=sensorsim_pb2.AvailableCamerasRequest(
                scene_id=header.scene_id
            )
        )
        self._write(
            available_cameras_return=sensorsim_pb2.AvailableCamerasReturn(available_cameras=listed)
        )
        request = egodriver_pb2.DriveSessionRequest
        vehicle = request.RolloutSpec.VehicleDefinition(available_cameras=listed)
        self._write(
            driver_session_request=request(
                session_uuid=self._uuid,
                random_seed=header.seed,
                debug_info=request.DebugInfo(scene_id=header.scene_id),
                rollout_spec=request.RolloutSpec(vehicle=vehicle),
            )
        )
        self._write(traffic_session_request=wire_traffic_session(header))
        first_us = int(header.ego_log.t_us[0])
        if first_us < header.render_start_us:
            present = {
                actor.actor_id: interpolate(actor.track, first_us)
                for actor in header.actors
                if len(actor.track) and actor.track.t_us[0] <= first_us <= actor.track.t_us[-1]
            }
            self.actor_poses(first_us, se3(header.ego_log.xyz[0], header.ego_log.quat[0]), present)

    # --- each step

    def actor_poses(self, t_us: int, T_world_rig: F64, actors: Mapping[str, F64]) -> None:
        """Write ground-truth poses at one instant: the ego's rig pose, and ``T_world_box`` of the
        actors present.

        Raises:
            InputError: An actor that the header does not define, or a pose that is not finite.
        """
        unknown = set(actors) - self._known
        if unknown:
            raise InputError(
                f"actor poses at {t_us} us: actors {sorted(unknown)} are not in the header",
                "list every actor in RolloutHeader.actors; others are invisible to scorers",
            )
        ids = sorted(actors)
        poses = np.stack([*(actors[i] for i in ids), T_world_rig @ self._T_rig_box])
        messages = wire_poses(
            poses[:, :3, 3],
            quat_from_matrix(poses[:, :3, :3]),
            f"actors {[*ids, EGO]} at {t_us} us",
        )
        pose = logging_pb2.ActorPoses.ActorPose
        entries = [
            pose(actor_id=i, actor_pose=message)
            for i, message in zip([*ids, EGO], messages, strict=True)
        ]
        self._write(actor_poses=logging_pb2.ActorPoses(timestamp_us=t_us, actor_poses=entries))

    def render_request(self, request: RenderRequest, encoding: ImageEncoding = "png") -> None:
        """Write a render request, as a batch of one: AlpaSim sends batches by default."""
        item = sensorsim_pb2.BatchRGBRenderRequestItem(
            camera_name=request.camera.name,
            request=wire_render_request(self.header.scene_id, request, encoding),
        )
        self._write(batch_render_request=sensorsim_pb2.BatchRGBRenderRequest(items=[item]))

    def camera_image(
        self, frame: Frame, encoding: ImageEncoding = "png", shutter_us: int = 0
    ) -> None:
        """Write one frame as the driver received it."""
        start_us = frame.t_us - shutter_us
        data = encode_image(frame.rgb, encoding)
        image = wire_image(self._uuid, frame.camera, start_us, frame.t_us, data)
        self._write(driver_camera_image=image)

    def ego_trajectory(self, states: Sequence[EgoState]) -> None:
        """Write the ego states the driver learned since the last call; the first call carries the
        recorded context.
        """
        poses = np.stack([s.T_world_rig for s in states])
        trajectory = trajectory_from_poses([s.t_us for s in states], poses)
        self._write(
            driver_ego_trajectory=egodriver_pb2.RolloutEgoTrajectory(
                session_uuid=self._uuid,
                trajectory=wire_trajectory(trajectory, "ego states"),
                dynamic_states=[wire_dynamics(s) for s in states],
            )
        )

    def route(self, t_us: int, route_rig: F64) -> None:
        """Write the route ahead, ``(N, 3)`` in the rig frame; rows of NaN stand for its missing
        end.
        """
        points = [common_pb2.Vec3(x=x, y=y, z=z) for x, y, z in np.asarray(route_rig).tolist()]
        route = egodriver_pb2.Route(waypoints=points, timestamp_us=t_us)
        self._write(route_request=egodriver_pb2.RouteRequest(session_uuid=self._uuid, route=route))

    def driver_request(self, now_us: int, query_us: int) -> None:
        """Write the query to the driver at ``now_us`` for a plan through ``query_us`` (one control
        step later).
        """
        self._write(
            driver_request=egodriver_pb2.DriveRequest(
                session_uuid=self._uuid, time_now_us=now_us, time_query_us=query_us
            )
        )

    def driver_return(self, plan: Trajectory, samples: Sequence[Trajectory] = ()) -> None:
        """Write the driver's plan.

        Args:
            plan: Absolute rig poses in the world, the first at the time of the request; empty where
                the driver gave none.
            samples: Alternatives it considered, the same way; they feed minADE.
        """
        entry = logging_pb2.LogEntry()
        response = entry.driver_return
        first, *others = trajectory_bytes([plan, *samples], "the driver's plan and its samples")
        response.trajectory.MergeFromString(first)
        response.debug_info.SetInParent()
        for other in others:
            response.debug_info.sampled_trajectories.add().MergeFromString(other)
        self._file.write(entry)

    def controller_request(
        self, state: EgoState, plan: Trajectory, to_us: int, forced: bool = False
    ) -> None:
        """Write the request to the vehicle model: from `state`, along `plan` (absolute rig poses,
        world), to ``to_us``.

        Args:
            state: True state now.
            plan: Active plan; stored in the rig frame of its first pose, or empty.
            to_us: Time to reach.
            forced: The recording is forced, so the result is ignored.
        """
        if len(plan):
            poses = se3(plan.xyz, plan.quat)
            plan = trajectory_from_poses(plan.t_us, inverse(poses[0]) @ poses)
        entry = logging_pb2.LogEntry(
            controller_request=controller_pb2.RunControllerAndVehicleModelRequest(
                session_uuid=self._uuid,
                state=common_pb2.StateAtTime(
                    timestamp_us=state.t_us,
                    pose=wire_pose(state.T_world_rig, "ego state"),
                    state=wire_dynamics(state),
                ),
                future_time_us=to_us,
                coerce_dynamic_state=forced,
                pose_reporting_interval_us=self.header.control_us,
            )
        )
        packed = trajectory_bytes([plan], "the active plan")[0]
        entry.controller_request.planned_trajectory_in_rig.MergeFromString(packed)
        self._file.write(entry)

    def controller_return(self, state: EgoState) -> None:
        """Write the state the vehicle model reached; estimated equals true, as no pose error is
        modelled.
        """
        pose = wire_pose(state.T_world_rig, "ego state")
        dynamics = wire_dynamics(state)
        reached = controller_pb2.RunControllerAndVehicleModelResponse.PropagatedState(
            timestamp_us=state.t_us,
            pose_local_to_rig=pose,
            pose_local_to_rig_estimated=pose,
            dynamic_state=dynamics,
            dynamic_state_estimated=dynamics,
        )
        self._write(
            controller_return=controller_pb2.RunControllerAndVehicleModelResponse(states=[reached])
        )

    # --- end

    def finish(self) -> None:
        """Flush the log and give it its name."""
        self._file.finish()

    def abandon(self) -> None:
        """Close an unfinished log; it stays as ``PATH.part``."""
        self._file.abandon()

    def __enter__(self) -> AslWriter:
        return self

    def __exit__(self, *failure: object) -> None:
        self._file.__exit__(*failure)

    # --- messages

    def _write(self, **entry: Any) -> None:
        self._file.write(logging_pb2.LogEntry(**entry))

    def _metadata(self) -> logging_pb2.RolloutMetadata:
        header = self.header
        message = logging_pb2.RolloutMetadata
        box = message.ActorDefinitions.ActorAABB
        actors = [box(actor_id=EGO, aabb=wire_box(header.vehicle.box))]
        actors += [
            box(actor_id=actor.actor_id, aabb=wire_box(actor.box), actor_label=actor.label)
            for actor in header.actors
        ]
        return message(
            session_metadata=message.SessionMetadata(
                session_uuid=self._uuid,
                scene_id=header.scene_id,
                batch_size=1,
                n_sim_steps=header.n_steps,
                start_timestamp_us=int(header.ego_log.t_us[0]),
                control_timestep_us=header.control_us,
                render_start_timestamp_us=header.render_start_us,
            ),
            actor_definitions=message.ActorDefinitions(actor_aabb=actors),
            force_gt_duration=header.force_gt_us,
            version_ids=message.VersionIds(
                **{f"{name}_version": self._version(name) for name in _SERVICES}
            ),
            transform_ego_coords_rig_to_aabb=wire_pose(self._T_rig_box, "offset from rig to box"),
            ego_rig_recorded_ground_truth_trajectory=wire_trajectory(
                header.ego_log, "the recorded ego poses"
            ),
        )

    def _version(self, service: str) -> common_pb2.VersionId:
        version = self.header.versions.get(
            service, __version__ if service == "runtime" else "<skip>"
        )
        digest = self.header.digests.get(service, "")
        git_hash = "<skip>" if version == "<skip>" else digest
        return common_pb2.VersionId(
            version_id=version, git_hash=git_hash, grpc_api_version=api_version()
        )
