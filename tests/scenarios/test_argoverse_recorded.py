"""Three recorded Argoverse 2 logs: the reader's world against published facts about them."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from alpasim_plugin.core.geometry import (
    wrap_angle,
    yaw_from_quat,
)
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.world.ground import height_at
from scenarios.argoverse import read_argoverse, read_calibration, read_ego_poses
from scenarios.recorded import SourceFiles
from tests.examples import first_of

FACTS = {
    "7fab2350": {
        "poses": 2706,
        "duration_s": 15.950,
        "path_m": 75.04,
        "tracks": 114,
        "boxes": 11364,
        "lanes": 183,
        "intersection": 73,
        "crossings": 11,
        "areas": 13,
        "gap_m": 0.521,
        "world_gap_m": 0.521,
        "gap_s": 11.90,
        "turn_deg": 62.6,
        "resolved": 205,
        "links": 226,
        "mirrored": 205,
        "lane_ids": ("38133154", "38133156", "38114426"),
        "kinds": (163, 20, 0),
    },
    "adcf7d18": {
        "poses": 2637,
        "duration_s": 15.943,
        "path_m": 40.41,
        "tracks": 146,
        "boxes": 12078,
        "lanes": 199,
        "intersection": 61,
        "crossings": 11,
        "areas": 8,
        "gap_m": 0.385,
        "world_gap_m": 0.388,
        "gap_s": 4.90,
        "turn_deg": 0.6,
        "resolved": 199,
        "links": 230,
        "mirrored": 92,
        "lane_ids": ("42811487", "42811322", "42809424"),
        "kinds": (166, 19, 14),
    },
    "3bffdcff": {
        "poses": 2692,
        "duration_s": 15.955,
        "path_m": 88.43,
        "tracks": 116,
        "boxes": 12342,
        "lanes": 211,
        "intersection": 67,
        "crossings": 14,
        "areas": 15,
        "gap_m": 0.190,
        "world_gap_m": 0.177,
        "gap_s": 14.00,
        "turn_deg": -50.3,
        "resolved": 238,
        "links": 259,
        "mirrored": 121,
        "lane_ids": ("56224493", "56225812", "56226203"),
        "kinds": (173, 37, 1),
    },
}


@pytest.fixture(scope="module", params=first_of(list(FACTS)))
def real(request, shared_data):
    """One recorded log: (facts, folder, raw poses, what the reader made of it)."""
    folder = shared_data / "av2" / request.param
    raw = read_ego_poses(SourceFiles(), folder / "city_SE3_egovehicle.feather")
    return FACTS[request.param], folder, raw, read_argoverse(folder)


def sweeps_us(log):
    """Times of the annotation frames."""
    return np.unique(np.concatenate([a.track.t_us for a in log.actors]))


def test_real_poses(real):
    facts, _, raw, log = real
    assert len(raw.t_ns) == facts["poses"]
    assert (raw.t_ns[-1] - raw.t_ns[0]) * 1e-9 == pytest.approx(facts["duration_s"], abs=5e-4)
    assert np.linalg.norm(np.diff(raw.xyz, axis=0), axis=1).sum() == pytest.approx(
        facts["path_m"], abs=5e-3
    )
    assert np.median(np.diff(raw.t_ns)) * 1e-6 == pytest.approx(5.07, abs=5e-3)
    assert np.degrees(
        wrap_angle(yaw_from_quat(raw.quat[-1]) - yaw_from_quat(raw.quat[0]))
    ) == pytest.approx(facts["turn_deg"], abs=0.05)
    assert (log.ego_log.t_us[-1] - log.ego_log.t_us[0]) * 1e-6 == pytest.approx(
        facts["duration_s"], abs=5e-4
    )
    assert np.linalg.norm(np.diff(log.ego_log.xyz, axis=0), axis=1).sum() == pytest.approx(
        facts["path_m"], abs=0.15
    )  # 0.33 m lower


def test_real_annotations(real):
    facts, folder, _, log = real
    own = 156 if folder.name == "3bffdcff" else 0  # rows of the ego itself, one track
    assert len({a.actor_id for a in log.actors}) + (own > 0) == facts["tracks"]
    assert sum(len(a.track) for a in log.actors) + own == facts["boxes"]
    assert len(sweeps_us(log)) == 156
    assert np.diff(sweeps_us(log)) == pytest.approx(1e5, abs=4e3)


def test_real_map(real):
    facts, folder, _, log = real
    lanes = log.lane_map.lanes
    assert (len(lanes), sum(k.is_intersection for k in lanes.values())) == (
        facts["lanes"],
        facts["intersection"],
    )
    assert (len(log.lane_map.crosswalks), len(log.lane_map.drivable_areas)) == (
        facts["crossings"],
        facts["areas"],
    )
    assert (
        tuple(sum(k.kind == kind for k in lanes.values()) for kind in ("vehicle", "bike", "bus"))
        == facts["kinds"]
    )
    assert sum(len(k.successors) for k in lanes.values()) == facts["links"]
    assert sum(s in lanes for k in lanes.values() for s in k.successors) == facts["resolved"]
    assert all(
        lane_polygon(k).is_valid and lane_polygon(k).geom_type == "Polygon" for k in lanes.values()
    )
    raw = json.loads(next(folder.glob("map/log_map_archive_*.json")).read_bytes())["lane_segments"]
    mirrored = sum(
        int(k) in raw[s]["predecessors"]
        for k, lane in lanes.items()
        for s in lane.successors
        if s in raw
    )
    assert mirrored == facts["mirrored"]


def test_real_wheels_stand_on_the_ground(real):
    _, _, raw, log = real
    above = log.ego_log.xyz[:, 2] - height_at(log.ground, log.ego_log.xyz)
    assert np.abs(above).max() < 0.06
    assert np.abs(np.median(above)) < 0.01
    assert_allclose(np.linalg.norm(raw.quat, axis=1), 1.0, atol=1e-12)


def test_real_calibration(shared_data):
    folder = shared_data / "av2" / "7fab2350"
    cameras = {c.name: c for c in read_calibration(folder)}
    assert len(cameras) == 9
    front = cameras["ring_front_center"]
    assert (front.width, front.height) == (1550, 2048)
    assert_allclose(
        front.K, [[1776.041484, 0, 778.490573], [0, 1776.041484, 1014.024325], [0, 0, 1]], atol=1e-6
    )  # the files count from pixel centres
    assert_allclose(front.T_rig_camera[:3, 2], [1, 0, 0], atol=0.01)  # looks ahead
    assert_allclose(front.T_rig_camera[:3, 1], [0, 0, -1], atol=0.01)  # image down is world down
    assert front.T_rig_camera[2, 3] == pytest.approx(1.398 + 0.33, abs=1e-3)
    sweep = folder / "sensors" / "lidar" / "315966265259836000.feather"
    assert len(SourceFiles().read_feather(sweep, {"x": "number"})["x"]) == 99229
