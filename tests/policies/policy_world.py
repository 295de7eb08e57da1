"""Scenes and closed loops on painted roads, for tests of policies."""

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
from alpasim_plugin.core.types import (
    F64,
    EgoState,
    Frame,
    Observation,
    Plan,
    Route,
    Trajectory,
    Vehicle,
)
from policies.conformance import canned_scenario
from policies.painted_road import pinhole_camera

CAMERA = pinhole_camera()
NO_ROUTE = np.full((20, 3), np.nan)


def scenario_with(camera=CAMERA):
    return canned_scenario((camera,))


def route_of(road, T_world_rig, off_m=0.0):
    s, _ = road.coordinates(T_world_rig[0, 3], T_world_rig[1, 3])
    points = np.array([road.pose(float(s) + 80 / 19 * i, off_m)[:3, 3] for i in range(20)])
    return transform_points(inverse(T_world_rig), points)


def observe(
    rgb,
    ego,
    route_rig=NO_ROUTE,
    history=None,
    camera=CAMERA,
    age_us=0,
):
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
    policy,
    rgb,
    speed_mps=10.0,
    route_rig=NO_ROUTE,
    times=6,
    camera=CAMERA,
):
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
    policy,
    road,
    speed_mps,
    seconds,
    route_off_m=0.0,
    with_route=True,
    camera=CAMERA,
    seed=0,
):
    """Drive with the bicycle; ``road`` may depend on the time in seconds."""
    road_at = road if callable(road) else lambda _: road
    first = road_at(0.0)
    controller = make_controller("bicycle", Vehicle())
    ego = EgoState(0, first.pose(0.0, 0.0), speed_mps)
    policy.reset(seed, Route(np.array([first.pose(float(s))[:3, 3] for s in range(200)])))
    seen = []
    plans = []
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


def to_world(plan, T_world_rig):
    xyz = transform_points(T_world_rig, np.column_stack([plan.xy, np.zeros(len(plan.xy))]))
    return Trajectory(plan.times_us, xyz, quat_from_yaw(plan.yaw + yaw_of(T_world_rig)))
