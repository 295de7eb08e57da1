"""Coverage and power by simulation: 95 % intervals must hold the truth in 93 to 97 % of runs.

The full grid is in docs/experiments/verdict-error.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.coverage import write_into
from alpasim_plugin.lab.bench.interval_study import (
    CORRELATIONS,
    RATES,
    Design,
    bootstrap_coverage,
    coverage_of,
    flags,
    paired_coverage,
    pairs,
    power_of,
)
from evaluators.statistics.verdicts import more_scenes, scenes_needed, scenes_without_event

REPEATS = 4000  # standard error of a coverage of 95 %: 0.35 points


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("correlation", CORRELATIONS)
def test_the_clustered_interval_covers_93_to_97_percent_and_the_papers_does_not(rate, correlation):
    paper, wilson, t_on_scenes, ours = coverage_of(
        Design(rate=rate, correlation=correlation), REPEATS
    )
    assert 0.93 <= ours <= 0.97
    if correlation >= 0.3:
        assert paper < 0.91
        assert wilson < 0.92
    if correlation == 0.8:
        assert paper < 0.77
        assert t_on_scenes < min(0.935, ours)  # why rates take the logit scale


@pytest.mark.parametrize("n_scenes", [20, 150])
def test_fewer_and_more_scenes_than_the_papers_are_covered_too(n_scenes):
    for rate in (0.5, 0.106):
        for correlation in (0.0, 0.6):
            assert (
                0.92 <= coverage_of(Design(n_scenes, 5, rate, correlation), REPEATS // 2)[3] <= 0.98
            )


@pytest.mark.parametrize("n_scenes", [5, 10])
def test_with_few_scenes_and_rare_events_the_interval_errs_on_the_wide_side(n_scenes):
    for rate in (0.069, 0.02):
        assert coverage_of(Design(n_scenes, 5, rate, 0.6), REPEATS)[3] >= 0.95


def test_the_bootstrap_is_too_short_at_the_papers_size():
    assert bootstrap_coverage(Design(rate=RATES[1], correlation=0.8), 500) < 0.94


def test_differences_of_rates_are_covered():
    for correlation in (0.0, 0.6):
        assert (
            0.93 <= paired_coverage(Design(60, 5, RATES[0], correlation), RATES[1], REPEATS) <= 0.97
        )
    assert (
        paired_coverage(Design(10, 5, RATES[0], 0.6), RATES[1], 1000) >= 0.95
    )  # fewer than six changed scenes: wide, not short


def test_shared_random_numbers_multiply_the_power():
    unpaired, by_scene, shared = power_of(Design(rate=RATES[0], correlation=0.6), RATES[1], 1500)
    assert unpaired < 0.15
    assert 0.3 < by_scene < 0.42
    assert 0.45 < shared < 0.6


def test_the_model_has_the_rate_and_the_correlation_it_claims():
    generator = np.random.Generator(np.random.Philox(5))
    values = flags(Design(200, 2, 0.3, 0.6), 200, generator)
    assert values.mean() == pytest.approx(0.3, abs=0.01)
    same, other = pairs(Design(50, 5, 0.3, 1.0), 0.3, 1.0, 40, generator)
    assert np.ptp(same, axis=2).max() == 0.0  # a correlation of 1: the seeds of a scene are copies
    assert abs(same - other).mean() < 0.2


# --- planning


def test_the_planned_number_of_scenes_decides_in_four_of_five_runs():
    for distance, spread in ((0.5, 1.0), (1.0, 0.6), (0.1, 0.7)):
        n = scenes_needed(distance, spread)
        generator = np.random.Generator(np.random.Philox(7))
        values = generator.normal(distance, spread, (4000, n))
        error = values.std(axis=1, ddof=1) / np.sqrt(n)
        decided = np.mean(values.mean(axis=1) - stats.t.ppf(0.975, n - 1) * error > 0)
        assert 0.78 <= decided <= 0.88, (distance, n, decided)


def test_more_scenes_counts_from_what_there_is():
    total = scenes_needed(0.3, 1.0)
    assert more_scenes(0.4, 1.0, 20, 0.1, None) == total - 20
    assert (
        more_scenes(-0.2, 1.0, 20, 0.1, None) == total - 20
    )  # the same way to the margin, from the other side
    assert more_scenes(0.4, 1.0, total + 5, 0.1, None) == 1
    assert more_scenes(0.1, 1.0, 20, 0.1, None) is None  # on the margin
    assert more_scenes(0.0, 0.01, 20, 0.1, 4.0) == 126, (
        "as many as show that no scene went wrong by 4 m"
    )


def test_without_any_event_the_exact_bound_says_how_many_scenes_are_needed():
    assert scenes_without_event(0.05) == 72
    assert scenes_without_event(1e-300) is None  # more scenes than a float can count
    assert 1 - 0.025 ** (1 / 72) < 0.05 < 1 - 0.025 ** (1 / 71)
    assert more_scenes(0.0, 0.0, 20, 0.05, 1.0) == 52
    assert more_scenes(0.0, 0.0, 20, 0.0, 1.0) is None


def test_tables_go_between_their_markers_only(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- begin power -->\nold\n<!-- end power -->\nafter\n")
    write_into(page, {"power": "| new |\n"})
    assert page.read_text() == "before\n<!-- begin power -->\n| new |\n<!-- end power -->\nafter\n"
    with pytest.raises(InputError, match="no markers for 'coverage'"):
        write_into(page, {"coverage": ""})
