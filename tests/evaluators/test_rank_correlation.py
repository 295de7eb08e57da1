"""Rank correlation by groups on worlds whose answer is known: none, perfect, ties, few groups."""

import math

import numpy as np
import pytest
import scipy.stats

from evaluators.statistics.rank_correlation import (
    LEAST_GROUPS,
    group_difference,
    group_spearman,
    spearman,
)


def grouped_world(rng, n_groups, n_units, correlation):
    """Return two heavy-tailed values of each unit, half of whose variance is their group's, and the
    groups.
    """

    def pair(shape):
        first = rng.normal(size=shape)
        noise = rng.normal(size=shape)
        return first, correlation * first + math.sqrt(1 - correlation**2) * noise

    group_x, group_y = pair((n_groups, 1))
    unit_x, unit_y = pair((n_groups, n_units))
    scale = math.sqrt(0.5)
    x = np.exp(2 * scale * (group_x + unit_x)).ravel()
    y = np.exp(2 * scale * (group_y + unit_y)).ravel()
    return x, y, [f"g{number}" for number in np.repeat(np.arange(n_groups), n_units)]


def true_spearman(correlation):
    """Return Spearman's coefficient of two normal values (Kruskal 1958)."""
    return 6 / math.pi * math.asin(correlation / 2)


@pytest.mark.parametrize("n_levels", [2, 3, 50])
def test_ties_share_the_mean_of_their_ranks_as_in_scipy(n_levels):
    rng = np.random.default_rng(n_levels)
    x = rng.integers(0, n_levels, 40).astype(float)
    y = x + rng.integers(0, n_levels, 40)
    assert spearman(x, y) == pytest.approx(scipy.stats.spearmanr(x, y).statistic, abs=1e-9)


def test_an_order_is_all_that_counts():
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 30))
    assert spearman(np.exp(x), y**3) == spearman(x, y)
    assert spearman(x, -y) == -spearman(x, y)


def test_values_that_are_all_equal_have_no_coefficient():
    x = np.arange(12.0)
    groups = [f"g{number // 2}" for number in range(12)]
    assert spearman(np.ones(12), x) is None
    assert group_spearman(x, np.zeros(12), groups) is None
    assert group_difference(x, np.ones(12), x, groups) is None
    assert spearman(x[:1], x[:1]) is None


def test_a_perfect_order_has_no_interval_and_says_so():
    x = np.arange(20.0)
    groups = [f"g{number // 2}" for number in range(20)]
    interval = group_spearman(x, x**3, groups)
    assert interval.centre == 1.0
    assert interval.bounds is None
    assert "perfect" in interval.reason
    assert group_spearman(x, -x, groups).centre == -1.0


def test_a_nearly_perfect_order_has_an_interval_below_one():
    x = np.arange(20.0)
    y = x.copy()
    y[[3, 4, 10, 11]] = y[[4, 3, 11, 10]]
    interval = group_spearman(x, y, [f"g{number // 2}" for number in range(20)])
    assert 0.97 < interval.low < interval.centre < interval.high < 1.0


def test_one_group_that_alone_differs_has_no_interval():
    x = np.arange(14.0)
    y = np.zeros(14)
    y[12:] = 1.0, 2.0
    interval = group_spearman(x, y, [f"g{number // 2}" for number in range(14)])
    assert interval.bounds is None
    assert "one group" in interval.reason


def test_few_groups_have_no_interval_however_many_units_they_have():
    rng = np.random.default_rng(0)
    x, y, groups = grouped_world(rng, LEAST_GROUPS - 1, 50, 0.5)
    interval = group_spearman(x, y, groups)
    assert interval.bounds is None
    assert "at least 6 groups, found 5" in interval.reason
    x, y, groups = grouped_world(rng, LEAST_GROUPS, 50, 0.5)
    assert group_spearman(x, y, groups).bounds is not None


def test_units_that_are_repeated_within_their_groups_say_no_more():
    rng = np.random.default_rng(1)
    x, y, groups = grouped_world(rng, 10, 2, 0.4)
    once = group_spearman(x, y, groups)
    repeated = group_spearman(np.tile(x, 25), np.tile(y, 25), groups * 25)
    assert repeated.bounds == pytest.approx(once.bounds, abs=1e-9)


def test_neither_the_order_of_units_nor_the_names_of_groups_matter():
    rng = np.random.default_rng(2)
    x, y, groups = grouped_world(rng, 8, 3, 0.4)
    order = rng.permutation(len(x))
    renamed = [f"z{99 - int(groups[number][1:])}" for number in order]
    before = group_spearman(x, y, groups)
    after = group_spearman(x[order], y[order], renamed)
    assert after.bounds == pytest.approx(before.bounds, abs=1e-9)
    assert after.centre == before.centre


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_nine_of_ten_intervals_hold_the_true_coefficient(correlation):
    rng = np.random.default_rng(int(10 * correlation))
    holds = []
    for _ in range(60):
        x, y, groups = grouped_world(rng, 8, 3, correlation)
        low, high = group_spearman(x, y, groups).bounds
        holds.append(low <= true_spearman(correlation) <= high)
    assert np.mean(holds) >= 0.88


def test_a_difference_is_seen_where_there_is_one_and_covers_zero_where_there_is_none():
    rng = np.random.default_rng(5)
    x, y, groups = grouped_world(rng, 30, 3, 0.9)
    noise = rng.normal(size=len(x))
    assert group_difference(x, noise, y, groups).low > 0.3
    assert group_difference(noise, x, y, groups).high < -0.3
    same = group_difference(x, x, y, groups)
    assert (same.centre, same.low, same.high) == (0.0, 0.0, 0.0)
    intervals = [group_difference(*rng.normal(size=(2, len(x))), y, groups) for _ in range(40)]
    assert np.mean([interval.low <= 0.0 <= interval.high for interval in intervals]) >= 0.85


@pytest.mark.parametrize(("changed", "is_bounded"), [(2, False), (5, False), (6, True)])
def test_two_values_have_an_interval_where_six_groups_hold_the_rarer(changed, is_bounded):
    rng = np.random.default_rng(changed)
    x = rng.normal(size=60)
    groups = [f"g{number // 3}" for number in range(60)]
    y = np.repeat(np.arange(20) < changed, 3).astype(float)
    for interval in (group_spearman(x, y, groups), group_difference(x, -x, y, groups)):
        assert (interval.low is not None) == is_bounded
        assert is_bounded or f"stands in {changed} groups" in interval.reason


def test_a_difference_needs_enough_of_the_rarer_value_on_every_side_and_no_two_perfect_orders():
    rng = np.random.default_rng(9)
    y = rng.normal(size=24)
    groups = [f"g{number // 3}" for number in range(24)]
    rare = np.repeat(np.arange(8) < 2, 3).astype(float)
    assert group_difference(rare, rng.normal(size=24), y, groups).low is None
    assert group_difference(rng.normal(size=24), rare, y, groups).low is None
    assert group_difference(y, 2 * y, y, groups).low is None
