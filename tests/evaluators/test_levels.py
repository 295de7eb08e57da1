"""Road users on a bridge above the ego, or on a road below it, are not near it."""

import numpy as np
import pytest

from alpasim_plugin.core.types import Box
from evaluators import PRESETS
from evaluators.metrics.collision import contact_events
from tests.evaluators.eval_build import CAR, car, rollout, scored, track
from tests.evaluators.motions import CRUISE, N

TRUCK = Box(8.5, 2.5, 3.4)
FLAT = ("alpasim", "alpasim@6f1029c")


def beside(z, box=CAR, ego_z=0.0):
    """A drive over a place on whose level, or not, somebody stands."""
    stands = car("stands", track(np.full(N, 40.0), 0.0, z=z), box)
    return rollout(track(CRUISE, 0.0, z=ego_z), [stands])


def touched(log, preset="strict"):
    return bool(scored(log, preset=preset)["collision_any"].value.any())


@pytest.mark.parametrize("preset", ["strict", "paper", *FLAT])
def test_a_car_on_a_bridge_is_not_touched_but_by_presets_without_heights(preset):
    assert PRESETS[preset].levels == (preset not in FLAT)
    for z in (7.0, 4.0, -4.0):  # two roads may be 4 m apart
        assert touched(beside(z), preset) == (preset in FLAT)
    for z in (0.0, 1.0):
        assert touched(beside(z), preset)


def test_heights_of_both_count_and_the_world_may_be_high_up():
    assert touched(beside(2.4, TRUCK))
    assert not touched(beside(4.0, TRUCK))
    assert touched(beside(640.0, ego_z=640.0))
    assert not touched(beside(647.0, ego_z=640.0))
    assert not touched(beside(0.0, ego_z=640.0))


def test_who_is_above_has_no_gap_no_time_to_collision_and_no_safe_distance():
    above = scored(beside(7.0))
    alone = scored(rollout(track(CRUISE, 0.0)))
    level = scored(beside(0.0))
    for name in ("min_distance_to_obstacle_m", "time_to_collision_s"):
        assert not np.array_equal(level[name].value, alone[name].value)
        assert np.array_equal(above[name].value, alone[name].value, equal_nan=True)
        assert np.array_equal(above[name].valid, alone[name].valid)
    assert contact_events(beside(7.0)) == ()
    assert len(contact_events(beside(0.0))) == 1


@pytest.mark.parametrize("name", ["nuplan", "navsim"])
def test_no_benchmark_blames_the_ego_for_a_car_above(name):
    above = scored(beside(7.0), preset=name)
    level = scored(beside(0.0), preset=name)
    alone = scored(rollout(track(CRUISE, 0.0)), preset=name)
    differing = {
        key
        for key in level
        if not np.array_equal(level[key].value, alone[key].value, equal_nan=True)
    }
    assert differing
    for key in differing:
        assert np.array_equal(above[key].value, alone[key].value, equal_nan=True)


def test_who_passes_over_the_ego_between_two_steps_does_not_touch_it():
    t = np.arange(N) * 0.1
    for z, touches in ((0.0, True), (6.0, False)):
        poses = track(40.0, 60.0 * (t - 4.75), yaw=np.pi / 2, z=z)
        crossing = car("crosses", poses, Box(1.5, 1.8, 1.5))
        assert touched(rollout(track(CRUISE, 0.0), [crossing])) == touches


def test_a_car_up_the_hill_is_ahead_and_a_ramp_leads_onto_the_ego_s_level():
    uphill = 0.1 * (CRUISE - CRUISE[0])  # 10 % from the start on
    far = 0.1 * (40.0 - CRUISE[0])
    stands = car("stands", track(np.full(N, 40.0), 0.0, z=far))
    hill = scored(rollout(track(CRUISE, 0.0, z=uphill), [stands]))
    flat = scored(beside(0.0))
    ahead = flat["time_to_collision_s"].value < 2.5
    assert ahead.any()
    assert hill["time_to_collision_s"].value[ahead] == pytest.approx(
        flat["time_to_collision_s"].value[ahead], abs=0.05
    )
    down = np.interp(np.arange(N), [0, N // 2], [7.0, 0.0])
    onto = car("merges", track(np.full(N, 40.0), 0.0, z=down))
    assert touched(rollout(track(CRUISE, 0.0), [onto]))
