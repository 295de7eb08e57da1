"""Bounds of a mean that hold for what was not drawn: against Clopper and Pearson, drawn weights,
large values, many scenes.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evaluators.statistics.bounded import (
    BINS,
    chance_above,
    mean_bounds,
    upper_bound,
)
from evaluators.statistics.verdicts import scenes_without_event
from tests.examples import examples


@pytest.mark.parametrize(
    ("k", "n"), [(0, 2), (1, 2), (2, 5), (0, 20), (3, 20), (9, 10), (40, 300), (100, 2000)]
)
def test_of_zeros_and_ones_it_is_the_bound_of_clopper_and_pearson(k, n):
    values = np.repeat([1.0, 0.0], [k, n - k])
    assert upper_bound(values, 1.0) == pytest.approx(stats.beta.ppf(0.975, k + 1, n - k), abs=1e-6)


def by_drawing(values, most):
    """Return the bound by its definition: the quantile of the weighted mean with uniform weights on
    the simplex.
    """
    weights = np.random.Generator(np.random.Philox(4)).exponential(size=(200_000, len(values) + 1))
    means = weights @ np.append(values, most) / weights.sum(axis=1)
    return float(np.quantile(means, 0.975))


@pytest.mark.parametrize("n", [3, 12, 60])
@pytest.mark.parametrize("spread", [0.02, 0.5])
def test_of_any_values_it_is_the_quantile_of_drawn_weighted_means(n, spread):
    values = np.random.Generator(np.random.Philox(n)).normal(0.1, spread, n)
    assert upper_bound(values, 4.0) == pytest.approx(by_drawing(values, 4.0), rel=0.02, abs=0.01)


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=30), st.floats(-1.0, 1.0))
@settings(max_examples=examples(100), deadline=None)
def test_bounds_hold_the_mean_and_turn_with_the_sign_and_grow_with_the_worst_value(values, moved):
    x = np.array(values)
    low, high = mean_bounds(x, -1.0, 1.0)
    assert -1.0 <= low <= x.mean() + 1e-9
    assert x.mean() - 1e-9 <= high <= 1.0
    assert mean_bounds(-x, -1.0, 1.0) == pytest.approx((-high, -low), abs=1e-7)
    assert upper_bound(x, 2.0) >= high - 1e-7
    assert upper_bound(np.maximum(x, moved), 1.0) >= high - 1e-7, (
        "no value that is larger lowers the bound"
    )


def test_the_chance_agrees_with_the_bound():
    rows = np.random.Generator(np.random.Philox(6)).uniform(-1.0, 0.5, (5, 40))
    for row in rows:
        values = np.sort(np.append(row, 1.0))
        counts = np.ones(41)
        chance = chance_above(values, counts, upper_bound(row, 1.0))
        assert chance == pytest.approx(0.025, abs=1e-6)
        assert chance_above(values, counts, -1.0) == 1.0
        assert chance_above(values, counts, 1.0) == 0.0


@pytest.mark.slow
def test_many_different_values_in_bins_give_almost_the_same_bound_and_none_that_is_lower():
    x = np.random.Generator(np.random.Philox(7)).normal(0.0, 0.1, 4 * BINS)
    whole = np.concatenate([x[: BINS - 2], np.full(3 * BINS + 2, 0.0)])
    assert upper_bound(whole, 4.0) == pytest.approx(by_drawing(whole[: len(whole)], 4.0), rel=0.03)
    t = stats.t.interval(0.95, len(x) - 1, x.mean(), stats.sem(x))[1]
    assert t < upper_bound(x, 0.4) < t + 0.01


@pytest.mark.parametrize("scale", [1e-300, 1e-9, 1.0, 1e150, 1e307])
def test_the_unit_does_not_matter_up_to_the_ends_of_the_numbers(scale):
    values = np.array([-1.0, 0.0, 0.25, 0.25, 0.5])
    assert upper_bound(values * scale, 4.0 * scale) == pytest.approx(
        scale * upper_bound(values, 4.0), rel=1e-6
    )


def test_the_fewest_scenes_are_those_at_which_the_bound_reaches_the_margin():
    for distance, reach in ((0.05, 1.0), (0.02, 1.0), (0.1, 4.0)):
        n = scenes_without_event(distance, reach)
        assert upper_bound(np.zeros(n), reach) < distance <= upper_bound(np.zeros(n - 1), reach)
    assert scenes_without_event(2.0, 1.0) == 2
