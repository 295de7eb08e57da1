"""Lane matching, x-error and jitter by the paper's protocol, on lanes whose scores are known."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from alpasim_plugin.lab.learned_metrics.lane_jitter import lane_jitter_m, tracks
from alpasim_plugin.lab.learned_metrics.lanes import (
    NEVER,
    LaneScore,
    counted,
    pairs,
    resampled,
    score_clip,
    score_frame,
    up_to,
)
from alpasim_plugin.lab.learned_metrics.types import FORWARD_M, Lane3D

ROWS = len(FORWARD_M)


def straight(lateral_m: float, first: int = 0, last: int = ROWS, score: float = 0.9) -> Lane3D:
    lateral = np.full(ROWS, np.nan)
    lateral[first:last] = lateral_m
    return Lane3D(lateral, score)


def partly(share_within: float) -> Lane3D:
    """A lane that is 1 m aside on a share of its samples and 2 m on the rest."""
    lateral = np.full(ROWS, 2.0)
    lateral[: round(share_within * ROWS)] = 1.0
    return Lane3D(lateral, 0.9)


def test_the_samples_are_the_papers() -> None:
    assert FORWARD_M[0] == 3
    assert FORWARD_M[-1] == 59
    assert ROWS == 29
    assert set(np.diff(FORWARD_M)) == {2.0}


def test_equal_lanes_score_one_without_error() -> None:
    lanes = [straight(-1.7), straight(1.7), straight(5.2)]
    found = score_frame(lanes, lanes)
    assert found.f1 == 1.0
    assert found.xerr_m == 0.0


def test_lanes_0_4_m_aside_match_with_that_error_and_1_6_m_aside_do_not() -> None:
    truth = [straight(1.7)]
    near = score_frame([straight(2.1)], truth)
    assert near.f1 == 1.0
    assert near.xerr_m == pytest.approx(0.4)
    assert near.xerr_near_m == pytest.approx(0.4)
    assert near.xerr_far_m == pytest.approx(0.4)
    far = score_frame([straight(3.3)], truth)
    assert far.f1 == 0.0
    assert far.xerr_m is None


def test_76_percent_within_the_gate_match_and_70_percent_do_not() -> None:
    assert score_frame([partly(0.76)], [straight(0.0)]).f1 == 1.0
    assert score_frame([partly(0.70)], [straight(0.0)]).f1 == 0.0


def test_nothing_on_both_sides_has_no_f1_and_on_one_side_zero() -> None:
    assert score_frame([], []).f1 is None
    assert score_frame([straight(0.0)], []).f1 == 0.0
    assert score_frame([], [straight(0.0)]).f1 == 0.0


def test_short_unsure_and_distant_lanes_do_not_count() -> None:
    assert counted([straight(0.0, 0, 11)]) != []  # 20 m of support
    assert counted([straight(0.0, 0, 10)]) == []
    assert counted([straight(0.0, score=0.49)]) == []
    assert counted([straight(10.0)]) != []
    assert counted([straight(10.1)]) == []


def test_lanes_with_less_than_10_m_in_common_are_not_compared() -> None:
    near, far = straight(0.0, 0, 15), straight(0.0, 10, ROWS)
    assert pairs([near], [far]) == []  # 5 samples: 8 m
    assert pairs([straight(0.0, 0, 16)], [far]) == [(0, 0)]  # 10 m


def test_the_assignment_is_the_best_of_all() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        truth = [straight(float(x)) for x in rng.uniform(-6, 6, 4)]
        made = [straight(float(x)) for x in rng.uniform(-6, 6, 4)]
        cost = np.array([[abs(a.lateral_m[0] - b.lateral_m[0]) for b in truth] for a in made])
        cost[cost > 1.5] = NEVER
        best = min(
            permutations(range(4)), key=lambda order: sum(cost[i, j] for i, j in enumerate(order))
        )
        wanted = [(i, j) for i, j in enumerate(best) if cost[i, j] < NEVER]
        found = pairs(made, truth)
        assert len(found) == len(wanted)
        assert sum(cost[i, j] for i, j in found) == pytest.approx(
            sum(cost[i, j] for i, j in wanted)
        )


def test_instances_are_pooled_over_a_clip() -> None:
    truth = [[straight(0.0), straight(3.5)]] * 3
    made = [[straight(0.0)], [straight(0.0), straight(3.5)], []]
    assert score_clip(made, truth).f1 == pytest.approx(2 * 3 / (3 + 6))
    assert score_clip([[], []], [[], []]) == LaneScore()


def test_a_cut_lane_counts_by_what_is_left() -> None:
    assert np.isfinite(up_to([straight(0.0)], 30.0)[0].lateral_m).sum() == 14


def test_resampling_does_not_go_beyond_the_visible_points() -> None:
    lane = resampled(np.array([20.0, 6.0, 10.0]), np.array([2.0, 0.6, 1.0]), 0.7)
    assert FORWARD_M[np.isfinite(lane.lateral_m)].tolist() == [7, 9, 11, 13, 15, 17, 19]
    assert lane.lateral_m[2] == pytest.approx(0.7)


def moving(v: np.ndarray) -> list[list[Lane3D]]:
    return [[straight(float(x))] for x in v]


@pytest.mark.parametrize(
    ("name", "v", "wanted"),
    [
        ("steady drift", 0.05 * np.arange(12), 0.0),
        ("constant acceleration", 0.01 * np.arange(12) ** 2, 0.01),
        ("alternating", 0.1 * (-1.0) ** np.arange(12), 0.2),
    ],
)
def test_jitter_of_known_motions(name: str, v: np.ndarray, wanted: float) -> None:
    assert lane_jitter_m(moving(v)) == pytest.approx(wanted, abs=1e-12)
    assert lane_jitter_m(moving(v), 20.0) == pytest.approx(wanted, abs=1e-12)


def test_jitter_of_white_noise_is_its_deviation_times_the_root_of_three_halves() -> None:
    v = 0.05 * np.random.default_rng(1).standard_normal(600)
    assert lane_jitter_m(moving(v)) == pytest.approx(0.05 * np.sqrt(1.5), rel=0.08)


def test_a_track_needs_five_frames_and_breaks_at_a_jump_beyond_the_gate() -> None:
    assert lane_jitter_m(moving(np.zeros(4))) is None
    jump = np.concatenate([np.zeros(6), np.full(6, 1.6)])
    assert [len(track) for track in tracks(moving(jump))] == [6, 6]
    assert lane_jitter_m(moving(jump)) == 0.0
    assert lane_jitter_m([[straight(0.0, 0, 12)]] * 6) is None  # no sample at 40 m
