"""Distance from the recorded path and progress along it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from evaluators.metrics.route import beside, moving, to_path
from tests.evaluators.eval_build import rollout, scored, track, values_of
from tests.evaluators.reference import route_by_step
from tests.evaluators.reference_rules import point_to_segment
from tests.examples import examples

PAIR = ("strict", "paper")


def test_driving_the_recording_again_has_no_distance_and_full_progress():
    log = rollout(track(np.linspace(0, 30, 31), 0.0))
    found = scored(log)
    assert found["route_distance_m"].value.max() < 1e-12
    assert found["dist_to_gt_location"].value.max() < 1e-12
    assert found["progress"].value[-1] == pytest.approx(1.0)
    assert found["progress_rel"].value == pytest.approx(np.ones(31))
    assert found["dist_traveled_m"].value[-1] == pytest.approx(30.0)
    assert found["gt_dist_traveled_m"].value[0] == pytest.approx(30.0)


def test_route_distance_is_the_mean_over_the_scored_steps_of_the_distance_to_the_path():
    y = np.array([5.0, 5.0, 0.0, 1.0, 2.0])  # 5 m away in the warm-up: does not count
    log = rollout(track(np.arange(5.0), y), log=track(np.arange(5.0), 0.0), warmup_us=200_000)
    values = values_of(log)
    assert values["route_distance_m"].value == pytest.approx(1.0)
    assert values["dist_to_gt_trajectory"].value == pytest.approx(2.0)
    assert values["dist_traveled_m"].value == pytest.approx(2 * np.sqrt(2.0))


def test_the_point_compared_is_the_box_centre():
    # Same box centres, other heading: the rear axle is elsewhere, the distance is zero.
    log = rollout(track(np.arange(5.0), 0.0, yaw=0.3), log=track(np.arange(5.0), 0.0))
    assert scored(log)["route_distance_m"].value.max() < 1e-12


def test_lagging_behind_shows_in_location_and_progress_but_not_in_route_distance():
    log = rollout(track(np.arange(5.0) / 2, 0.0), log=track(np.arange(5.0), 0.0))
    found = scored(log)
    assert found["route_distance_m"].value.max() < 1e-12
    assert found["dist_to_gt_location"].value == pytest.approx(np.arange(5.0) / 2)
    assert found["progress"].value == pytest.approx(np.arange(5.0) / 8)
    assert found["progress_rel"].value == pytest.approx([1.0, 0.5, 0.5, 0.5, 0.5])


def test_a_recording_that_stands_still_has_no_progress_and_is_not_divided_by_zero():
    log = rollout(track(np.arange(3.0), 0.0), log=track(0.0, 0.0, n=3))
    found = scored(log)
    assert not found["progress"].valid.any()
    assert found["progress"].reason == "the recorded path has no length"
    assert found["progress_rel"].value.tolist() == [1.0, 1.0, 1.0]
    assert found["route_distance_m"].value == pytest.approx(np.arange(3.0))


def test_one_step_rollout_and_one_pose_recording_are_scored():
    log = rollout(track(3.0, 4.0), log=track(0.0, 0.0))
    values = values_of(log)
    assert values["route_distance_m"].value == pytest.approx(5.0)
    assert values["progress_rel"].value == 1.0
    assert values["dist_traveled_m"].value == 0.0
    assert (values["progress"].value, values["progress"].valid) == (None, False)


def test_steps_after_the_end_of_the_recording_have_no_recorded_location():
    log = rollout(track(np.arange(5.0), 0.0), log=track(np.arange(3.0), 0.0))
    found = scored(log)["dist_to_gt_location"]
    assert found.valid.tolist() == [True, True, True, False, False]
    assert found.reason == "the recording does not cover this time"


def test_nothing_is_relevant_before_the_handover_and_a_pure_replay_gives_no_value():
    log = rollout(track(np.arange(5.0), 0.0), warmup_us=300_000)
    assert scored(log)["eval_relevant"].value.tolist() == [0, 0, 0, 1, 1]
    whole = replace(log, force_gt_us=10_000_000)
    value = values_of(whole)["offroad"]
    assert value.value is None
    assert value.reason == "the policy never took over: every step belongs to the warm-up"


def test_a_polyline_with_repeated_points_and_a_path_that_comes_back():
    path = np.array([[0.0, 0], [0, 0], [10, 0], [10, 0], [0, 0]])
    distance_m, s = to_path(path, np.array([[5.0, 1.0], [12.0, 0.0]]))
    assert distance_m.tolist() == [1.0, 2.0]
    assert s.tolist() == [5.0, 10.0]


xy = st.tuples(st.integers(-6, 6).map(float), st.integers(-6, 6).map(float))


@settings(max_examples=examples(100), deadline=None)
@given(st.lists(st.tuples(xy, xy), min_size=2, max_size=8), st.sampled_from([0.0, 5_334_000.0]))
def test_array_projection_and_twin_agree(points, offset):
    recorded, driven = (np.array(column) for column in zip(*points, strict=True))
    log = rollout(
        track(driven[:, 0] + offset, driven[:, 1]),
        log=track(recorded[:, 0] + offset, recorded[:, 1]),
    )
    if len(moving(recorded)) == 1:
        return
    found = scored(log)
    slow = route_by_step(log)
    tol = (
        1e-9 if offset == 0 else 1e-6
    )  # moving the rig to the box centre and back rounds at UTM size
    distance = found["dist_to_gt_trajectory"]
    assert_allclose(
        distance.value[distance.valid],
        np.array([one.distance_m for one in slow])[distance.valid],
        atol=tol,
    )
    assert_allclose(found["dist_to_gt_location"].value, [one.away_m for one in slow], atol=tol)
    if offset == 0:
        # Where the ego is equally far from two parts of the path, rounding picks one of them.
        for name, want in (
            ("progress", [one.progress for one in slow]),
            ("progress_rel", [one.progress_rel for one in slow]),
        ):
            same = np.isclose(found[name].value, want, atol=1e-9)
            for k in np.flatnonzero(~same)[
                :1
            ]:  # progress goes on from where it was: a tie decides about all after it
                assert leaps(want, k, recorded, driven) or is_ambiguous(
                    recorded if name == "progress" else recorded[: k + 1], driven[k]
                )


def leaps(progress, k, recorded, driven):
    """Tell whether the nearest point of the path is farther along than the ego can have come."""
    length_m = np.hypot(*np.diff(recorded, axis=0).T).sum()
    moved_m = np.hypot(*(driven[k] - driven[max(k - 1, 0)]))
    before = progress[k - 1] if k else 0.0
    return not 0.0 <= (progress[k] - before) * length_m <= 2.0 + 2.0 * moved_m


def is_ambiguous(path, point):
    near = sorted(point_to_segment(point, a, b)[0] for a, b in pairwise(path))
    return len(near) > 1 and near[1] - near[0] < 1e-9


def test_lateral_bias_is_the_signed_mean_left_positive_and_follows_the_paths_direction():
    for heading in (0.0, 0.9, np.pi, -2.0):
        c = np.cos(heading)
        s = np.sin(heading)
        x = np.arange(5.0)
        y = np.array([0.0, 9.0, 0.5, 0.5, -1.6])
        log = rollout(
            track(c * x - s * y, s * x + c * y, yaw=heading), log=track(c * x, s * x, yaw=heading)
        )
        assert scored(log)["lateral_bias_m"].value == pytest.approx(y, abs=1e-9)
    log = rollout(
        track(np.arange(5.0), np.array([9.0, 9.0, 0.5, 0.5, -0.4])),
        log=track(np.arange(5.0), 0.0),
        warmup_us=200_000,
    )
    assert values_of(log)["lateral_bias_m"].value == pytest.approx(
        0.2
    )  # the warm-up does not count


def test_lateral_bias_changes_side_with_a_bend_and_agrees_with_the_distance():
    angle = np.linspace(0.0, 1.5, 16)
    path = 20 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    inside = 18 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1) + [
        0.0,
        2.0,
    ]  # nearer to the centre of a left bend: left
    found = scored(rollout(track(inside[:, 0], inside[:, 1]), log=track(path[:, 0], path[:, 1])))
    assert (found["lateral_bias_m"].value > 1.9).all()
    assert np.abs(found["lateral_bias_m"].value) == pytest.approx(found["lateral_distance_m"].value)


def test_driving_past_where_the_recording_stands_counts_in_the_papers_distance_and_not_to_the_side():
    log = rollout(track(np.arange(9.0), 0.4), log=track(np.minimum(np.arange(12.0), 4.0), 0.0))
    found = scored(log)
    assert found["route_distance_m"].value[-1] == pytest.approx(np.hypot(4.0, 0.4))
    assert found["lateral_distance_m"].value == pytest.approx(np.full(9, 0.4))
    assert found["lateral_bias_m"].value == pytest.approx(np.full(9, 0.4))
    assert "lateral_distance_m" not in scored(log, preset="alpasim")


def test_behind_a_recording_that_drives_on_the_distance_from_it_is_not_known():
    log = rollout(track(np.arange(9.0), 0.4), log=track(np.arange(5.0), 0.0))
    distance = scored(log)["route_distance_m"]
    assert distance.valid.tolist() == [True] * 5 + [False] * 4
    assert distance.reason == "no recorded drive behind the end of the recording"
    assert scored(log)["lateral_distance_m"].value == pytest.approx(np.full(9, 0.4))


def test_the_papers_preset_drops_what_comes_behind_a_recording_that_drives_on():
    log = rollout(track(np.arange(9.0), 0.4), log=track(np.arange(5.0), 0.0))
    values = {name: values_of(log, preset=name)["dist_traveled_m"].value for name in PAIR}
    assert values == {"strict": pytest.approx(8.0), "paper": pytest.approx(5.0)}


@settings(max_examples=examples(40))
@given(
    st.lists(st.floats(-0.4, 0.4), min_size=3, max_size=12), st.floats(-30, 60), st.floats(-20, 20)
)
def test_the_lateral_distance_is_that_from_a_path_with_a_mile_of_straight_at_each_end(turns, x, y):
    heading = np.cumsum(turns)
    path = np.concatenate(
        [
            [[0.0, 0.0]],
            np.cumsum(2.0 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0),
        ]
    )
    at = np.array([[x, y]])
    distance_m, s = to_path(path, at)
    found = beside(path, s, at, distance_m)[0]
    ends = [
        path[0] - 1600 * (path[1] - path[0]) / 2.0,
        path[-1] + 1600 * (path[-1] - path[-2]) / 2.0,
    ]
    longer = np.concatenate([ends[:1], path, ends[1:]])
    slow = min(point_to_segment(at[0], a, b)[0] for a, b in pairwise(longer))
    assert found <= distance_m[0] + 1e-9
    assert found >= slow - 1e-9
    if (
        0 < s[0] < 2.0 * len(turns) - 1e-9
    ):  # beside the path itself, even where a straight end passes nearer
        assert found == distance_m[0]
    elif (
        abs(found - slow) > 1e-9
    ):  # the other end, going straight on, may pass nearer: only its own end counts
        assert found > slow


def test_a_recording_that_stops_for_long_keeps_its_direction():
    x = np.concatenate([np.linspace(0.0, 10.0, 21), np.full(20, 10.0) + 1e-9 * np.arange(20)])
    log = rollout(track(np.linspace(0.0, 14.0, 41), -0.3), log=track(x, 0.0))
    assert scored(log)["lateral_distance_m"].value == pytest.approx(np.full(41, 0.3))


def test_a_recording_that_stands_still_has_no_left():
    log = rollout(track(np.arange(3.0), 0.0), log=track(np.zeros(3), 0.0))
    bias = scored(log)["lateral_bias_m"]
    assert not bias.valid.any()
    assert bias.reason == "the recorded path is shorter than 1 m: it has no direction"


@pytest.mark.parametrize("end", ["first", "last"])
@pytest.mark.parametrize("noise_m", [0.0, 1e-9, 0.05])
def test_noise_where_the_recorded_car_stands_moves_neither_distance_nor_progress(end, noise_m):
    rng = np.random.default_rng(3)
    x = (
        np.concatenate([np.linspace(0.0, 20.0, 41), np.full(100, 20.0)])
        if end == "last"
        else np.append(np.zeros(100), np.linspace(0, 20, 41))
    )
    log = rollout(
        track(np.linspace(-18.0, 38.0, 141), 0.3),
        log=track(x + noise_m * rng.normal(size=141), noise_m * rng.normal(size=141)),
    )
    found = scored(log)
    assert np.abs(found["lateral_distance_m"].value - 0.3).max() <= 40 * noise_m + 1e-9
    assert np.abs(found["lateral_bias_m"].value - 0.3).max() <= 40 * noise_m + 1e-9
    assert found["progress"].value == pytest.approx(
        np.clip(np.linspace(-18.0, 38.0, 141) / 20.0, 0.0, 1.0), abs=noise_m + 1e-9
    )


def test_a_recording_that_stands_all_the_time_has_no_length_whatever_its_noise():
    noise = 0.05 * np.random.default_rng(0).normal(size=(2, 200))
    found = scored(rollout(track(np.zeros(200), 0.0), log=track(*noise)))
    assert not found["progress"].valid.any()
    assert not found["lateral_distance_m"].valid.any()


def test_progress_on_the_way_out_of_a_u_turn_is_not_that_of_the_way_back_beside_it():
    turn = np.linspace(-np.pi / 2, np.pi / 2, 21)
    out = np.arange(0.0, 100.0)
    back = np.arange(100.0, -1.0, -1.0)
    path = np.concatenate(
        [
            np.stack([out, 0 * out]),
            [100 + 2 * np.cos(turn), 2 + 2 * np.sin(turn)],
            np.stack([back, 4 + 0 * back]),
        ],
        axis=1,
    )
    x, y = (
        np.linspace(0, 10, 30),
        np.minimum(np.linspace(0, 6, 30), 3.0),
    )  # leaves its way to the left, and stops there
    for k, want in ((0, 10.0), (200, 10.0)):  # however long it stays there
        ego = track(np.append(x, np.full(k, 10.0)), np.append(y, np.full(k, 3.0)))
        log = rollout(ego, log=track(path[0], path[1]))
        assert scored(log)["progress"].value[-1] * (200 + 2 * np.pi) == pytest.approx(want, abs=0.1)
        assert values_of(log)["progress"].value < 0.06


def test_a_recording_that_turns_back_on_itself_is_followed_out_and_back():
    x = np.concatenate([np.linspace(0.0, 20.0, 41), np.linspace(20.0, 0.0, 41)[1:]])
    path = track(x, 0.0)
    turned = np.append(x[:61], np.full(20, x[60]))
    for ego_x, want in ((x, 1.0), (0.0 * x, 0.0), (np.maximum.accumulate(x), 0.5), (turned, 0.75)):
        for aside_m in (0.0, 0.4):
            found = scored(rollout(track(ego_x, aside_m), log=path))["progress"].value
            assert found[-1] == pytest.approx(want, abs=1e-6)
            assert np.diff(found).min() >= 0.0


def test_a_closed_loop_starts_at_its_start_and_ends_at_its_end():
    angle = np.linspace(0.0, 2 * np.pi, 301)
    path = track(30 * np.sin(angle), 30 - 30 * np.cos(angle))
    standing = rollout(track(np.full(60, -0.1), 0.0), log=path)
    assert scored(standing)["progress"].value.max() == 0.0
    whole = scored(rollout(path))["progress"].value
    assert whole == pytest.approx(angle / (2 * np.pi), abs=1e-9)
    beside_m = track(path.xyz[:, 0] * 0.9, path.xyz[:, 1] * 0.9 + 3.0)
    assert scored(rollout(beside_m, log=path))["progress"].value[[0, -1]] == pytest.approx(
        [0, 1], abs=1e-3
    )


def test_a_drive_that_skips_a_loop_finds_the_path_again_behind_it():
    """The recording drives a full circle to its left in the middle of a straight road."""
    turn = np.linspace(-np.pi / 2, 1.5 * np.pi, 158)[1:-1]
    circle = np.column_stack([25 * np.cos(turn), 25 + 25 * np.sin(turn)])
    straight = np.arange(-40.0, 0.0)
    ahead = np.arange(0.0, 91.0)
    path = np.concatenate(
        [np.column_stack([straight, 0 * straight]), circle, np.column_stack([ahead, 0 * ahead])]
    )
    x = np.arange(-40.0, 91.0)
    log = rollout(track(x, 0.0), log=track(path[:, 0], path[:, 1]))
    found = scored(log)["progress"].value
    assert found[-1] == pytest.approx(1.0)
    assert found[30] < 0.12 < 0.8 < found[80]
    assert np.all(np.diff(found) > -0.02)
    # The way back of a U-turn runs the other way: who leaves the way out towards it is not on it.
    there = np.arange(0.0, 80.0)
    out_and_back = np.concatenate(
        [np.column_stack([there, 0 * there]), np.column_stack([there[::-1], 0 * there + 6.0])]
    )
    aside = rollout(track(there, 5.0), log=track(out_and_back[:, 0], out_and_back[:, 1]))
    assert scored(aside)["progress"].value.max() < 0.55
