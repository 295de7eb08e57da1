"""Hand-made contact scenes of another benchmark: who touches whom first, by plain box overlap."""

import json

import numpy as np
import pytest

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import Actor, Box, RolloutLog, Trajectory
from evaluators import Preset
from evaluators.metrics.contact import find_contacts
from evaluators.metrics.footprint import ActorTable, ego_footprints

OWN_SIZE = Preset(name="own size")
EGO = Box(4.049 + 1.127, 2.297, 1.8)  # front and rear overhang from the rear axle
CENTRE_AHEAD_M = (4.049 - 1.127) / 2


def poses(rows, t_us, ahead_m=0.0):
    x, y, yaw = np.array(rows, dtype=float).T
    xyz = np.stack([x + ahead_m * np.cos(yaw), y + ahead_m * np.sin(yaw), np.zeros_like(x)], axis=1)
    return Trajectory(np.array(t_us, dtype=np.int64), xyz, quat_from_yaw(yaw))


def first_contacts(path):
    data = json.loads(path.read_text())
    egos = [data["ego"], *data.get("ego_future_states", [])]
    worlds = [data["world"], *data.get("world_future_states", [])]
    t_us = [state["time_us"] for state in egos]
    tracks = {}
    for t, world in zip(t_us, worlds, strict=True):
        for kind in ("vehicles", "bicycles", "pedestrians"):
            for one in world.get(kind, []):
                rows, times, _ = tracks.setdefault(
                    f"{kind}-{one['id']}",
                    ([], [], Box(one["box"]["size"][1], one["box"]["size"][0], 1.5)),
                )
                rows.append(one["box"]["pose"])
                times.append(t)
    actors = {
        key: Actor(key, "car", box, poses(rows, times))
        for key, (rows, times, box) in tracks.items()
    }
    ego = poses([state["pose"] for state in egos], t_us, CENTRE_AHEAD_M)
    log = RolloutLog(
        "s", "u", EGO, np.eye(4), ego, actors, (), (), ego, t_us[0], t_us[0], 0, 100_000
    )
    table = ActorTable(log, OWN_SIZE, np.zeros(3))
    contacts, _ = find_contacts(ego_footprints(log, OWN_SIZE, np.zeros(3)), table, ego.t_us)
    first = {}
    for step, actor in zip(contacts.step.tolist(), contacts.actor.tolist(), strict=True):
        first.setdefault(table.ids[actor], step)
    return first


@pytest.mark.parametrize(
    ("name", "want"),
    [
        ("active_front_collision", {"bicycles-0": 0}),
        ("no_collision", {}),
        ("stopped_ego_collision", {"vehicles-1": 2}),
        ("multiple_collisions", {"vehicles-4": 1, "vehicles-1": 2, "vehicles-2": 2}),
    ],
)
def test_first_contacts_are_the_published_ones(shared_data, name, want):
    assert (
        first_contacts(
            shared_data / "nuplan-devkit-fixtures" / "no_ego_at_fault_collision" / f"{name}.json"
        )
        == want
    )
