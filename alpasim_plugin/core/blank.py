"""A scenario of which nothing is known but the ego's drive: for checks and for policies that are served to others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.types import (
    CameraSpec,
    Degradation,
    Environment,
    HeightField,
    LaneMap,
    Latency,
    Rates,
    Route,
    Scenario,
    Trajectory,
    Vehicle,
)


def blank_scenario(scene_id: str, ego_log: Trajectory, cameras: Sequence[CameraSpec] = ()) -> Scenario:
    """Return a scenario with a flat ground, an empty map and no actors; all of the drive is the rollout.

    Args:
        scene_id: Its id.
        ego_log: Recorded rig poses, world.
        cameras: Its cameras.
    """
    return Scenario(
        scene_id=scene_id,
        source="yaml",
        seed=0,
        lane_map=LaneMap({}),
        ground=HeightField(0.0, 0.0, 1.0, np.zeros((2, 2))),
        ego_log=ego_log,
        vehicle=Vehicle(),
        route=Route(ego_log.xyz),
        actors=(),
        cameras=tuple(cameras),
        rates=Rates(),
        start_us=int(ego_log.t_us[0]),
        end_us=int(ego_log.t_us[-1]),
        warmup_us=0,
        latency=Latency(),
        environment=Environment(),
        degradation=Degradation(),
    )
