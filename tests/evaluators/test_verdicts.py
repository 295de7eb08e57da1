"""The three-way verdict, its companions, and cells without a pair."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from evaluators import paired
from evaluators.statistics.paired import flag_interval
from evaluators.statistics.verdicts import difference, verdict
from tests.evaluators.test_tables_over_rollouts import rows_of


def pair(base, other, metric="route_distance_m", **options):
    return paired(rows_of(base, metric, "clean") + rows_of(other, metric, "3dgs"), "clean", **options)["3dgs"][metric]


@pytest.mark.parametrize(
    ("bounds", "wanted"),
    [
        ([-0.3, -0.1], "non-inferior"),
        ([-0.1, 0.19], "non-inferior"),
        ([0.05, 0.19], "non-inferior"),  # worse than 0, and within the margin
        ([-0.1, 0.2], "undecided"),
        ([0.05, 0.3], "undecided"),
        ([0.2, 0.3], "undecided"),  # touches the margin
        ([0.21, 0.3], "worse"),
        (None, "undecided"),
    ],
)
def test_the_margin_divides_the_verdicts(bounds, wanted):
    assert verdict(bounds, 0.001, 0.2, "lower") == wanted
    mirrored = None if bounds is None else [-bounds[1], -bounds[0]]
    assert verdict(mirrored, 0.001, 0.2, "higher") == wanted


def test_worse_also_needs_the_test_to_reject():
    assert verdict([0.21, 0.3], 0.0625, 0.2, "lower") == "undecided"


def test_a_metric_without_a_better_side_is_worse_on_either_side_of_its_margin():
    for sign in (1, -1):
        bounds = sorted([sign * 0.3, sign * 0.5])
        assert verdict(bounds, 0.001, 0.2, "none") == "worse"
        assert verdict(bounds, 0.001, 0.6, "none") == "non-inferior"
        assert verdict(bounds, 0.001, 0.4, "none") == "undecided"
        assert verdict(bounds, 0.001, 0.0, "none") == "undecided"


def test_difference_knows_no_margin():
    assert difference([0.05, 0.19], 0.01, "lower") == "worse"
    assert difference([0.05, 0.19], 0.01, "higher") == "better"
    assert difference([0.0, 0.19], 0.01, "lower") == "none shown"
    assert difference([0.05, 0.19], 0.06, "lower") == "none shown"


def test_margins_are_given_or_the_documented_defaults():
    base, other = [[1.0], [2.0], [3.0], [4.0]], [[1.3], [2.31], [3.29], [4.3]]
    assert pair(base, other)["margin"] == 0.1
    assert pair(base, other)["verdict"] == "worse"
    assert pair(base, other, margins={"route_distance_m": 0.5})["verdict"] == "non-inferior"
    assert pair([[0.0]] * 3, [[0.0]] * 3, "offroad")["margin"] == 0.02


def test_an_undecided_difference_says_how_many_more_scenes_would_decide_it():
    rng = np.random.Generator(np.random.Philox(2))
    base = rng.normal(1.0, 0.5, (8, 1))
    found = pair(base.tolist(), (base + rng.normal(0.3, 0.5, (8, 1))).tolist())
    assert found["verdict"] == "undecided"
    assert found["spread"] == pytest.approx(0.5, rel=0.6)
    assert 5 < found["more_scenes"] < 2000
    assert pair([[1.0], [2.0]], [[1.0], [2.0]])["more_scenes"] is None


def test_rare_events_alone_never_decide_on_few_scenes():
    found = pair([[0.0, 0.0]] * 20, [[0.0, 0.0]] * 20, "offroad")
    bound = 1 - 0.025 ** (1 / 20)
    assert found["ci95"] == pytest.approx([-bound, bound])
    assert (found["verdict"], found["more_scenes"]) == ("undecided", 183 - 20)  # margin of 2 points
    assert found["note"].startswith("0 of 20 scenes changed")
    assert pair([[0.0]] * 200, [[0.0]] * 200, "offroad")["verdict"] == "non-inferior"


def test_bounds_of_a_rate_difference_widen_until_six_scenes_have_changed():
    scenes = [f"s{i:02d}" for i in range(60)]
    five, six = np.zeros(60), np.zeros(60)
    five[:5], six[:6] = 1.0, 1.0
    few, enough = flag_interval(five, scenes), flag_interval(six, scenes)
    assert few.method == "gained and lost rates joined"
    assert few.low < 5 / 60 < few.high
    assert few.high - few.low > stats.t.ppf(0.975, 59) * 2 * stats.sem(five)
    assert enough.method == "t on scenes"
    balanced = np.zeros(60)
    balanced[:2], balanced[2:4] = 1.0, -1.0
    swapped = flag_interval(balanced, scenes)
    assert swapped.low == pytest.approx(-swapped.high)
    assert swapped.high > 0.05


def test_mcnemar_counts_cells_and_the_sign_test_scenes():
    base = [[0.0, 0.0, 1.0]] * 4 + [[0.0, 0.0, 0.0]] * 4
    other = [[1.0, 1.0, 0.0]] * 4 + [[0.0, 0.0, 0.0]] * 4
    found = pair(base, other, "collision_any")
    assert found["cells"] == {"only_here": 8, "only_baseline": 4, "p_value": pytest.approx(stats.binomtest(8, 12).pvalue)}
    assert found["scenes"] == {"up": 4, "down": 0, "same": 4, "p_value": pytest.approx(2 * 0.5**4)}
    assert found["p_value"] == found["scenes"]["p_value"]


def test_every_cell_without_a_pair_is_named_with_its_side_and_cause():
    base = rows_of([[1.0, 1.0], [2.0, None]], renderer="clean")
    other = rows_of([[1.5, 1.5], [2.5, None]])[:3] + rows_of([[0.0]])[:0]
    other[1] |= {"status": "failed", "failure_class": "renderer"}
    found = paired(base + other, "clean")["3dgs"]["route_distance_m"]
    assert (found["n_cells"], found["n_missing"]) == (2, 2)
    first, second = found["missing"]
    assert (first["scene"], first["seed"], first["missing"], first["why"]) == ("scene-0", 1, "here", "here: failed (renderer)")
    assert (second["scene"], second["seed"], second["missing"]) == ("scene-1", 1, "both")
    assert second["why"] == "here: not planned; baseline: not valid (not given)"
    assert paired(base + other, "clean", listed=1)["3dgs"]["route_distance_m"]["n_missing"] == 2


def test_a_hundred_thousand_rollouts_are_not_slow_because_of_pairs():
    import time

    scenes, seeds = 2000, 5
    rng = np.random.Generator(np.random.Philox(1))
    names = ["route_distance_m", "offroad", "progress"]
    rows = []
    for renderer in ("clean", "3dgs"):
        values = rng.random((scenes, seeds, 3))
        values[..., 1] = values[..., 1] < 0.1
        for i in range(scenes):
            for k in range(seeds):
                row = {"renderer": renderer, "policy": "p", "scene": f"s{i:04d}", "seed": k, "status": "ok"}
                for name, v in zip(names, values[i, k].tolist(), strict=True):
                    row[name], row[f"{name}_valid"] = v, True
                rows.append(row)
    began = time.process_time()
    found = paired(rows, "clean")
    assert time.process_time() - began < 3.0  # about 0.3 s for 20,000 rollouts
    assert found["3dgs"]["offroad"]["n_scenes"] == scenes
