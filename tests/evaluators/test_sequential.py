"""Sequential decisions: e-processes under the null by exact enumeration, against plain loops on
hard cases.
"""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluators.statistics import betting
from evaluators.statistics.betting import (
    Draws,
    Plan,
    relative_slope,
)
from evaluators.statistics.decision import closed

PLAN = Plan(0.1, 50, 0.05)


def rng(key):
    return np.random.Generator(np.random.Philox(key))


def capital(draws, mean, plan=PLAN):
    return np.exp(betting.log_capital(draws, mean, betting.bet_sizes(draws, mean, plan)))


def log_chance(gap, left, slope):
    """Siegmund (1985), equation 3.15, as it stands."""
    normal = [
        0.5 * math.erfc(-at / math.sqrt(2 * left))
        for at in (-gap - slope * left, slope * left - gap)
    ]
    return math.log(normal[0] + math.exp(-2 * slope * gap) * normal[1])


# --- the line


def first(draws, n):
    return Draws(draws.x[..., :n], draws.reach)


@pytest.mark.parametrize("slope", [0.0, 0.33, 1.4, 4.05, 9.7, 25.0])
@pytest.mark.parametrize("gap", [1e-3, 0.2, 1.0, 2.0, 5.0, 9.0])
def test_the_chance_is_that_of_the_formula_and_bets_follow_its_derivative(gap, slope):
    h = 1e-5
    below, log_p, above = (log_chance(at, 1.0, slope) for at in (gap - h, gap, gap + h))
    assert float(betting.log_chance(np.array(gap), np.array(slope))) == pytest.approx(
        log_p, rel=1e-9, abs=1e-9
    )
    derivative = float(relative_slope(np.array(log_p), np.array(slope)))
    assert derivative == pytest.approx((below - above) / (2 * h), rel=1e-4)


@pytest.mark.parametrize("slope", [0.0, 1.4, 9.7])
def test_far_from_the_line_and_past_it_the_derivative_stays_finite(slope):
    assert float(relative_slope(np.array(0.0), np.array(slope))) == 2.0 * slope  # Wald's test
    assert np.isfinite(relative_slope(np.array([-1e-12, -60.0, -2000.0]), np.full(3, slope))).all()


# --- betting

LAWS = {
    "a coin": ((0.0, 1.0), (0.7, 0.3)),
    "rarely worse": ((-1.0, 0.0, 1.0), (0.05, 0.85, 0.10)),
    "all or nothing": ((-1.0, 1.0), (0.5, 0.5)),
    "one sided": ((-0.02, 1.0), (0.95, 0.05)),
}


@pytest.mark.parametrize("law", LAWS)
def test_the_capital_is_a_martingale_where_the_mean_is_the_hypothesis_by_enumeration(law):
    """Every course of seven scenes, with its probability: no sampling."""
    values, chances = (np.array(column) for column in LAWS[law])
    n = 7
    mean = float(values @ chances)
    courses = np.array(list(itertools.product(range(len(values)), repeat=n)))
    chance = np.prod(chances[courses], axis=1)
    found = capital(Draws(values[courses], 1.0), mean)
    assert np.sum(chance[:, None] * found, axis=0) == pytest.approx(np.ones(n), abs=1e-12)
    # given any beginning, too: the mean over what can come next is the capital now
    for t in range(1, n):
        groups = courses[:, :t] @ (len(values) ** np.arange(t))
        for group in np.unique(groups):
            here = groups == group
            following = np.sum(chance[here] * found[here, t]) / chance[here].sum()
            assert following == pytest.approx(found[here, t - 1][0], rel=1e-12)
    for alpha in (0.05, 0.2, 0.5):  # Ville's inequality
        assert chance[found.max(axis=1) >= 1 / alpha].sum() <= alpha


def test_below_the_hypothesis_the_capital_only_shrinks_on_average():
    values = np.array([-1.0, 0.0, 1.0])
    chances = np.array([0.15, 0.8, 0.05])
    courses = np.array(list(itertools.product(range(3), repeat=6)))
    found = capital(Draws(values[courses], 1.0), 0.1)
    means = np.sum(np.prod(chances[courses], axis=1)[:, None] * found, axis=0)
    assert np.all(np.diff(means, prepend=1.0) < 0)


@given(st.lists(st.sampled_from([-1.0, -0.2, 0.0, 0.0, 0.4, 1.0]), min_size=1, max_size=25))
def test_the_capital_falls_with_the_hypothesis_and_bounds_are_nested(values):
    draws = Draws(np.array(values), 1.0)
    sizes = betting.bet_sizes(draws, 0.05, PLAN)
    ladder = np.stack(
        [betting.log_capital(draws, mean, sizes) for mean in np.linspace(-1.0, 1.0, 41)]
    )
    assert np.all(np.diff(ladder, axis=0) <= 1e-9)
    lows = [
        float(betting.lower_bound(first(draws, n), sizes[:n], PLAN.log_bar))
        for n in range(1, draws.n + 1)
    ]
    assert np.all(np.diff(lows) >= -1e-9)
    if lows[-1] > -1.0:
        assert betting.log_capital(draws, lows[-1], sizes).max() >= PLAN.log_bar
        assert betting.log_capital(draws, lows[-1] + 1e-6, sizes).max() < PLAN.log_bar


# --- several metrics


@given(st.lists(st.sampled_from([0.0, 0.3, 1.0, 1.0, 5.0, 60.0, 1e4]), min_size=1, max_size=6))
def test_closed_testing_by_sorting_is_that_over_all_sets(e):
    with np.errstate(divide="ignore"):
        found = np.exp(closed(np.log(np.array(e))))
    # The reference goes through every set of metrics.
    sets = [s for size in range(1, len(e) + 1) for s in itertools.combinations(range(len(e)), size)]
    least = [min(float(np.mean([e[k] for k in s])) for s in sets if i in s) for i in range(len(e))]
    assert found == pytest.approx(least, rel=1e-12)
    assert np.all(found >= np.array(e) / len(e) - 1e-12)  # never less than Bonferroni
