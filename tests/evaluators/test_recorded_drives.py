"""The human drives of real recordings, scored as log replay: safe, on the road, on their own
path.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from alpasim_plugin.core.geometry import (
    interpolate,
    inverse,
    offset_trajectory,
    se3,
    trajectory_from_poses,
)
from alpasim_plugin.core.types import RolloutLog, Scene
from evaluators import PRESETS, rollout_values, score
from evaluators.metrics.contact import find_contacts
from evaluators.metrics.footprint import ActorTable, ego_footprints
from scenarios.argoverse import read_argoverse
from scenarios.commonroad import read_commonroad
from tests.examples import first_of

PAPER = PRESETS["paper"]
ARGOVERSE = ("7fab2350", "adcf7d18", "3bffdcff")
LOGS = (*ARGOVERSE, "USA_US101-3_3_T-1", "USA_Lanker-1_1_T-1")


@lru_cache(maxsize=6)
def read(folder, name):
    if name in ARGOVERSE:
        return read_argoverse(folder / "av2" / name)
    return read_commonroad(folder / "commonroad" / f"{name}.xml")


def replayed(log, t_us):
    T_rig_box = np.eye(4)
    T_rig_box[:3, 3] = [log.vehicle.rear_axle_to_centre_m, 0.0, log.vehicle.box.height_m / 2]
    rig = trajectory_from_poses(t_us, interpolate(log.ego_log, t_us))
    actors = {one.actor_id: one for one in log.actors}
    first = int(t_us[0])
    rollout = RolloutLog(
        log.scene_id,
        "replay",
        log.vehicle.box,
        T_rig_box,
        offset_trajectory(rig, T_rig_box),
        actors,
        (),
        (),
        log.ego_log,
        first,
        first,
        0,
        100_000,
    )
    return rollout, Scene(log.scene_id, log.lane_map, log.ego_log, log.vehicle)


def grid(log):
    return np.arange(log.ego_log.t_us[0], log.ego_log.t_us[-1] + 1, 100_000)


@pytest.mark.parametrize("name", first_of(LOGS[::-1], 2))
def test_the_human_drive_hits_nobody_stays_on_the_road_and_on_its_path(shared_data, name):
    rollout, scene = replayed(*(log := read(shared_data, name), grid(log)))
    series = score(rollout, scene)
    values = rollout_values(series)
    assert values["collision_any"].value == 0.0
    assert values["offroad"].value == 0.0
    assert values["wrong_lane"].value == 0.0
    assert values["route_distance_m"].value < 1e-9
    assert values["progress"].value > 0.99
    assert values["progress_rel"].value == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "gap_m", "at_s"),
    [("7fab2350", 0.521, 11.90), ("adcf7d18", 0.385, 4.90), ("3bffdcff", 0.190, 14.00)],
)
def test_least_gap_to_anybody_in_the_ego_plane_is_the_published_one(shared_data, name, gap_m, at_s):
    """Each frame is seen in the ego's own plane, with the recorded car's size, as the publisher's
    annotations are.
    """
    log = read(shared_data, name)
    own_size = replace(PAPER, ego_size_m=None)
    t_us = np.unique(np.concatenate([one.track.t_us for one in log.actors]))
    t_us = t_us[(t_us >= log.ego_log.t_us[0]) & (t_us <= log.ego_log.t_us[-1])]
    rollout, _ = replayed(log, t_us)
    to_ego = inverse(interpolate(log.ego_log, t_us))
    in_plane = {}
    for one in log.actors:
        seen = np.isin(one.track.t_us, t_us)
        poses = to_ego[np.searchsorted(t_us, one.track.t_us[seen])] @ se3(
            one.track.xyz[seen], one.track.quat[seen]
        )
        in_plane[one.actor_id] = replace(
            one, track=trajectory_from_poses(one.track.t_us[seen], poses)
        )
    still = trajectory_from_poses(t_us, np.broadcast_to(rollout.T_rig_box, (len(t_us), 4, 4)))
    flat = replace(rollout, ego=still, actors=in_plane)
    origin = np.zeros(3)
    _, gaps = find_contacts(
        ego_footprints(flat, own_size, origin), ActorTable(flat, own_size, origin), t_us
    )
    best = int(np.argmin(gaps))
    assert gaps[best] == pytest.approx(gap_m, abs=1e-3)
    assert (t_us[best] - t_us[0]) * 1e-6 == pytest.approx(at_s, abs=0.01)
