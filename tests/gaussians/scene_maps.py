"""Small hand-made scenarios for scene and renderer tests: straight 2 + 2 lanes, a curve, a
crossing.
"""

from dataclasses import replace

import numpy as np

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import (
    Actor,
    Box,
    CameraSpec,
    Degradation,
    Environment,
    HeightField,
    Lane,
    LaneMap,
    Latency,
    Rates,
    Route,
    Scenario,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.world.ground import flat
from alpasim_plugin.world.markings import with_default_markings

LANE_M = 3.6


def camera_spec(width=256, height=144):
    """A forward camera 1.5 m above the ground, 1.7 m ahead of the rear axle."""
    f = width / (2 * np.tan(1.2 / 2))
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    T = np.eye(4)
    T[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=np.float64)
    T[:3, 3] = (1.7, 0.0, 1.5)
    return CameraSpec("front", width, height, K, T)


def offset(line, left_m):
    """Shift a polyline sideways."""
    d = np.gradient(line[:, :2], axis=0)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    out = line.copy()
    out[:, 0] -= left_m * d[:, 1]
    out[:, 1] += left_m * d[:, 0]
    return out


def road_lanes(
    axis,
    name,
    lanes_each_way=2,
    is_intersection=False,
):
    """Lanes on both sides of a road's axis ``(N, 3)``; those on its right run along it."""
    out = {}
    for way, sign in (("a", -1.0), ("b", 1.0)):
        for i in range(lanes_each_way):
            inner = offset(axis, sign * i * LANE_M)
            outer = offset(axis, sign * (i + 1) * LANE_M)
            if way == "b":
                inner = inner[::-1].copy()
                outer = outer[::-1].copy()
            lane_id = f"{name}-{way}{i}"
            out[lane_id] = Lane(
                lane_id, (inner + outer) / 2, inner, outer, is_intersection=is_intersection
            )  # type: ignore[arg-type]
    return out


def make_scenario(
    lane_map,
    path,
    actors=(),
    environment=None,
    degradation=None,
    ground=None,
    scene_id="test",
    seed=0,
    speed_mps=10.0,
):
    """A scenario whose ego drives along ``path (N, 3)``."""
    d = np.gradient(path[:, :2], axis=0)
    yaw = np.arctan2(d[:, 1], d[:, 0])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    t_us = np.round(s / speed_mps * 1e6).astype(np.int64)
    log = Trajectory(t_us, path, quat_from_yaw(yaw))
    return Scenario(
        scene_id=scene_id,
        source="yaml",
        seed=seed,
        lane_map=lane_map,
        ground=ground or flat(),
        ego_log=log,
        vehicle=Vehicle(),
        route=Route(path),
        actors=actors,
        cameras=(camera_spec(),),
        rates=Rates(),
        start_us=int(t_us[0]),
        end_us=int(t_us[-1]),
        warmup_us=0,
        latency=Latency(),
        environment=environment or Environment(),
        degradation=degradation or Degradation("none"),
        content_hash="",
    )


def line(start, end, step_m=2.0):
    """A straight polyline on level ground."""
    a = np.array(start)
    b = np.array(end)
    n = max(2, int(np.linalg.norm(b - a) / step_m) + 1)
    xy = a + np.linspace(0, 1, n)[:, None] * (b - a)
    return np.column_stack([xy, np.zeros(n)])


def parked(actor_id, x, y, yaw=0.0, label="car", box=None):
    """An actor that stands still."""
    b = box or Box(4.6, 1.9, 1.5)
    t = np.array([0, 60_000_000])
    xyz = np.tile([x, y, b.height_m / 2], (2, 1))
    return Actor(
        actor_id, label, b, Trajectory(t, xyz, np.tile(quat_from_yaw(yaw), (2, 1))), is_static=True
    )


STREET_ACTORS = (
    parked("car-1", 42.0, -1.8),
    parked("car-2", 26.0, -5.9),
    parked("car-3", 33.0, 5.4, np.pi),
    parked("truck-1", 60.0, -5.4, 0.0, "truck", Box(8.5, 2.5, 3.4)),
    parked("bus-1", 55.0, 5.4, np.pi, "bus", Box(11.5, 2.6, 3.2)),
    parked("ped-1", 24.0, -8.6, 0.5, "pedestrian", Box(0.6, 0.6, 1.75)),
    parked("ped-2", 20.0, 8.8, 2.5, "pedestrian", Box(0.6, 0.6, 1.65)),
    parked("bike-1", 22.0, 1.8, np.pi, "cyclist", Box(1.8, 0.6, 1.75)),
    parked("moto-1", 29.0, 1.8, np.pi, "motorcycle", Box(2.1, 0.8, 1.5)),
    parked("cone-1", 18.0, -6.6, 0.0, "other", Box(0.4, 0.4, 0.8)),
)


def straight(**kwargs):
    """A straight street, two lanes each way, the ego in the inner right lane."""
    lanes = road_lanes(line((-60, 0), (220, 0)), "r")
    walk = np.array([[78.0, -7.2, 0], [81.0, -7.2, 0], [81.0, 7.2, 0], [78.0, 7.2, 0]])
    stop = np.array([[76.5, -7.2, 0], [76.5, 0.0, 0]])
    kwargs.setdefault("actors", STREET_ACTORS)
    lane_map = with_default_markings(
        LaneMap(lanes, crosswalks=(walk,), stop_lines=(stop,))
    )  # as a scenario is when it is loaded
    return make_scenario(lane_map, line((0, -1.8), (100, -1.8)), **kwargs)  # type: ignore[arg-type]


def curve(radius_m=60.0, **kwargs):
    """A left curve on a slope of 3 %."""
    a = np.linspace(-0.6, 2.2, 90)
    axis = np.column_stack([radius_m * np.sin(a), radius_m * (1 - np.cos(a)), np.zeros_like(a)])
    path = offset(axis, -1.8)[(a >= 0.0) & (a < 1.6)]
    xs = np.arange(-200.0, 201.0, 10.0)
    field = HeightField(-200.0, -200.0, 10.0, np.broadcast_to(0.03 * xs[None, :], (41, 41)).copy())
    path[:, 2] = 0.03 * path[:, 0]
    return make_scenario(LaneMap(road_lanes(axis, "c", 1)), path, ground=field, **kwargs)  # type: ignore[arg-type]


def crossing(**kwargs):
    """Two streets that cross at the origin."""
    lanes = {}
    for name, angle in (("e", 0.0), ("n", np.pi / 2), ("w", np.pi), ("s", -np.pi / 2)):
        d = np.array([np.cos(angle), np.sin(angle)])
        lanes |= road_lanes(line(tuple(12 * d), tuple(150 * d)), name, 1)
    for name, angle in (("x0", 0.0), ("x1", np.pi / 2)):
        d = np.array([np.cos(angle), np.sin(angle)])
        lanes |= road_lanes(line(tuple(-12 * d), tuple(12 * d)), name, 1, is_intersection=True)
    return make_scenario(LaneMap(lanes), line((-70, -1.8), (40, -1.8)), **kwargs)  # type: ignore[arg-type]


def with_camera(scenario, width, height):
    """The same scenario at another image size."""
    return replace(scenario, cameras=(camera_spec(width, height),))
