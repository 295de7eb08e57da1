"""Metrics of motion: drives that fail without touching anything."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.types import Box, Signal
from alpasim_plugin.runs.scoring import _placed as placed_events
from evaluators import reduce_rollout, score
from evaluators.metrics.motion import safe_distance_m
from tests.evaluators.eval_build import TWO_LANES, car, rollout, scene, scored, track
from tests.evaluators.motions import CRUISE, N, braking


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


@pytest.mark.parametrize("preset", ["strict", "paper"])
def test_a_contact_between_steps_has_an_impact_speed_where_it_counts(preset):
    """A car crosses at 60 m/s: its box is before the ego at one step and past it at the next."""
    t = np.arange(N) * 0.1
    crossing = car("crosses", track(40.0, 60.0 * (t - 4.75), yaw=np.pi / 2), Box(1.5, 1.8, 1.5))
    found = scored(rollout(track(CRUISE, 0.0), [crossing]), preset=preset)
    is_hit = found["collision_any"].value > 0
    impact = found["impact_speed_mps"]
    assert impact.valid.tolist() == is_hit.tolist()
    assert is_hit.sum() == (preset == "strict")
    if preset == "strict":
        assert impact.value[is_hit] == pytest.approx(np.hypot(8.0, 60.0))


def test_a_contact_of_the_warm_up_has_no_impact_speed_and_says_so():
    stands = car("stands", track(np.full(N, 12.0), 0.0))
    log = rollout(track(CRUISE, 0.0), [stands], warmup_us=1_200_000)
    impact = scored(log)["impact_speed_mps"]
    assert not impact.valid.any()
    assert "no contact begins" in impact.reason
    once = car("once", track(12.0, 0.0, t_us=[950_000]))
    impact = scored(rollout(track(CRUISE, 0.0), [once]))["impact_speed_mps"]
    assert not impact.valid.any()
    assert "velocity is not known" in impact.reason


def test_who_crosses_at_speed_is_seen_from_the_side_however_far_off_the_nose():
    """A car comes from the left at 23 m/s and meets the ego at 40 m; nuPlan's cone is blind to it."""
    t = np.arange(N) * 0.1
    crossing = car("crosses", track(40.0, 23.0 * (5.0 - t), yaw=-np.pi / 2))
    found = scored(rollout(track(CRUISE, 0.0), [crossing]))["time_to_collision_s"].value
    for k in (22, 30, 40, 45):
        x = CRUISE[k] + CRUISE[1] * 10 * (s := np.arange(0, 3, 0.001))
        y = 23.0 * (5.0 - t[k] - s)
        box = rollout(track(CRUISE, 0.0)).ego_box
        touch = (np.abs(x - 40.0) <= box.length_m / 2 + 0.9) & (np.abs(y) <= 2.25 + box.width_m / 2)
        assert found[k] == pytest.approx(s[np.argmax(touch)] if touch.any() else 3.0, abs=0.002)
    assert found[30] < 2.0


def test_the_safe_distance_is_that_of_the_definition_and_nobody_beside_counts():
    assert safe_distance_m(np.array([8.0]), np.array([0.0]))[0] == pytest.approx(
        8 + 1.75 + 11.5**2 / 8
    )
    standing = track(np.full(N, 40.0), 0.0)
    beside = track(CRUISE + 8.0, 3.0)
    log = rollout(track(CRUISE, 0.0), [car("stands", standing), car("beside", beside)])
    gap_m = 40.0 - 2.25 - CRUISE[20] - log.ego_box.length_m / 2
    assert scored(log)["rss_margin_m"].value[20] == pytest.approx(gap_m - 26.28125, abs=1e-6)
    assert not scored(rollout(track(CRUISE, 0.0), [car("beside", beside)]))[
        "rss_margin_m"
    ].valid.any()


def test_driving_against_the_lane_is_the_wrong_way_and_alpasims_preset_has_none_of_it():
    log = rollout(track(CRUISE[::-1], 0.0, yaw=np.pi))
    assert scored(log)["wrong_way"].value.max() == 1.0
    assert scored(rollout(track(CRUISE, 0.0)))["wrong_way"].value.max() == 0.0
    assert not {"hard_brake", "wrong_way"} & set(scored(log, preset="alpasim"))


def signalled(*phases, offset_us=0, heading_rad=0.0, y=0.0, z=0.0):
    """Two lanes with a line at x = 30 m, across the right one, and one light over it."""
    stop = np.array([[30.0, y + 1.75, z], [30.5, y - 1.75, z]])  # not quite square to the lane
    return replace(TWO_LANES, signals=(Signal(stop, heading_rad, phases, offset_us),))


def ran_red(lane_map):
    log = rollout(track(CRUISE, 0.0))  # 8 m/s; the front is at the line after 3.4 s
    one = scored(log, lane_map)["red_light"]
    navsim = scored(log, lane_map, "navsim")["navsim_tlc"]
    assert navsim.value.tolist() == [1.0 - one.value.max()] * N
    return one.value


def test_a_red_light_is_passed_where_the_front_crosses_its_line_while_it_is_red():
    fired = ran_red(signalled(("red", 5_000_000), ("green", 5_000_000)))
    first = (30.25 - CRUISE[0] - rollout(track(CRUISE, 0.0)).ego_box.length_m / 2) / 8.0
    assert np.flatnonzero(fired).tolist() == [int(np.ceil(first * 10))]


@pytest.mark.parametrize(
    "lane_map",
    [
        signalled(("green", 5_000_000), ("red", 5_000_000)),
        signalled(("yellow", 10_000_000)),
        signalled(("red", 3_000_000), ("green", 7_000_000)),  # green when the front comes
        signalled(("red", 3_000_000), ("green", 7_000_000), offset_us=-10_000_000),
        signalled(
            ("red", 10_000_000), heading_rad=np.pi
        ),  # for the traffic that comes towards the ego
        signalled(("red", 10_000_000), y=3.5),  # over the lane beside
        signalled(("red", 10_000_000), z=6.0),  # on the bridge
        replace(TWO_LANES, signals=()),
    ],
)
def test_no_red_light_is_passed(lane_map):
    assert not ran_red(lane_map).any()


def test_red_and_yellow_is_red_and_what_is_not_known_is_invalid():
    assert ran_red(signalled(("red_yellow", 10_000_000))).any()
    assert ran_red(signalled(("green", 2_000_000), ("red", 8_000_000), offset_us=-2_000_000)).any()
    unknown = scored(rollout(track(CRUISE, 0.0)))["red_light"]
    assert not unknown.valid.any()
    assert unknown.reason == "the states of traffic lights are not known"


def test_a_red_light_is_an_event_of_a_drive():
    log = rollout(track(CRUISE, 0.0))
    events = reduce_rollout(score(log, scene(signalled(("red", 9_000_000)), log)), "strict").events
    assert [one["metric"] for one in events] == ["red_light"]


def test_one_step_has_no_motion_and_says_so():
    found = scored(rollout(track(3.0, 0.0)))
    assert not found["hard_brake"].valid.any()
    assert found["uncomfortable"].reason == "the log has three steps or fewer"


def test_the_safe_distance_behind_a_moving_car_counts_its_own_stopping_distance():
    own_mps = np.array([20.0, 8.0, 10.0])
    ahead_mps = np.array([10.0, 16.0, -12.0])
    # by hand: v + 3.5 / 2 + (v + 3.5)^2 / (2 * 4) - ahead^2 / (2 * 8); what comes towards it stands
    expected = [84.53125, 10.28125, 34.53125]
    assert safe_distance_m(own_mps, ahead_mps) == pytest.approx(expected, abs=1e-9)


def test_events_come_in_order_of_time_with_the_place_of_the_ego():
    """The ego brakes hard and is run into from behind a second later."""
    log = braking()
    t = np.arange(N) * 0.1
    follower = car("follows", track(np.minimum(-18.0 + 8.0 * t, 26.5), 0.0))
    log = replace(log, actors=log.actors | {"follows": follower}, render_start_us=300_000)
    found = scored(log)
    reduction = reduce_rollout(list(found.values()), "strict")
    brakes_us, hit_us = (
        int(log.ego.t_us[np.argmax(found[name].value > 0)])
        for name in ("hard_brake", "collision_rear")
    )
    assert 0 < brakes_us < hit_us
    times = {event["metric"]: event["t_us"] for event in reduction.events}
    assert (times["hard_brake"], times["collision_rear"]) == (brakes_us, hit_us)
    assert list(times.values()) == sorted(times.values())
    placed = placed_events(log, reduction)
    keys = [(event.t_us, event.metric) for event in placed]
    assert keys == sorted(keys)
    backwards = replace(reduction, events=reduction.events[::-1])
    assert placed_events(log, backwards) == placed
    for event in placed:
        at = log.ego.xyz[log.ego.t_us == event.t_us][0]
        assert (event.x_m, event.y_m) == pytest.approx(at[:2], abs=1e-3)
        assert event.t_s == pytest.approx((event.t_us - 300_000) * 1e-6)
