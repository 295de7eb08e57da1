"""Means, intervals, pairs and the ledger over rollouts, against numbers worked out by hand or by
scipy.
"""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

from alpasim_plugin.log.run_folder.records import RolloutError
from alpasim_plugin.log.run_folder.sides import RolloutTable
from evaluators import aggregate, censoring, paired
from evaluators.metrics import METRICS
from evaluators.results import InvalidValues
from evaluators.statistics.bounded import mean_interval, rate_interval
from evaluators.statistics.intervals import (
    cluster_means,
    exact_rate,
    normal_half_width,
)
from evaluators.statistics.summary import numbers
from tests.evaluators.rollout_rows import manifests_of, rows_of


def entry(values, metric="route_distance_m"):
    return aggregate(rows_of(values, metric))["3dgs"][metric]


def test_mean_and_the_papers_half_width():
    values = [[1.0, 2.0], [4.0, 5.0], [3.0, 9.0]]
    flat = np.ravel(values)
    found = entry(values)
    assert found.mean == pytest.approx(4.0)
    assert found.ci95 == pytest.approx(1.96 * np.std(flat, ddof=1) / np.sqrt(6))
    assert (found.n_rollouts, found.n_scenes, found.unit, found.direction) == (
        6,
        3,
        "m",
        "lower",
    )


def test_the_clustered_interval_of_a_distance_holds_that_of_t_on_scene_means():
    values = [[1.0, 2.0], [4.0, 5.0], [3.0, 9.0]]
    means = [1.5, 4.5, 6.0]
    high = stats.t.interval(0.95, 2, loc=np.mean(means), scale=stats.sem(means))[1]
    assert high > 4.0, "beyond the cap"
    found = entry(values, "lateral_distance_m").ci95_clustered
    assert found == pytest.approx([0.0, high], abs=0.1)


@pytest.mark.parametrize("metric", ["min_distance_to_obstacle_m", "offroad_margin_m"])
def test_a_mean_has_no_interval_where_nothing_says_how_far_other_scenes_lie(metric):
    found = entry([[1.0, 2.0], [4.0, 5.0], [3.0, 9.0]], metric)
    assert found.mean == 4.0
    assert (found.ci95_clustered, found.ci95_clustered_method) == (None, None)
    assert "a scene that was not driven" in found.ci95_clustered_reason


def test_with_unequal_seeds_scenes_weigh_alike_in_the_clustered_interval():
    found = entry([[0.1, 0.2, 0.3, None], [1.0]], "progress")
    assert found.mean == pytest.approx(0.4)  # over rollouts
    assert (
        found.note
        == "scenes have different numbers of values: the interval is about the mean over scenes, 0.6"
    )
    assert entry([[1.0, 2.0], [10.0, 3.0]], "lateral_bias_m").note is None
    assert found.n_invalid == 1


def test_repeats_of_a_cell_are_averaged_first():
    rows = rows_of([[1.0], [5.0]]) + rows_of([[3.0]])
    found = aggregate(rows)["3dgs"]["route_distance_m"]
    assert found.mean == pytest.approx(3.5)
    assert found.n_rollouts == 2


def test_one_rollout_has_a_mean_and_no_interval_and_says_why():
    found = entry([[0.0]], "offroad")
    assert (found.mean, found.ci95, found.ci95_clustered) == (0.0, None, None)
    assert found.ci95_reason == "one rollout has no spread"
    assert found.ci95_clustered_reason == "needs at least two scenes, found 1"


def test_a_rate_of_zero_gets_exact_bounds_over_scenes():
    found = entry([[0.0, 0.0]] * 10, "collision_at_fault")
    assert (found.mean, found.ci95, found.n_events) == (0.0, 0.0, 0)
    assert found.ci95_clustered == pytest.approx([0.0, 1 - 0.025 ** (1 / 10)])
    assert found.ci95_clustered_method == "mean of scenes from 0 to 1"
    assert entry([[1.0]] * 4, "offroad").ci95_clustered == pytest.approx([0.025 ** (1 / 4), 1.0])


def test_no_interval_of_a_sample_is_without_width():
    for metric, value in (("progress", 1.0), ("lateral_distance_m", 0.0), ("offroad", 0.0)):
        low, high = entry([[value]] * 3, metric).ci95_clustered
        assert high - low > 0.7, metric


@pytest.mark.parametrize("scenes", [3, 12, 60])
def test_means_whose_rare_scenes_were_not_drawn_are_covered(scenes):
    """One drive in ten stops early; one in fifty is 3 m beside the path."""
    rng = np.random.Generator(np.random.Philox(scenes))
    for metric, usual, rare, share in (
        ("progress", 1.0, 0.3, 0.1),
        ("lateral_distance_m", 0.1, 3.0, 0.02),
    ):
        truth = usual + share * (rare - usual)
        held = 0
        for _ in range(100):
            means = np.where(rng.random(scenes) < share, rare, usual)
            one = mean_interval(means + rng.normal(0, 1e-3, scenes), METRICS[metric])
            held += one.low <= truth <= one.high
        assert held >= 95, metric


def test_failed_and_invalid_rollouts_do_not_enter_and_are_counted():
    rows = rows_of([[1.0, None], [3.0, 3.0]]) + rows_of([[0.0]], status="failed")
    found = aggregate(rows)["3dgs"]["route_distance_m"]
    assert (found.mean, found.n_rollouts, found.n_invalid) == (pytest.approx(7 / 3), 3, 1)


def test_a_metric_that_is_valid_nowhere_is_null_with_a_reason_and_not_zero():
    found = entry([[None, None], [None, None]], "offroad")
    assert (found.mean, found.ci95, found.ci95_clustered) == (None, None, None)
    assert found.reason == "valid in none of 4 rollouts"
    failed = aggregate(rows_of([[1.0]], status="failed"))["3dgs"]["route_distance_m"]
    assert failed.reason == "no rollout finished"


def test_infinite_values_do_not_reach_a_mean():
    assert entry([[1.0], [float("inf")], [float("nan")]]).mean == 1.0


# --- pairs


def pair(base, other, metric="route_distance_m"):
    rows = rows_of(base, metric, "clean") + rows_of(other, metric, "3dgs")
    return paired(rows, "clean")["3dgs"][metric]


def test_differences_are_taken_cell_by_cell_and_averaged_per_scene():
    base = [[1.0, 2.0], [10.0, 20.0], [5.0, 5.0]]
    other = [[1.5, 3.0], [10.7, 20.9], [5.4, 5.6]]
    means = [0.75, 0.8, 0.5]
    found = pair(base, other)
    low, high = stats.t.interval(0.95, 2, loc=np.mean(means), scale=stats.sem(means))
    assert found.diff == pytest.approx(np.mean(means))
    assert found.ci95[0] < low < high < found.ci95[1], "it allows for scenes at the cap"
    assert found.p_value == 2 / 2**3
    assert (found.n_cells, found.n_scenes, found.baseline) == (6, 3, "clean")
    assert (found.verdict, found.difference) == ("undecided", None), "three scenes decide nothing"
    for n, wanted in (
        (2, ("undecided", "worse")),
        (20, ("worse", "worse")),
    ):  # a few scenes may be far better unseen
        worse = pair(base * n, other * n)
        assert (worse.verdict, worse.difference) == wanted
    better = pair(other * 130, base * 130)
    assert (better.verdict, better.difference) == ("non-inferior", "better")


def test_flags_take_the_exact_sign_test_on_scenes():
    base = [[0.0, 0.0]] * 8
    other = [[1.0, 1.0]] * 6 + [[0.0, 0.0]] * 2
    found = pair(base, other, "collision_at_fault")
    assert found.p_value == pytest.approx(2 * 0.5**6)
    assert found.test == "exact sign-flip test on scenes"
    assert found.verdict == "worse"
    assert (
        pair(base, [[1.0, 0.0]] * 5 + [[0.0, 0.0]] * 3, "collision_at_fault").verdict == "undecided"
    )  # p = 0.0625


def test_seeds_of_one_scene_are_not_independent_evidence():
    found = pair([[0.0] * 50], [[1.0] * 50])
    assert found.diff == 1.0
    assert (found.ci95, found.p_value, found.verdict) == (None, None, "undecided")
    assert found.reason == "needs at least two scenes, found 1"


def test_no_difference_at_all_has_p_one_and_is_non_inferior_once_the_scenes_could_have_shown_one():
    for n, wanted in ((3, "undecided"), (145, "undecided"), (146, "non-inferior")):
        same = [[float(i)] for i in range(n)]
        found = pair(same, same)
        assert (found.diff, found.p_value, found.verdict, found.difference) == (
            0.0,
            1.0,
            wanted,
            None,
        )


def test_cells_that_one_side_lacks_are_left_out_and_counted():
    found = pair([[1.0, 2.0], [3.0, None]], [[2.0, None], [4.0, 9.0]])
    assert (found.diff, found.n_cells, found.n_missing) == (1.0, 2, 2)
    empty = pair([[1.0, None]], [[None, 2.0]])
    assert (empty.diff, empty.verdict) == (None, "undecided")
    assert empty.reason == "no scene and seed has this metric on both sides"


def test_a_metric_without_a_better_side_gets_no_verdict():
    assert (
        pair([[0.0], [0.0], [0.1]], [[5.0], [5.0], [5.0]], "dist_traveled_m").verdict == "undecided"
    )


def test_higher_is_better_for_progress():
    assert (
        pair([[0.1], [0.2], [0.1]] * 4, [[0.9], [0.9], [0.9]] * 4, "progress").difference
        == "better"
    )
    assert pair([[0.9], [0.9], [0.9]] * 4, [[0.1], [0.2], [0.1]] * 4, "progress").verdict == "worse"


# --- ledger


def test_the_ledger_counts_every_cause_and_bounds_every_rate():
    ledger = {
        "steps_total": 10,
        "steps_warmup": 2,
        "steps_after_event": 3,
        "steps_after_drift": 0,
        "steps_scored": 5,
        "dropped": "",
    }
    manifests = manifests_of([[1.0, 0.0], [None, 0.0]], "offroad", censored=ledger)
    error = RolloutError("no plan", "correct it", "policy")
    manifests.append(
        replace(manifests[0], scene="scene-9", status="failed", error=error, censored=None)
    )
    found = censoring(manifests)["3dgs"]
    assert found.rollouts == 5
    assert found.failed == {"policy": 1}
    assert (
        found.steps_total,
        found.steps_warmup,
        found.steps_after_event,
        found.steps_scored,
    ) == (40, 8, 12, 20)
    assert found.invalid["offroad"] == InvalidValues(1, {"not given": 1})
    assert found.bounds_rollouts["offroad"] == pytest.approx((1 / 5, 3 / 5))
    low, high = found.bounds_rollouts_ci95["offroad"]
    assert low < 1 / 5 < 3 / 5 < high
    # Two rollouts without the event lost their last three steps: it may have happened there.
    assert found.bounds["offroad"] == pytest.approx((1 / 5, 5 / 5))
    assert found.cut["offroad"] == 2


def test_bounds_with_sampling_error_hold_the_rate_where_crashes_hide_events():
    """Half of the rollouts with an event crash; the truth is 20 %."""
    rng = np.random.default_rng(6)
    held = 0
    for _ in range(100):
        had = (rng.random(40) < 0.2).astype(float)
        gone = (had > 0) & (rng.random(40) < 0.5)
        manifests = manifests_of(
            [[None if lost else value] for lost, value in zip(gone, had, strict=True)], "offroad"
        )
        low, high = censoring(manifests)["3dgs"].bounds_rollouts_ci95["offroad"]
        held += low <= 0.2 <= high
    assert held >= 93


# --- intervals


def test_exact_bounds_agree_with_scipy():
    for k, n in ((0, 7), (3, 20), (20, 20), (5, 300)):
        want = stats.binomtest(k, n).proportion_ci(0.95, "exact")
        assert exact_rate(k, n) == pytest.approx((want.low, want.high))


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_coverage_of_the_clustered_interval_and_under_coverage_of_the_papers(correlation):
    """60 scenes x 5 seeds, probit scene effect, true rate 10 %."""
    rng = np.random.Generator(np.random.Philox(int(correlation * 10)))
    scenes = [f"s{i:02d}" for i in range(60) for _ in range(5)]
    threshold = stats.norm.ppf(0.1)
    naive = by_scene = 0
    repeats = 300
    for _ in range(repeats):
        effect = np.repeat(rng.normal(0, np.sqrt(correlation), 60), 5)
        hits = (effect + rng.normal(0, np.sqrt(1 - correlation), 300) < threshold).astype(float)
        half, _ = normal_half_width(hits)
        naive += abs(hits.mean() - 0.1) <= half
        one = rate_interval(cluster_means(hits, scenes)[0])
        by_scene += one.low <= 0.1 <= one.high
    assert by_scene / repeats >= 0.94
    if correlation == 0.8:
        assert naive / repeats < 0.82


def test_intervals_of_bounded_quantities_stay_within_their_bounds():
    shares = rows_of([[1.0], [1.0], [0.7]], metric="progress")
    found = aggregate(shares)["3dgs"]["progress"]
    assert found.ci95_clustered[1] <= 1.0
    assert 0.0 <= found.ci95_clustered[0] < 0.9
    lengths = rows_of([[0.0], [0.1], [1.5]], metric="lateral_distance_m")
    assert aggregate(lengths)["3dgs"]["lateral_distance_m"].ci95_clustered[0] == 0.0
    signed = rows_of([[0.0], [0.1], [1.5]], metric="lateral_bias_m")
    assert aggregate(signed)["3dgs"]["lateral_bias_m"].ci95_clustered[0] < 0.0
    pair = paired(
        rows_of([[0.0], [0.0], [0.2]], "progress", "a")
        + rows_of([[1.0], [1.0], [0.2]], "progress", "b"),
        "a",
    )["b"]["progress"]
    assert 0.9 < pair.ci95[1] <= 1.0
    assert pair.ci95[0] < 0.0


def test_a_fixer_is_compared_with_what_it_repairs_too():
    rows = rows_of([[1.0], [2.0], [3.0]], renderer="clean") + rows_of(
        [[1.5], [2.6], [3.4]], renderer="3dgs"
    )
    rows += rows_of([[1.2], [2.1], [3.2]], renderer="onefixer")
    table = RolloutTable.of_table(pa.Table.from_pylist(rows))
    bases = {"onefixer": "3dgs", "onefixer+clean": "clean"}
    found = numbers(table, "clean", bases).paired_with_base
    assert list(found) == ["onefixer"]
    entry = found["onefixer"]["route_distance_m"]
    assert (entry.baseline, entry.diff) == ("3dgs", pytest.approx(-1.0 / 3.0))
    alone = paired(rows, "3dgs")["onefixer"]["route_distance_m"]
    assert replace(entry, p_corrected=None) == replace(alone, p_corrected=None)
    # Paired with it already.
    assert numbers(table, "3dgs", bases).paired_with_base == {}
