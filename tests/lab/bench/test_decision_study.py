"""The study of sequential decisions on a small grid; the whole is in
docs/experiments/verdict-error.md.
"""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from scipy.special import stdtrit

from alpasim_plugin.lab.bench.decision_study import (
    GAP,
    NEVER,
    Case,
    Way,
    ends,
    family_ends,
    fixed_scenes,
    overall,
    rate_pairs,
    seed_costs,
    suite_ends,
)
from alpasim_plugin.lab.bench.interval_study import RATES


def test_the_fixed_design_has_the_power_and_error_that_it_is_planned_for():
    generator = np.random.Generator(np.random.Philox(1))
    for tail in (0.025, 0.05):
        n = fixed_scenes(0.3, 1.0, 0.9, tail)
        t = generator.normal(0.3, 1.0, (4000, n))
        t = t.mean(axis=1) / t.std(axis=1, ddof=1) * np.sqrt(n)
        assert np.mean(t > stdtrit(n - 1, 1 - tail)) == pytest.approx(0.9, abs=0.015)


def test_rates_on_the_threshold_are_rarely_judged_and_rates_as_planned_mostly():
    on_edge = ends(Case("edge", rate_pairs(*RATES, 0.3, 1), GAP, GAP), 200, 400)
    assert (
        max((on_edge.good < NEVER).mean(), (on_edge.bad < NEVER).mean()) <= 0.08
    )  # three standard errors above 5 %
    planned = ends(Case("planned", rate_pairs(RATES[1], RATES[1], 0.3, 1), GAP, GAP), 200, 700)
    assert planned.share(planned.good, 700) > 0.8
    assert planned.mean_scenes(700) < 450


def test_a_suite_is_decided_sooner_than_its_population_and_a_control_helps():
    population, suite, known = (
        suite_ends(40, 100, share, on_threshold=False).mean_scenes(100)
        for share in (None, 0.0, 0.7)
    )
    assert known < suite < population


@pytest.mark.parametrize("sizes", [(12,) * 5, (20, 15, 12, 10, 3)])
def test_where_families_differ_the_stratified_order_saves_more_than_the_control(sizes):
    random, control, stratified = (
        family_ends(40, sizes, 0.6, way, on_threshold=False).mean_scenes(60)
        for way in get_args(Way)
    )
    assert stratified < 0.95 * control < 0.95 * random


@pytest.mark.parametrize("bounded", [False, True])
def test_the_stratified_order_rarely_errs_on_the_threshold(bounded):
    on_edge = family_ends(100, (20, 15, 12, 10, 3), 0.3, "stratified", True, bounded)
    assert (
        max((on_edge.good < 60).mean(), (on_edge.bad < 60).mean()) <= 0.11
    )  # three standard errors above 5 %


@pytest.mark.slow
def test_several_metrics_keep_the_error_and_chosen_seeds_cost_little_more_than_the_best():
    assert overall(100, 3, 0.5, "all on the threshold", 100)[1] <= 0.12
    chosen, one, five = (seed_costs(8, 4.0, 8.0, rule)[0] for rule in (0, 1, 5))
    assert chosen < one
    assert chosen < 1.3 * five
