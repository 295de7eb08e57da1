"""Every shipped scenario: it loads, its expert drives cleanly, and its parts fit together."""

import functools
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.geometry import yaw_from_quat
from evaluators.statistics.sentences import SHIPPED, SHIPPED_SCENES
from scenarios.load import load_scenario
from scenarios.suite import load_suite, shipped, shipped_names, suites
from tests.examples import first_of

BUILT = [name for name in shipped_names() if not name.startswith("real/")]


@functools.cache
def scenario(name):
    return load_scenario(name)


def test_the_library_is_as_large_as_promised():
    def count(folder):
        return sum(name.startswith(f"{folder}/") for name in shipped_names())

    assert count("smoke") >= 3
    assert count("urban") + count("highway") >= 20
    assert count("hard") >= 8
    assert count("real") >= 1


@pytest.mark.parametrize("name", first_of(BUILT, 3))
def test_expert_drives_smoothly(name):
    log = scenario(name).ego_log
    assert (np.diff(log.t_us) == 10_000).all()
    v = np.hypot(*np.gradient(log.xyz[:, :2], 0.01, axis=0).T)
    a = np.gradient(v, 0.01)
    jerk = np.gradient(a, 0.01)[3:-3]
    yaw_rate = np.gradient(np.unwrap(yaw_from_quat(log.quat)), 0.01)
    assert a.min() > -7.1
    assert a.max() < 2.1
    assert np.abs(jerk).max() < 13.0
    assert np.abs(v * yaw_rate).max() < 3.2, "lateral acceleration"
    heading = np.unwrap(np.arctan2(*np.diff(log.xyz[:, 1::-1], axis=0).T))
    moving = np.hypot(*np.diff(log.xyz[:, :2], axis=0).T) > 0.01
    slip = np.abs((heading - np.unwrap(yaw_from_quat(log.quat))[:-1] + np.pi) % (2 * np.pi) - np.pi)
    assert slip[moving].max() < 0.02, "the rear axle moves where the car points"


@pytest.mark.parametrize("name", ["real/us101", *first_of(BUILT, 4)])
def test_scenario_is_complete(name):
    s = scenario(name)
    assert (
        s.ego_log.t_us[0] <= s.start_us < s.start_us + s.warmup_us < s.end_us <= s.ego_log.t_us[-1]
    )
    assert len({a.actor_id for a in s.actors}) == len(s.actors)
    assert s.cameras
    assert len(s.content_hash) == 64
    assert set(s.route.lane_ids) <= set(s.lane_map.lanes)
    assert s.lane_map.road_edges
    for actor in s.actors:
        assert (np.diff(actor.track.t_us) > 0).all()
        assert np.isfinite(actor.track.xyz).all()
        np.testing.assert_allclose(np.linalg.norm(actor.track.quat, axis=1), 1.0)
    assert shipped()[name], "a description for simrun list"


@pytest.mark.parametrize("name", [n for n in BUILT if n.startswith("smoke/")])
def test_smoke_scenarios_are_short_and_small(name):
    s = scenario(name)
    assert (s.end_us - s.start_us) <= 8_000_000
    assert s.cameras[0].width * s.cameras[0].height <= 256 * 144


def test_suites_hold_what_their_folders_hold():
    for name in ("urban", "highway", "hard", "challenge"):
        assert [Path(r.path).stem for r in load_suite(name)] == [
            n.split("/")[1] for n in BUILT if n.startswith(name)
        ]
    shorter = [name for name in shipped_names() if not name.startswith("challenge/")]
    assert len(load_suite(SHIPPED)) == len(shorter) == SHIPPED_SCENES
    for name in ("smoke", "gate_self_test"):  # a driver that does not look hits the leader
        assert "hard_brake" in [Path(r.path).stem for r in load_suite(f"suites/{name}")]
    names = ("smoke", "urban", "highway", "hard", "all", "gate_self_test", "first", "challenge")
    assert set(suites()) == {f"suites/{name}" for name in names}


def test_scenes_of_the_challenge_last_20_s_and_have_its_cameras_beside_a_pinhole():
    refs = load_suite("suites/challenge")
    kinds = {Path(ref.path).stem.partition("_")[0] for ref in refs}
    assert kinds == {"street", "junction", "town"}
    scene = load_scenario(refs[0].path)
    assert scene.end_us - scene.start_us == 20_000_000
    assert {camera.name for camera in scene.cameras if camera.lens is not None} == {
        "camera_front_wide_120fov",
        "camera_front_tele_30fov",
        "camera_cross_left_120fov",
        "camera_cross_right_120fov",
    }
    assert [camera.name for camera in scene.cameras if camera.lens is None] == ["front"]
