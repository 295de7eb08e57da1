"""The verdict with the truth on the margin: wrong in 2.5 % of runs at most, which the interval of what was seen is not."""

from __future__ import annotations

import numpy as np
import pytest

from alpasim_plugin.lab.bench.verdict_study import Family, adverse_families, harmless_families, jumps, long_tail, shares, table

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
    found = {n: shares(FAMILIES["metres: 2.5 % of scenes by 4 m"], n, RUNS)["spread"] for n in (20, 40, 60)}
    assert found[20] > 0.5
    assert found[40] > 0.3
    assert found[60] > 0.15


def test_the_families_stand_on_their_margins() -> None:
    for family in adverse_families():
        harm = family.draw(np.random.Generator(np.random.Philox(2)), 40, 2000)
        assert harm.mean() == pytest.approx(family.margin, rel=0.1), family.name
        assert np.abs(harm).max() <= family.reach + 0.5  # noise beside the jumps is cut
    assert long_tail(0.1, 2.0, 4.0)(np.random.Generator(np.random.Philox(3)), 2, 50).shape == (2, 50, 1)


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
