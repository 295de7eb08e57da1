"""The verdict with the truth on the margin: wrong in 2.5 % of runs at most, which the interval of
what was seen is not.
"""

from __future__ import annotations

import numpy as np
import pytest

from alpasim_plugin.lab.bench.verdict_study import (
    VALID,
    WORSE,
    Family,
    adverse_families,
    families_against_worse,
    guarded,
    harmful_families,
    harmless_families,
    jumps,
    long_tail,
    needed_table,
    random_family,
    scenes_to_decide,
    shares,
    table,
    worst_found,
)
from evaluators.metrics import METRICS
from evaluators.statistics.paired import paired
from tests.evaluators.test_tables_over_rollouts import rows_of

RUNS = 400
MOST = 0.025 + 3 * (0.025 * 0.975 / RUNS) ** 0.5  # three standard errors of the simulation
FAMILIES = {family.name: family for family in adverse_families()}


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("scenes", [20, pytest.param(100, marks=pytest.mark.slow), 200])
def test_non_inferior_is_wrong_in_one_run_of_forty_at_most(name: str, scenes: int) -> None:
    found = shares(FAMILIES[name], scenes, RUNS)
    assert found["guarded"] <= MOST
    assert found["betting"] <= MOST


def test_the_interval_of_what_was_seen_is_wrong_far_more_often() -> None:
    found = {
        n: shares(FAMILIES["metres: 2.5 % of scenes by 4 m"], n, RUNS)["spread"]
        for n in (20, 40, 60)
    }
    assert found[20] > 0.5
    assert found[40] > 0.3
    assert found[60] > 0.15


def test_the_families_stand_on_their_margins() -> None:
    for family in adverse_families():
        harm = family.draw(np.random.Generator(np.random.Philox(2)), 40, 2000)
        assert harm.mean() == pytest.approx(family.margin, rel=0.1), family.name
        assert np.abs(harm).max() <= family.reach + 0.5  # noise beside the jumps is cut
    assert long_tail(0.1, 2.0, 4.0)(np.random.Generator(np.random.Philox(3)), 2, 50).shape == (
        2,
        50,
        1,
    )


def test_it_decides_as_soon_as_any_valid_test_can() -> None:
    never = Family("no event", jumps(0.0), 0.05)
    assert [shares(never, n, 20)["guarded"] for n in (71, 72)] == [0.0, 1.0]
    noisy = harmless_families()[1]
    found = shares(noisy, 120, 200)
    assert found["guarded"] >= found["betting"] - 0.05


def test_the_table_has_a_row_for_each_family() -> None:
    text = table(harmless_families()[:2], (20, 40), 20)
    assert text.startswith("| family | 20 scenes | 40 scenes |\n")
    assert text.count("\n") == 4


BENEFITS = {family.name: family for family in families_against_worse()}


@pytest.mark.parametrize("name", BENEFITS)
@pytest.mark.parametrize("scenes", [20, pytest.param(100, marks=pytest.mark.slow), 200])
def test_worse_by_the_guarded_bound_is_wrong_in_one_run_of_forty_at_most(
    name: str, scenes: int
) -> None:
    found = shares(BENEFITS[name], scenes, RUNS, WORSE)
    assert max(found["guarded"], found["betting"]) <= MOST


def test_no_valid_method_says_worse_with_many_fewer_scenes_than_the_guarded_bound() -> None:
    for family in harmful_families():
        found = {name: scenes_to_decide(family, method, 60) for name, method in VALID.items()}
        assert found["guarded"] is not None
        assert found["guarded"] <= 1.2 * min(n for n in found.values() if n is not None), (
            family.name
        )


def test_worse_in_metres_by_what_was_seen_is_a_false_alarm_where_few_scenes_are_far_better() -> (
    None
):
    assert (
        shares(BENEFITS["metres: 2.5 % of scenes better by 4 m"], 20, RUNS, WORSE)["spread"] > 0.5
    )


def test_the_families_against_worse_stand_on_their_margins() -> None:
    for family in BENEFITS.values():
        harm = family.draw(np.random.Generator(np.random.Philox(2)), 40, 2000)
        assert harm.mean() == pytest.approx(family.margin, rel=0.15), family.name


@pytest.mark.parametrize("margin", [0.05, -0.05])
def test_random_distributions_stand_on_the_margin_and_none_is_wrong_too_often(
    margin: float,
) -> None:
    generator = np.random.Generator(np.random.Philox(5))
    for _ in range(20):
        family = random_family(generator, margin, 1.0)
        harm = family.draw(generator, 50, 2000)
        assert harm.mean() == pytest.approx(margin, abs=5 * harm.std() / np.sqrt(harm.size))
        assert np.abs(harm).max() <= 1.0
    assert worst_found(20, margin, 1.0, 20, 1600) <= 0.025 + 4 * (0.025 * 0.975 / 1600) ** 0.5


def test_no_valid_method_needs_many_fewer_scenes_than_the_guarded_bound() -> None:
    for family in harmless_families():
        found = {name: scenes_to_decide(family, method, 100) for name, method in VALID.items()}
        assert found["guarded"] is not None
        assert found["guarded"] <= 1.2 * min(n for n in found.values() if n is not None), (
            family.name
        )
    assert (
        needed_table(harmless_families()[:1], 40)
        .splitlines()[-1]
        .startswith("| rates, margin 5 points: no event | 72 | ")
    )


@pytest.mark.parametrize(
    ("name", "metric"),
    [
        ("rates, margin 5 points: both sides, single seeds", "offroad"),
        ("metres: 5 % better by 2 m", "lateral_distance_m"),
    ],
)
def test_a_verdict_is_what_the_study_says_of_the_same_draws(name: str, metric: str) -> None:
    family = BENEFITS[name]
    harm = (
        0.2 + family.draw(np.random.Generator(np.random.Philox(8)), 60, 40)
        if metric != "offroad"
        else family.draw(np.random.Generator(np.random.Philox(8)), 60, 40)
    )
    for one in harm:
        base = np.where(one < 0, 1.0, 0.0) if METRICS[metric].is_flag else np.full(one.shape, 10.0)
        rows = rows_of(base.tolist(), metric, "clean") + rows_of(
            (base + one).tolist(), metric, "3dgs"
        )
        entry = paired(rows, "clean", margins={metric: family.margin})["3dgs"][metric]
        says = {word: bool(method(one[None], family)[0]) for word, method in WORSE.items()}
        assert (entry["verdict"] == "worse") == (says["spread"] and says["guarded"])
        assert not says["spread"] or says["guarded"] or "better by up to" in entry["note"]
        assert (entry["verdict"] != "non-inferior") or bool(guarded(one[None], family)[0])
