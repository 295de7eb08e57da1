"""Scenes and closed loops on painted roads, for tests of policies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.control import make_controller
from alpasim_plugin.core.geometry import (
    inverse,
    quat_from_yaw,
    trajectory_from_poses,
    transform_points,
    yaw_of,
)
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import (
    F64,
    U8,
    CameraSpec,
    EgoState,
    Frame,
    Observation,
    Plan,
    Route,
    Scenario,
    Trajectory,
    Vehicle,
)
from policies.conformance import canned_scenario
from policies.painted_road import PaintedRoad, pinhole_camera

CAMERA = pinhole_camera()
NO_ROUTE = np.full((20, 3), np.nan)


def scenario_with(camera: CameraSpec = CAMERA) -> Scenario:
    return canned_scenario((camera,))


def route_of(road: PaintedRoad, T_world_rig: F64, off_m: float = 0.0) -> F64:
    s, _ = road.coordinates(T_world_rig[0, 3], T_world_rig[1, 3])
    points = np.array([road.pose(float(s) + 80 / 19 * i, off_m)[:3, 3] for i in range(20)])
    return transform_points(inverse(T_world_rig), points)


def observe(
    rgb: U8,
    ego: EgoState,
    route_rig: F64 = NO_ROUTE,
    history: Trajectory | None = None,
    camera: CameraSpec = CAMERA,
    age_us: int = 0,
) -> Observation:
    past = history or trajectory_from_poses([ego.t_us], ego.T_world_rig[None])
    return Observation(
        ego.t_us,
        {camera.name: Frame(ego.t_us - age_us, camera.name, rgb)},
        {camera.name: camera},
        ego,
        past,
        route_rig,
    )


def look(
    policy: Policy,
    rgb: U8,
    speed_mps: float = 10.0,
    route_rig: F64 = NO_ROUTE,
    times: int = 6,
    camera: CameraSpec = CAMERA,
) -> Plan:
    """Show a still picture for a while to a policy that is told it stands still at that speed's
    plan, and return the last plan.
    """
    policy.reset(0, Route(np.zeros((2, 3))))
    for k in range(times):
        plan = policy.act(
            observe(rgb, EgoState(k * 100_000, np.eye(4), speed_mps), route_rig, camera=camera)
        )
    return plan


@dataclass
class Drive:
    """What happened: one entry per step."""

    s_m: F64
    offset_m: F64
    speed_mps: F64
    plans: list[Plan]


def close_loop(
    policy: Policy,
    road: PaintedRoad | Callable[[float], PaintedRoad],
    speed_mps: float,
    seconds: float,
    offset_m: float = 0.0,
    route_off_m: float = 0.0,
    with_route: bool = True,
    camera: CameraSpec = CAMERA,
    seed: int = 0,
) -> Drive:
    """Drive with the bicycle; ``road`` may depend on the time in seconds."""
    road_at = road if callable(road) else lambda _: road
    first = road_at(0.0)
    controller = make_controller("bicycle", Vehicle())
    ego = EgoState(0, first.pose(0.0, offset_m), speed_mps)
    policy.reset(seed, Route(np.array([first.pose(float(s))[:3, 3] for s in range(200)])))
    seen: list[EgoState] = []
    plans: list[Plan] = []
    for k in range(round(seconds * 10)):
        here = road_at(k * 0.1)
        seen.append(ego)
        history = trajectory_from_poses(
            [e.t_us for e in seen], np.array([e.T_world_rig for e in seen])
        )
        route = route_of(here, ego.T_world_rig, route_off_m) if with_route else NO_ROUTE
        plan = policy.act(
            observe(here.image(camera, ego.T_world_rig, seed=k), ego, route, history, camera)
        )
        plans.append(plan)
        ego = controller.advance(ego, to_world(plan, ego.T_world_rig), ego.t_us + 100_000)
    coordinates = [first.coordinates(e.T_world_rig[0, 3], e.T_world_rig[1, 3]) for e in seen]
    s, offset = np.array(coordinates, dtype=np.float64).T
    return Drive(s, offset, np.array([e.speed_mps for e in seen]), plans)


def to_world(plan: Plan, T_world_rig: F64) -> Trajectory:
    xyz = transform_points(T_world_rig, np.column_stack([plan.xy, np.zeros(len(plan.xy))]))
    return Trajectory(plan.times_us, xyz, quat_from_yaw(plan.yaw + yaw_of(T_world_rig)))
