"""A rollout's log beside the recorded path, with one standing obstacle."""

import numpy as np

from alpasim_plugin.core.types import Actor, Box, RolloutLog, Trajectory


def rollout_along(scenario, aside_m, box):
    """Return the recorded drive moved to its left, and an obstacle: its middle and its side."""
    ego = scenario.ego_log
    xyz = ego.xyz + np.array([0.0, aside_m, 0.8])
    middle, side = box
    ends = np.array([ego.t_us[0], ego.t_us[-1]])
    place = np.tile([*middle, 0.5], (2, 1))
    stands = Actor(
        "obstacle-001-within-0.1m",
        "other",
        Box(side, side, 1.0),
        Trajectory(ends, place, np.tile([1.0, 0, 0, 0], (2, 1))),
        True,
    )
    return RolloutLog(
        scenario.scene_id,
        "one",
        Box(4.0, 1.8, 1.6),
        np.eye(4),
        Trajectory(ego.t_us, xyz, ego.quat),
        {stands.actor_id: stands},
        (),
        (),
        ego,
        int(ego.t_us[0]),
        int(ego.t_us[0]),
        int(ego.t_us[0]),
        100_000,
    )
