"""A built drive is kept: the same scene is not built twice, and each caller has a copy."""

import numpy as np
import pytest

from scenarios import build
from scenarios.load import load_scenario

SCENE = "smoke/straight"


@pytest.fixture
def built(monkeypatch):
    """Give the ids of the scenes that are built from here on."""
    scenes = []
    new_drive = build._new_drive

    def noted(draft, vehicle):
        scenes.append(draft.scene_id)
        return new_drive(draft, vehicle)

    monkeypatch.setattr(build, "_new_drive", noted)
    build._kept_drive.cache_clear()
    return scenes


def test_a_drive_is_built_again_where_its_specification_its_id_or_its_vehicle_is_another(built):
    first, second = load_scenario(SCENE), load_scenario(SCENE)
    assert len(built) == 1
    assert first.content_hash == second.content_hash
    for changes in (["ego.speed_mps=7"], ["scene_id=other"], ["vehicle.length_m=4.0"]):
        before = len(built)
        load_scenario(SCENE, overrides=changes)
        load_scenario(SCENE, overrides=changes)
        assert len(built) == before + 1, changes


def test_what_a_caller_writes_into_a_scenario_is_in_no_later_one(built):
    first = load_scenario(SCENE)
    as_built = first.ego_log.xyz.copy()
    first.ego_log.xyz[:] = 0.0
    for lane in first.lane_map.lanes.values():
        lane.centre[:] = 0.0
    again = load_scenario(SCENE)
    assert built == [again.scene_id]
    assert np.array_equal(again.ego_log.xyz, as_built)
    assert all(lane.centre.any() for lane in again.lane_map.lanes.values())
