"""AlpaSim's controller, physics and traffic services as remotes of our loop, over sockets, against
small servers of the same services.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from alpasim_plugin.alpasim.client.world_services import RemoteActors, VdcController, plan_in_rig
from alpasim_plugin.control import make_controller
from alpasim_plugin.control.tracker import PlanTracker
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.geometry import interpolate, se2, trajectory_from_poses
from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.types import EgoState, RolloutLog, Scenario, Trajectory
from alpasim_plugin.log.schema import read_trajectory, read_transform, wire_dynamics, wire_pose
from alpasim_plugin.log.wire import common_pb2, controller_pb2, physics_pb2, traffic_pb2
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.rollout import run_rollout
from scenarios.load import load_scenario
from tests.alpasim.service_cases import hosted

SHORT = ["timing.duration_us=1500000", "timing.warmup_us=300000"]


class Service:
    """What all of them answer."""

    scenes = ("*",)

    def __init__(self) -> None:
        self.calls: list[str] = []

    def get_version(self, request: Any, context: Any) -> common_pb2.VersionId:
        return common_pb2.VersionId(version_id="small")

    def get_available_scenes(self, request: Any, context: Any) -> common_pb2.AvailableScenesReturn:
        return common_pb2.AvailableScenesReturn(scene_ids=self.scenes)

    def start_session(self, request: Any, context: Any) -> common_pb2.SessionRequestStatus:
        self.calls.append("start")
        self.opened = request
        return common_pb2.SessionRequestStatus()

    def close_session(self, request: Any, context: Any) -> common_pb2.Empty:
        self.calls.append("close")
        assert request.session_uuid == self.opened.session_uuid
        return common_pb2.Empty()


class Vehicle(Service):
    """Our bicycle behind VDCService, as strict as AlpaSim's: its own time, its own speed, no plan
    before now.
    """

    def __init__(self, scenario: Scenario, deprecated: bool = False) -> None:
        super().__init__()
        self.tracker, self.deprecated, self.state = PlanTracker(scenario.vehicle), deprecated, None

    def start_session(self, request: Any, context: Any) -> common_pb2.SessionRequestStatus:
        self.state: EgoState | None = None
        return super().start_session(request, context)

    def run_controller_and_vehicle(
        self, request: Any, context: Any
    ) -> controller_pb2.RunControllerAndVehicleModelResponse:
        self.calls.append("run")
        given, moving = request.state, request.state.state
        pose = read_transform(given.pose, "state")
        if self.state is None:
            self.state = EgoState(
                given.timestamp_us, pose, moving.linear_velocity.x, 0.0, moving.angular_velocity.z
            )
        assert (
            self.state.t_us
            == given.timestamp_us
            == request.planned_trajectory_in_rig.poses[0].timestamp_us
        )
        plan = in_world(pose, read_trajectory(request.planned_trajectory_in_rig, "plan"))
        self.state = self.tracker.advance(
            replace(self.state, T_world_rig=pose), plan, request.future_time_us
        )
        wire, now = wire_pose(self.state.T_world_rig, "state"), self.state.t_us
        answer = controller_pb2.RunControllerAndVehicleModelResponse
        if self.deprecated:
            at = common_pb2.PoseAtTime(pose=wire, timestamp_us=now)
            return answer(pose_local_to_rig=at, dynamic_state=wire_dynamics(self.state))
        return answer(
            states=[
                answer.PropagatedState(
                    timestamp_us=now,
                    pose_local_to_rig=wire,
                    dynamic_state=wire_dynamics(self.state),
                )
            ]
        )


def in_world(T_world_rig: Any, plan: Trajectory) -> Trajectory:
    return trajectory_from_poses(plan.t_us, T_world_rig @ interpolate(plan, plan.t_us))


class Slope(Service):
    """A ground that rises by a tenth along x, whatever the scenario says."""

    def ground_intersection(
        self, request: Any, context: Any
    ) -> physics_pb2.PhysicsGroundIntersectionReturn:
        assert request.ego_data.aabb.size_x > 3.0
        out = physics_pb2.PhysicsGroundIntersectionReturn()
        for one in request.ego_data.ego_trajectory_aabb.poses:
            kept = out.ego_trajectory_aabb.poses.add()
            kept.CopyFrom(one)
            kept.pose.vec.z = 0.1 * one.pose.vec.x + 0.75
        return out


class Traffic(Service):
    """Replays the tracks, 2 m to the left from the hand-over on; leaves out what has no track
    then.
    """

    def get_metadata(self, request: Any, context: Any) -> traffic_pb2.TrafficModuleMetadata:
        return traffic_pb2.TrafficModuleMetadata(minimum_history_length_us=500_000)

    def simulate(self, request: Any, context: Any) -> traffic_pb2.TrafficReturn:
        self.calls.append("simulate")
        (ego,) = request.object_trajectory_updates
        t = request.time_query_us
        assert (ego.object_id, [p.timestamp_us for p in ego.trajectory.poses]) == ("EGO", [t])
        out = traffic_pb2.TrafficReturn()
        for one in self.opened.logged_object_trajectories[1:]:
            track = read_trajectory(one.trajectory, one.object_id)
            if one.is_static or not track.t_us[0] <= t <= track.t_us[-1]:
                continue
            pose = interpolate(track, t) @ se2(
                0.0, 2.0 if t > self.opened.handover_time_us else 0.0, 0.0
            )
            added = out.object_trajectory_updates.add(object_id=one.object_id).trajectory
            added.poses.add(timestamp_us=t, pose=wire_pose(pose, "answer"))
            added.poses.add(timestamp_us=t + 100_000, pose=wire_pose(pose, "a forecast"))
        return out


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("smoke/lead_car", overrides=SHORT)


def drive(scenario: Scenario, controller: Any = None, actors: Any = None) -> RolloutLog:
    policy = build(resolve("policy", "pure-pursuit"), scenario=scenario)
    with Recorder(scenario, 0, images="none") as recorder:
        run_rollout(scenario, Empty(), policy, 0, recorder, controller, actors)
    return recorder.log()


class Empty:
    """No camera is asked for."""

    def render(self, request: Any) -> Any:
        raise AssertionError("a policy without cameras")


@pytest.mark.parametrize("deprecated", [False, True])
def test_a_vehicle_behind_a_socket_drives_as_the_same_in_the_process(
    scenario: Scenario, deprecated: bool
) -> None:
    service = Vehicle(scenario, deprecated)
    with hosted({"VDCService": service}) as host:
        spec = resolve("controller", f"vdc://{host.address}")
        assert spec.digest is None  # remote: nothing says whether it is still the same
        remote = build(spec, vehicle=scenario.vehicle)
        outside = drive(scenario, remote)
        remote.close()
    inside = drive(scenario, make_controller("bicycle", scenario.vehicle))
    assert (
        np.abs(outside.ego.xyz - inside.ego.xyz).max() < 1e-4
    )  # the wheel's first angle is not on the wire, poses are float32
    assert np.abs(outside.ego.xyz[-1] - outside.ego.xyz[0]).max() > 8.0
    assert service.calls == ["start", *["run"] * 12, "close"]


def test_physics_sets_the_ego_on_its_ground(scenario: Scenario) -> None:
    services = {"VDCService": Vehicle(scenario), "PhysicsService": Slope()}
    with hosted(services) as host:
        remote = VdcController(
            scenario.vehicle, f"{host.address}?physics={host.address}", scenario.scene_id
        )
        rollout = drive(scenario, remote)
        remote.close()
        services["PhysicsService"].scenes = ("elsewhere",)
        with pytest.raises(InputError, match="no scene 'smoke-lead_car' among its 1: elsewhere"):
            VdcController(
                scenario.vehicle, f"{host.address}?physics={host.address}", scenario.scene_id
            )
    free = rollout.ego.t_us > scenario.start_us + scenario.warmup_us
    np.testing.assert_allclose(
        rollout.ego.xyz[free, 2], 0.1 * rollout.ego.xyz[free, 0] + 0.75, atol=1e-4
    )
    assert (
        np.abs(rollout.ego.xyz[~free, 2] - scenario.vehicle.box.height_m / 2).max() < 0.05
    )  # the recording's own ground


def test_a_traffic_service_moves_the_others(scenario: Scenario) -> None:
    service = Traffic()
    with hosted({"TrafficService": service}) as host:
        remote = RemoteActors(scenario, host.address, 7)
        rollout = drive(scenario, actors=remote)
        remote.close()
    own = drive(scenario)
    assert service.calls == ["start", *["simulate"] * 15, "close"]
    assert service.opened.random_seed == 7
    assert service.opened.logged_object_trajectories[0].object_id == "EGO"
    moving = next(actor.actor_id for actor in scenario.actors if not actor.is_static)
    a, b = rollout.actors[moving].track, own.actors[moving].track
    late = a.t_us > scenario.start_us + scenario.warmup_us
    np.testing.assert_allclose(a.xyz[~late], b.xyz[~late], atol=1e-4)
    assert (
        np.abs(np.linalg.norm(a.xyz[late] - b.xyz[late], axis=1) - 2.0).max() < 0.5
    )  # b reacts, a follows its track 2 m aside


def test_answers_that_are_none_are_the_services_failure(scenario: Scenario) -> None:
    class Late(Vehicle):
        def run_controller_and_vehicle(self, request: Any, context: Any) -> Any:
            answer = super().run_controller_and_vehicle(request, context)
            answer.states[-1].timestamp_us += 1
            return answer

    class Strange(Traffic):
        def simulate(self, request: Any, context: Any) -> Any:
            answer = super().simulate(request, context)
            answer.object_trajectory_updates.add(object_id="ghost")
            return answer

    class Forgetful(Traffic):
        def get_metadata(self, request: Any, context: Any) -> Any:
            return traffic_pb2.TrafficModuleMetadata(minimum_history_length_us=60_000_000)

    with hosted({"VDCService": Late(scenario), "TrafficService": Strange()}) as host:
        with pytest.raises(InfrastructureError, match="a state at 900001 us for 900000 us"):
            drive(scenario, VdcController(scenario.vehicle, host.address))
        with pytest.raises(InfrastructureError, match="track 'ghost' is unknown"):
            drive(scenario, actors=RemoteActors(scenario, host.address, 0))
    with (
        hosted({"TrafficService": Forgetful()}) as host,
        pytest.raises(InputError, match="needs 60 s of the past"),
    ):
        RemoteActors(scenario, host.address, 0)


def test_a_plan_is_sent_from_now_on_in_the_rigs_frame_of_now() -> None:
    x = np.arange(5.0)
    plan = Trajectory(
        100_000 * np.arange(5, dtype=np.int64),
        np.column_stack([x, 0 * x, 0 * x]),
        np.tile([1.0, 0, 0, 0], (5, 1)),
    )
    for now, want in ((150_000, [150_000, 200_000, 300_000, 400_000]), (500_000, [500_000])):
        state = EgoState(now, se2(1.5, 1.0, np.pi / 2), 5.0)
        sent = plan_in_rig(plan, state)
        assert sent.t_us.tolist() == want
    assert plan_in_rig(plan, EgoState(150_000, se2(1.5, 1.0, np.pi / 2), 5.0)).xyz[
        1
    ].tolist() == pytest.approx([-1.0, -0.5, 0.0])
