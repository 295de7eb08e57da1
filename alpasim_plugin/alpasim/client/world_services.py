"""AlpaSim's services that move the world in our loop: a vehicle, the ground, and the other road
users.

``--controller vdc://HOST:PORT``: AlpaSim's controller and vehicle model move the ego, and its
physics may set it on the ground. The service integrates a vehicle of its own from the first state
that a session gives it, so only the pose is sent back corrected, as AlpaSim's runtime does after
physics. The first call of a session begins at the hand-over with the true speed; AlpaSim's runtime
calls from the start, throws the answers away until the hand-over, and forces the recorded speed on
the vehicle meanwhile.

``--traffic HOST:PORT``: the road users that move are driven by AlpaSim's TrafficService; those that
stand stay where they are. The session gets the ego and every track, and the time of the hand-over.
Each request holds the ego's pose; the reply holds the poses of all other road users at that time,
and a road user without a pose is absent.
"""

from __future__ import annotations

import itertools
import os
import uuid
from collections.abc import Mapping
from typing import Any

import numpy as np

from alpasim_plugin.alpasim.client.channel import Address, Service
from alpasim_plugin.control.tracker import check_interval, check_plan, coast_to_stop
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.geometry import (
    interpolate,
    inverse,
    offset_trajectory,
    trajectory_from_poses,
)
from alpasim_plugin.core.interfaces import Controller
from alpasim_plugin.core.types import F64, EgoState, Scenario, Trajectory, Vehicle
from alpasim_plugin.log.schema import (
    EGO,
    T_rig_box,
    header_from_scenario,
    read_transform,
    wire_box,
    wire_dynamics,
    wire_pose,
    wire_traffic_session,
    wire_trajectory,
)
from alpasim_plugin.log.wire import common_pb2, controller_pb2, physics_pb2, traffic_pb2
from alpasim_plugin.world.actors import Actors

OPTIONS = ("physics", "scene", "timeout_s")
DOING = "asking an AlpaSim controller"
STEERED_MPS = 0.5  # below this speed a turn says nothing about the wheel
_SESSIONS = itertools.count()


class VdcController(Controller):
    """A vehicle behind AlpaSim's VDCService, and the ground behind its PhysicsService if one is
    named.

    Args:
        vehicle: Gives the ego's box to the physics service, and the brake while there is no plan.
        address: ``HOST:PORT[?physics=HOST:PORT&scene=ID&timeout_s=N]``.
        scene_id: By which the physics service knows the ground, unless the address names another
            one.

    A state that does not follow the last answer, such as that of a predicted future, opens a
    session of its own.
    """

    is_remote = True

    def __init__(self, vehicle: Vehicle, address: str, scene_id: str = "") -> None:
        place = Address.parse("vdc", address, OPTIONS)
        self._vehicle = vehicle
        self._timeout_s = float(place.options.get("timeout_s", "300"))
        self._service = Service("VDCService", place.target, InfrastructureError, retries=False)
        self._service.version()
        self._physics: Physics | None = None
        if "physics" in place.options:
            self._physics = Physics(
                place.options["physics"], place.options.get("scene", scene_id), vehicle
            )
        self.grounds = self._physics is not None
        self._session, self._expected_us = "", -1

    def advance(self, state: EgoState, plan: Trajectory | None, to_us: int) -> EgoState:
        """Return the state at ``to_us``; see `Controller.advance`.

        Raises:
            InfrastructureError: The service fails, or its answer has no state at ``to_us``.
        """
        if plan is None:
            return coast_to_stop(state, to_us, self._vehicle)
        check_interval(state, to_us)
        check_plan(plan)
        if state.t_us != self._expected_us:
            self._open()
        pose = common_pb2.StateAtTime(
            timestamp_us=state.t_us,
            pose=wire_pose(state.T_world_rig, "the ego"),
            state=wire_dynamics(state),
        )
        request = controller_pb2.RunControllerAndVehicleModelRequest(
            session_uuid=self._session,
            state=pose,
            planned_trajectory_in_rig=wire_trajectory(plan_in_rig(plan, state), "the plan"),
            future_time_us=to_us,
        )
        answer = self._service.call(
            "run_controller_and_vehicle", request, self._timeout_s, state.t_us
        )
        after = self._state(answer, to_us, state)
        self._expected_us = to_us
        return after if self._physics is None else self._physics.placed(state, after)

    def close(self) -> None:
        """Close the session, if one is open, and the channels."""
        try:
            self._close_session()
        finally:
            self._service.close()
            if self._physics is not None:
                self._physics.close()

    def _open(self) -> None:
        self._close_session()
        self._session = str(
            uuid.uuid5(
                uuid.NAMESPACE_URL, f"{self._service.target}/{os.getpid()}/{next(_SESSIONS)}"
            )
        )
        self._service.call(
            "start_session",
            controller_pb2.VDCSessionRequest(session_uuid=self._session),
            self._timeout_s,
        )

    def _close_session(self) -> None:
        if self._session:
            session, self._session, self._expected_us = self._session, "", -1
            self._service.call(
                "close_session",
                controller_pb2.VDCSessionCloseRequest(session_uuid=session),
                self._timeout_s,
            )

    def _state(
        self,
        answer: controller_pb2.RunControllerAndVehicleModelResponse,
        to_us: int,
        before: EgoState,
    ) -> EgoState:
        """Return the answer's last state; services before wire 0.50 fill the deprecated fields
        instead.
        """
        if answer.states:
            last = answer.states[-1]
            t_us = int(last.timestamp_us)
            pose = last.pose_local_to_rig
            moving = last.dynamic_state
        else:
            t_us = int(answer.pose_local_to_rig.timestamp_us)
            pose = answer.pose_local_to_rig.pose
            moving = answer.dynamic_state
        if t_us != to_us:
            raise InfrastructureError(
                f"{self._service.target}: a state at {t_us} us for {to_us} us",
                "make the service answer with the state at future_time_us",
            )
        speed, turn = float(moving.linear_velocity.x), float(moving.angular_velocity.z)
        steer = (
            float(np.arctan(self._vehicle.wheelbase_m * turn / speed))
            if abs(speed) > STEERED_MPS
            else before.steer_rad
        )
        T_world_rig = _sent(pose, "the controller's state", self._service)
        return EgoState(to_us, T_world_rig, speed, float(moving.linear_acceleration.x), turn, steer)


class Physics:
    """The ground behind AlpaSim's PhysicsService.

    Args:
        address: ``HOST:PORT``.
        scene_id: By which the service knows the ground.
        vehicle: The ego's box.

    Raises:
        InputError: The service does not have the scene.
    """

    def __init__(self, address: str, scene_id: str, vehicle: Vehicle) -> None:
        self._scene = scene_id
        self._service = Service(
            "PhysicsService",
            Address.parse("physics", address, ()).target,
            InfrastructureError,
            retries=False,
        )
        self._service.version()
        known = self._service.call("get_available_scenes", common_pb2.Empty()).scene_ids
        if "*" not in known and self._scene not in known:
            raise InputError(
                f"{self._service.target}: no scene {self._scene!r} among its {len(known)}: {', '.join(sorted(known)[:5])}",
                "name one of its own with &scene=ID",
            )
        self._aabb = wire_box(vehicle.box)
        self._T_rig_box = T_rig_box(vehicle)

    def placed(self, before: EgoState, after: EgoState) -> EgoState:
        """Return the state on the service's ground; where it finds none the pose stays, as in
        AlpaSim.
        """
        poses = trajectory_from_poses(
            [before.t_us, after.t_us], np.stack([before.T_world_rig, after.T_world_rig])
        )
        boxes = wire_trajectory(offset_trajectory(poses, self._T_rig_box), "the ego's box")
        ego = physics_pb2.PhysicsGroundIntersectionRequest.EgoData(
            aabb=self._aabb, ego_trajectory_aabb=boxes
        )
        request = physics_pb2.PhysicsGroundIntersectionRequest(
            scene_id=self._scene, now_us=before.t_us, future_us=after.t_us, ego_data=ego
        )
        answer = self._service.call("ground_intersection", request, at_us=after.t_us)
        there = {int(one.timestamp_us): one.pose for one in answer.ego_trajectory_aabb.poses}
        if after.t_us not in there:
            raise InfrastructureError(
                f"{self._service.target}: poses at {sorted(there)} us, none at {after.t_us} us",
                "see the service's own log",
            )
        box = _sent(there[after.t_us], "the box on the ground", self._service)
        return EgoState(
            after.t_us,
            box @ inverse(self._T_rig_box),
            after.speed_mps,
            after.accel_mps2,
            after.yaw_rate_radps,
            after.steer_rad,
        )

    def close(self) -> None:
        """Close the channel."""
        self._service.close()


def plan_in_rig(plan: Trajectory, state: EgoState) -> Trajectory:
    """Return a plan from now on in the rig's frame of now: its first pose is where it wants the ego
    now.

    AlpaSim's controller looks its first time up in its own past, so a plan that is older than the
    session must not be sent from its start.
    """
    now = min(max(state.t_us, int(plan.t_us[0])), int(plan.t_us[-1]))
    later = plan.t_us > state.t_us
    poses = np.concatenate(
        [interpolate(plan, np.array([now])), interpolate(plan, plan.t_us[later])]
    )
    return trajectory_from_poses(
        np.concatenate([[state.t_us], plan.t_us[later]]), inverse(state.T_world_rig) @ poses
    )


def _sent(pose: Any, what: str, service: Service) -> F64:
    """Read what a service sent; an invalid pose is its failure."""
    try:
        return read_transform(pose, what)
    except InputError as error:
        raise InfrastructureError(
            f"{service.target}: {error.message}", "see the service's own log"
        ) from error


class RemoteActors(Actors):
    """Road users of one rollout behind a traffic service. Forecasts, which blocks of frames need,
    follow the recorded tracks.

    Args:
        scenario: What is driven; its reactive drivers are left to the service.
        address: ``HOST:PORT``.
        seed: The rollout's.

    Raises:
        InputError: The service does not have the scene, or needs a longer past than the scenario
            gives it.
        InfrastructureError: Nothing answers there, or a call fails.
    """

    def __init__(self, scenario: Scenario, address: str, seed: int) -> None:
        super().__init__(scenario.actors, scenario.vehicle, scenario.end_us)
        self._start_us, self._T_rig_box = scenario.start_us, T_rig_box(scenario.vehicle)
        self._moving = {actor.actor_id for actor in scenario.actors if not actor.is_static}
        self.service = Service(
            "TrafficService",
            Address.parse("traffic", address, ()).target,
            InfrastructureError,
            retries=False,
        )
        self.service.wait_ready()
        self._check(scenario)
        self._session = str(
            uuid.uuid5(
                uuid.NAMESPACE_URL, f"{scenario.scene_id}/{seed}/{os.getpid()}/{next(_SESSIONS)}"
            )
        )
        header = header_from_scenario(scenario, self._session, seed & 0xFFFFFFFF, 0)
        self.service.call("start_session", wire_traffic_session(header))

    def step(self, t_us: int, ego: EgoState) -> Mapping[str, F64]:
        """Tell the service where the ego is and return everybody's pose at ``t_us``; the first step
        is that of the tracks.
        """
        poses = dict(super().step(t_us, ego))
        if t_us == self._start_us:
            return poses
        here = trajectory_from_poses([t_us], (ego.T_world_rig @ self._T_rig_box)[None])
        update = traffic_pb2.ObjectTrajectoryUpdate(
            object_id=EGO, trajectory=wire_trajectory(here, "the ego's box")
        )
        request = traffic_pb2.TrafficRequest(
            session_uuid=self._session, time_query_us=t_us, object_trajectory_updates=[update]
        )
        answer = self.service.call("simulate", request, at_us=t_us)
        standing = {
            actor_id: pose for actor_id, pose in poses.items() if actor_id not in self._moving
        }
        return standing | self._moved(answer, t_us)

    def close(self) -> None:
        """Close the session and the channel."""
        try:
            self.service.call(
                "close_session", traffic_pb2.TrafficSessionCloseRequest(session_uuid=self._session)
            )
        finally:
            self.service.close()

    def _check(self, scenario: Scenario) -> None:
        facts = self.service.call("get_metadata", common_pb2.Empty())
        past_us = scenario.start_us + scenario.warmup_us - int(scenario.ego_log.t_us[0])
        if facts.minimum_history_length_us > past_us:
            raise InputError(
                f"{self.service.target}: it needs {facts.minimum_history_length_us * 1e-06:g} s of the past, the scenario has {past_us * 1e-06:g} s at the hand-over",
                "lengthen timing.warmup_us, or start later in the recording",
            )
        known = self.service.call("get_available_scenes", common_pb2.Empty()).scene_ids
        if "*" not in known and scenario.scene_id not in known:
            raise InputError(
                f"{self.service.target}: no scene {scenario.scene_id!r} among its {len(known)}: {', '.join(sorted(known)[:5])}",
                "give the service that scene",
            )

    def _moved(self, answer: traffic_pb2.TrafficReturn, t_us: int) -> dict[str, F64]:
        """Return the poses at exactly ``t_us``; later ones are a forecast, which nobody here
        uses.
        """
        out: dict[str, F64] = {}
        for update in answer.object_trajectory_updates:
            if update.object_id == EGO:
                continue
            now = [one.pose for one in update.trajectory.poses if int(one.timestamp_us) == t_us]
            if update.object_id not in self._moving or not now:
                found = f"track {update.object_id!r} " + (
                    f"without a pose at {t_us} us"
                    if update.object_id in self._moving
                    else "is unknown"
                )
                raise InfrastructureError(
                    f"{self.service.target}: {found}", "see the service's own log"
                )
            try:
                out[update.object_id] = read_transform(
                    now[0], f"track {update.object_id!r} at {t_us} us"
                )
            except InputError as error:
                raise InfrastructureError(
                    f"{self.service.target}: {error.message}",
                    "see the service's own log",
                ) from error
        return out
