"""Small worlds for evaluator tests: straight lanes, drives given by centre positions, actors given
by centre positions.
"""

import numpy as np

from alpasim_plugin.core.geometry import inverse, offset_trajectory, quat_from_yaw
from alpasim_plugin.core.types import (
    Actor,
    Box,
    Lane,
    LaneMap,
    RolloutLog,
    Scene,
    Trajectory,
    Vehicle,
)
from evaluators import paired, rollout_values, score

DT_US = 100_000
CAR = Box(4.5, 1.8, 1.5)
VEHICLE = Vehicle()
T_RIG_BOX = np.eye(4)
T_RIG_BOX[:3, 3] = [VEHICLE.rear_axle_to_centre_m, 0.0, VEHICLE.box.height_m / 2]


def track(x, y, yaw=0.0, z=0.0, t_us=None, n=None):
    """Poses from numbers or arrays; as many as the longest of them, 0.1 s apart unless times are
    given.
    """
    n = n or (len(t_us) if t_us is not None else max(np.size(a) for a in (x, y, yaw, z)))
    t = np.arange(n, dtype=np.int64) * DT_US if t_us is None else np.asarray(t_us, dtype=np.int64)
    xyz = np.stack([np.broadcast_to(np.asarray(a, dtype=float), n) for a in (x, y, z)], axis=1)
    return Trajectory(t, xyz, quat_from_yaw(np.broadcast_to(np.asarray(yaw, dtype=float), n)))


def car(name, poses, box=CAR):
    return Actor(name, "car", box, poses)


def lane(name, y, half_width=1.75, x0=-50.0, x1=200.0, **kwargs):
    def line(at):
        return np.array([[x0, at, 0.0], [x1, at, 0.0]])

    edges = {"left": line(y + half_width), "right": line(y - half_width)} | kwargs
    return Lane(name, line(y), **edges)


def road_map(*lanes, edges=()):
    return LaneMap({one.lane_id: one for one in lanes}, tuple(edges))


def rollout(
    ego,
    actors=(),
    log=None,
    plans=(),
    images=(),
    warmup_us=0,
    box=VEHICLE.box,
):
    """A log whose ego is at the given box centres; the recording is the same drive unless given (as
    box centres as well).
    """
    recorded = offset_trajectory(log or ego, inverse(T_RIG_BOX))
    by_id = {one.actor_id: one for one in actors}
    start = int(ego.t_us[0])
    return RolloutLog(
        "scene",
        "uuid",
        box,
        T_RIG_BOX,
        ego,
        by_id,
        tuple(plans),
        tuple(images),
        recorded,
        start,
        start,
        warmup_us,
        DT_US,
    )


def scene(lane_map, log):
    return Scene("scene", lane_map, log.ego_log, VEHICLE)


TWO_LANES = road_map(
    lane("right", 0.0),
    lane("left", 3.5),
    edges=[
        np.array([[-50.0, -1.75, 0.0], [200.0, -1.75, 0.0]]),
        np.array([[-50.0, 5.25, 0.0], [200.0, 5.25, 0.0]]),
    ],
)


def by_name(series):
    return {one.name: one for one in series}


def scored(log, lane_map=TWO_LANES, preset="strict"):
    """Return the series of a log by name."""
    return by_name(score(log, scene(lane_map, log), preset))


def values_of(log, lane_map=TWO_LANES, preset="strict"):
    """Return the value of each metric over a log."""
    return rollout_values(score(log, scene(lane_map, log), preset), preset)


def base_pairs(rows, baseline, bases):
    """Renderers with a fixer against the renderer below it, where neither is the baseline."""
    renderers = {row["renderer"] for row in rows}
    return {
        name: paired([row for row in rows if row["renderer"] in (name, base)], base)[name]
        for name, base in bases.items()
        if {name, base} <= renderers and baseline not in (name, base)
    }
