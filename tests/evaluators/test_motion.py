"""Metrics of motion: drives that fail without touching anything."""

from __future__ import annotations

import numpy as np
import pytest

from evaluators import reduce_rollout, score
from evaluators.metrics.motion import safe_distance_m
from tests.evaluators.eval_build import TWO_LANES, by_name, car, rollout, scene, track
from tests.evaluators.test_benchmarks import CRUISE, N, braking


def scored(log, preset="strict"):
    return by_name(score(log, scene(TWO_LANES, log), preset))


def test_a_hard_stop_that_touches_nothing_is_an_event_with_its_time():
    log = braking()
    found = scored(log)
    first = np.flatnonzero(found["hard_brake"].value)[0]
    assert log.ego.t_us[first] == pytest.approx(2.5e6, abs=6e5)
    assert found["uncomfortable"].value.max() == 1.0
    events = reduce_rollout(list(found.values()), "strict").events
    assert "hard_brake" in {one["metric"] for one in events}
    assert not scored(rollout(track(CRUISE, 0.0)))["hard_brake"].value.any()


def test_time_to_collision_and_impact_speed_of_a_drive_into_a_standing_car():
    log = rollout(track(CRUISE, 0.0), [car("stands", track(np.full(N, 40.0), 0.0))])
    found = scored(log)
    gap_m = 40.0 - 2.25 - CRUISE - log.ego_box.length_m / 2
    ahead = (gap_m > 0.8) & (gap_m < 23.0)
    assert np.abs(found["time_to_collision_s"].value - gap_m / 8.0)[ahead].max() < 0.11
    assert found["time_to_collision_s"].value[0] == 3.0
    impact = found["impact_speed_mps"]
    assert impact.valid.sum() == 1
    assert impact.value[impact.valid] == pytest.approx(8.0)


def test_the_safe_distance_is_that_of_the_definition_and_nobody_beside_counts():
    assert safe_distance_m(np.array([8.0]), np.array([0.0]))[0] == pytest.approx(8 + 1.75 + 11.5**2 / 8)
    standing, beside = track(np.full(N, 40.0), 0.0), track(CRUISE + 8.0, 3.0)
    log = rollout(track(CRUISE, 0.0), [car("stands", standing), car("beside", beside)])
    gap_m = 40.0 - 2.25 - CRUISE[20] - log.ego_box.length_m / 2
    assert scored(log)["rss_margin_m"].value[20] == pytest.approx(gap_m - 26.28125, abs=1e-6)
    assert not scored(rollout(track(CRUISE, 0.0), [car("beside", beside)]))["rss_margin_m"].valid.any()


def test_driving_against_the_lane_is_the_wrong_way_and_alpasims_preset_has_none_of_it():
    log = rollout(track(CRUISE[::-1], 0.0, yaw=np.pi))
    assert scored(log)["wrong_way"].value.max() == 1.0
    assert scored(rollout(track(CRUISE, 0.0)))["wrong_way"].value.max() == 0.0
    assert not {"hard_brake", "wrong_way"} & set(scored(log, "alpasim"))


def test_one_step_has_no_motion_and_says_so():
    found = scored(rollout(track(3.0, 0.0)))
    assert not found["hard_brake"].valid.any()
    assert found["uncomfortable"].reason == "the log has three steps or fewer"
