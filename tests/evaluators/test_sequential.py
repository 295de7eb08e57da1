"""Sequential decisions: e-processes under the null by exact enumeration, against plain loops on
hard cases.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize

from alpasim_plugin.core.errors import InputError
from evaluators.statistics.sequential import asymptotic, betting, line
from evaluators.statistics.sequential.control import (
    RIDGE,
    Control,
    adjusted_draws,
    of_families,
    of_rows,
    predictions,
)
from evaluators.statistics.sequential.decision import closed
from evaluators.statistics.sequential.draws import Draws, independent, without_replacement
from evaluators.statistics.sequential.line import LEAST_SLOPE, USUAL_SLOPE, Plan, relative_slope
from evaluators.statistics.sequential.question import metric_question

PLAN = Plan(0.1, 50, 0.05)


def rng(key: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key))


def capital(draws: Draws, mean: float, plan: Plan = PLAN) -> np.ndarray:
    return np.exp(betting.log_capital(draws, mean, betting.bet_sizes(draws, mean, plan)))


def log_chance(gap: float, left: float, slope: float) -> float:
    """Siegmund (1985), equation 3.15, as it stands."""
    normal = [
        0.5 * math.erfc(-at / math.sqrt(2 * left))
        for at in (-gap - slope * left, slope * left - gap)
    ]
    return math.log(normal[0] + math.exp(-2 * slope * gap) * normal[1])


def plain_log_capital(
    x: Sequence[float], low: float, high: float, mean: float, plan: Plan
) -> list[float]:
    """Bet scene by scene, as the modules' texts say."""
    half = (high - low) / 2
    imagined = betting.PRIOR_SCENES * (2 * betting.PRIOR_WIDTH * half) ** 2
    squares = imagined
    fourths = imagined * half**2
    capital = 0.0
    out = []
    for i, value in enumerate(x):
        spread = math.sqrt(squares / (betting.PRIOR_SCENES + i))
        left = max(plan.horizon - i, 1) / plan.horizon
        slope = (
            USUAL_SLOPE
            if plan.distance is None
            else max(LEAST_SLOPE, plan.distance * math.sqrt(plan.horizon) / spread / 2)
        )
        relative = float(
            relative_slope(np.array(capital - plan.log_bar), np.array(slope * math.sqrt(left)))
        )
        wanted = relative / (spread * math.sqrt(left * plan.horizon))
        tail = fourths / squares
        bet = float(
            np.roots([tail, 0.0, 1.0, -wanted])[
                np.argmin(np.abs(np.roots([tail, 0.0, 1.0, -wanted]).imag))
            ].real
        )
        capital += math.log1p(min(bet, betting.AT_RISK / (mean - low)) * (value - mean))
        squares, fourths = squares + (value - mean) ** 2, fourths + (value - mean) ** 4
        out.append(capital)
    return out


# --- the line


@pytest.mark.parametrize(
    ("gap", "left", "slope"),
    [(1.0, 1.0, 0.0), (0.01, 0.5, 1.4), (9.0, 1.0, 0.5), (0.3, 0.002, 1.0), (2.0, 1.0, 9.0)],
)
def test_the_chance_of_reaching_a_line_is_that_of_the_formula(gap, left, slope):
    assert float(line.log_chance(np.array(gap), np.array(left), np.array(slope))) == pytest.approx(
        log_chance(gap, left, slope), rel=1e-9
    )


def test_the_chance_is_a_martingale_of_brownian_motion_and_begins_at_alpha():
    """Over a step of 0.3, by integrating the density of a motion that does not reach the line on
    the way.
    """
    slope = 1.2
    gap = 0.8
    step = 0.3
    assert float(
        np.exp(line.log_chance(line.height(np.array(slope), 0.05), np.array(1.0), np.array(slope)))
    ) == pytest.approx(0.05)
    assert line.log_evidence(
        np.array([-0.2, 3.0, 0.0]), np.array([0.1, 0.2, 0.3]), np.array([1.2]), 0.05
    )[1] > -math.log(0.05)
    w = np.linspace(-8.0, gap + slope * step, 200_001)
    # the density at w of a motion that stays below the line (Siegmund 1985, equation 3.14)
    stays = 1.0 - np.exp(-2.0 * gap * (gap + slope * step - w) / step)
    density = stays * np.exp(-(w**2) / (2 * step)) / math.sqrt(2 * math.pi * step)
    later = np.exp(line.log_chance(gap + slope * step - w, np.full_like(w, 0.7), np.array(slope)))
    reached = 1.0 - np.trapezoid(density, w)
    now = float(np.exp(line.log_chance(np.array(gap), np.array(1.0), np.array(slope))))
    assert reached + np.trapezoid(density * later, w) == pytest.approx(now, rel=1e-6)


@pytest.mark.parametrize("slope", [0.0, 0.33, 1.4, 4.05, 9.7, 25.0])
def test_the_table_of_bets_is_the_derivative_of_the_chance(slope):
    for gap in (1e-3, 0.2, 1.0, 2.0, 5.0):
        log_p = log_chance(gap, 1.0, slope)
        if log_p < -40.0:
            continue
        h = 1e-5
        exact = (log_chance(gap - h, 1.0, slope) - log_chance(gap + h, 1.0, slope)) / (2 * h)
        assert float(relative_slope(np.array(log_p), np.array(slope))) == pytest.approx(
            exact, rel=3e-3
        )
    assert (
        float(relative_slope(np.array(0.0), np.array(slope))) == 2.0 * slope
    )  # past the line, Wald's test


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
    n, mean = 7, float(values @ chances)
    courses = np.array(list(itertools.product(range(len(values)), repeat=n)))
    chance = np.prod(chances[courses], axis=1)
    found = capital(independent(values[courses], -1.0, 1.0), mean)
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
    values, chances = np.array([-1.0, 0.0, 1.0]), np.array([0.15, 0.8, 0.05])
    courses = np.array(list(itertools.product(range(3), repeat=6)))
    found = capital(independent(values[courses], -1.0, 1.0), 0.1)
    means = np.sum(np.prod(chances[courses], axis=1)[:, None] * found, axis=0)
    assert np.all(np.diff(means, prepend=1.0) < 0)


SUITE = np.array([0.0, 1.0, 0.0, -0.5, 0.25, 0.1, 0.9])


def test_without_replacement_the_capital_is_a_martingale_over_all_orders_of_a_suite():
    orders = np.array(list(itertools.permutations(range(7))))
    found = capital(without_replacement(SUITE[orders], -1.0, 1.0, 7), float(SUITE.mean()))
    assert found[:, :6].mean(axis=0) == pytest.approx(np.ones(6), rel=1e-9)
    assert np.mean(found.max(axis=1) >= 5.0) <= 0.2


def test_a_control_leaves_the_capital_a_martingale_whatever_it_predicts():
    """Of every sixth scene both are tried that can come after the same five."""
    z = np.array([[0.0], [1.2], [0.1], [-0.7], [0.2], [0.0], [1.0]])
    found = []
    for start in itertools.permutations((0, 2, 3, 4, 5, 6), 3):
        rest = [i for i in range(7) if i not in (1, *start)]
        for sixth, last in ((1, 2), (2, 1)):
            order = [1, *start, rest[0], rest[sixth], rest[last]]
            x = SUITE[order]
            found.append(
                capital(
                    without_replacement(x, -1.0, 1.0, 7, *predictions(x, z[order])),
                    float(SUITE.mean()),
                )
            )
    pairs = np.array(found).reshape(-1, 2, 7)
    assert np.any(pairs[:, 0, 5] != pairs[:, 1, 5])
    assert pairs[:, :, 5].mean(axis=1) == pytest.approx(pairs[:, 0, 4], rel=1e-9)


HARD = {
    "one scene": np.array([0.3]),
    "all equal": np.zeros(40),
    "at the bounds": np.array([1.0, -1.0] * 30),
    "the least value each time": np.full(60, -1.0),
    "the greatest value each time": np.ones(60),
    "a thousand scenes": rng(1).choice([-1.0, 0.0, 1.0], 1000, p=[0.03, 0.94, 0.03]),
}


@pytest.mark.parametrize("case", HARD)
@pytest.mark.parametrize("distance", [0.05, None])
def test_the_capital_is_that_of_betting_scene_by_scene(case, distance):
    x = HARD[case]
    plan = Plan(distance, max(50, len(x)), 0.05)
    draws = independent(x, -1.0, 1.0)
    found = betting.log_capital(draws, 0.05, betting.bet_sizes(draws, 0.05, plan))
    assert found == pytest.approx(
        plain_log_capital(list(x), -1.0, 1.0, 0.05, plan), rel=1e-9, abs=1e-9
    )
    assert np.all(np.isfinite(found))


@given(st.lists(st.sampled_from([-1.0, -0.2, 0.0, 0.0, 0.4, 1.0]), min_size=1, max_size=25))
def test_the_capital_falls_with_the_hypothesis_and_bounds_are_nested(values):
    draws = independent(np.array(values), -1.0, 1.0)
    sizes = betting.bet_sizes(draws, 0.05, PLAN)
    ladder = np.stack(
        [betting.log_capital(draws, mean, sizes) for mean in np.linspace(-1.0, 1.0, 41)]
    )
    assert np.all(np.diff(ladder, axis=0) <= 1e-9)
    lows = [
        float(betting.lower_bound(draws.first(n), sizes[:n], PLAN.log_bar, -1.0, 1.0))
        for n in range(1, draws.n + 1)
    ]
    assert np.all(np.diff(lows) >= -1e-9)
    if lows[-1] > -1.0:
        assert betting.log_capital(draws, lows[-1], sizes).max() >= PLAN.log_bar
        assert betting.log_capital(draws, lows[-1] + 1e-6, sizes).max() < PLAN.log_bar


def test_a_suite_whose_scenes_left_cannot_make_up_for_it_is_refuted_at_once():
    draws = without_replacement(np.array([1.0, 1.0, 1.0]), -1.0, 1.0, 4)
    assert betting.log_capital(draws, 0.49, np.full(3, 1e-9))[-1] < 1.0  # the mean can still be 0.5
    late = without_replacement(np.array([1.0, 1.0, 1.0, 0.5]), -1.0, 1.0, 4)
    assert betting.log_capital(late, 0.4, np.full(4, 1e-9))[-1] == np.inf


# --- asymptotic


def plain_log_evidence(x: Sequence[float], mean: float, plan: Plan, first: int) -> list[float]:
    from scipy import stats

    out = []
    slope = 0.0
    height = 0.0
    is_past = False
    for n in range(1, len(x) + 1):
        spread = max(
            float(np.std(x[:n], ddof=1)) if n > 1 else 0.0,
            asymptotic.LEAST_SPREAD * (plan.distance or 0.0),
        )
        if n < first:
            out.append(-math.inf)
            continue
        slope = slope or float(plan.slope(np.array(spread)))
        height = height or optimize.brentq(
            lambda a, slope=slope: log_chance(a, 1.0, slope) + plan.log_bar, 0.1, 9.0
        )
        t = (float(np.mean(x[:n])) - mean) * math.sqrt(n) / spread
        z = -math.copysign(1.0, t) * stats.norm.ppf(stats.t.cdf(-abs(t), n - 1))
        time = n / plan.horizon
        gap = height + slope * time - z * math.sqrt(time)
        is_past = is_past or gap <= 0.0
        below = log_chance(gap, 1.0 - time, slope) if gap > 0.0 and time < 1.0 else -math.inf
        out.append((-2 * slope * gap if is_past else below) + plan.log_bar)
    return out


def test_renderers_that_never_differ_give_no_evidence_without_a_plan():
    found = asymptotic.log_evidence(
        independent(np.zeros(40), -np.inf, np.inf), 0.0, Plan(None, 100, 0.05)
    )
    assert np.all(found[asymptotic.FIRST_LOOK - 1 :] < 0.0)


@pytest.mark.parametrize("case", ["normal", "far from zero", "all equal", "two scenes"])
def test_the_asymptotic_evidence_is_that_of_the_formula(case):
    x = {
        "normal": rng(2).normal(0.1, 0.3, 60),
        "far from zero": 1e6 + rng(3).normal(0, 0.3, 40),
        "all equal": np.full(30, 0.02),
        "two scenes": np.array([0.1, 0.3]),
    }[case]
    mean, first = (1e6 if case == "far from zero" else 0.1), (2 if case == "two scenes" else 10)
    found = asymptotic.log_evidence(independent(x, -np.inf, np.inf), mean, PLAN, first)
    assert found == pytest.approx(
        plain_log_evidence(list(x), mean, PLAN, first), rel=1e-6, abs=1e-6
    )


def test_the_asymptotic_bound_is_where_the_evidence_reaches_the_bar_and_bounds_are_nested():
    draws = independent(rng(4).normal(0.1, 0.3, (3, 50)), -np.inf, np.inf)
    low = asymptotic.lower_bound(draws, PLAN)
    for side, reaches in ((-1e-7, True), (1e-7, False)):
        evidence = asymptotic.log_evidence(draws, low + side, PLAN).max(axis=1)
        assert np.all((evidence >= PLAN.log_bar) == reaches)
    over_time = np.stack(
        [asymptotic.lower_bound(draws.first(n), PLAN) for n in range(asymptotic.FIRST_LOOK, 51, 3)]
    )
    assert np.all(np.diff(over_time, axis=0) >= -1e-12)
    assert np.all(asymptotic.lower_bound(draws.first(asymptotic.FIRST_LOOK - 1), PLAN) == -np.inf)


def test_normal_scenes_are_wrongly_judged_in_about_the_promised_share_of_runs():
    """The full grid is in docs/experiments/verdict-error.md; the standard error is 0.9 points."""
    draws = independent(rng(5).standard_normal((600, 120)), -np.inf, np.inf)
    wrong = asymptotic.log_evidence(draws, 0.0, Plan(0.3, 120, 0.05)).max(axis=1) >= -math.log(0.05)
    assert 0.01 < wrong.mean() < 0.07


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


# --- controls


def test_what_a_control_takes_off_is_a_ridge_prediction_whose_mean_over_the_scenes_left_is_zero():
    generator = rng(6)
    z, x = generator.normal(size=(30, 2)), generator.normal(size=20)
    removed, reach = predictions(x, z)
    scaled = (z - z.mean(axis=0)) / z.std(axis=0)
    for i in range(20):
        coefficients = np.zeros(2)
        if i >= 5:
            past = scaled[:i] - scaled[:i].mean(axis=0)
            coefficients = np.linalg.solve(
                past.T @ past + RIDGE * np.eye(2), past.T @ (x[:i] - x[:i].mean())
            )
        of_all = (scaled[i:] - scaled[i:].mean(axis=0)) @ coefficients
        assert of_all.mean() == pytest.approx(0.0, abs=1e-12)
        assert (removed[i], reach[i]) == pytest.approx((of_all[0], np.abs(of_all).max()), abs=1e-9)


def test_a_control_that_knows_the_scenes_narrows_the_interval():
    generator = rng(7)
    hard = generator.normal(size=60)
    order = [f"s{i}" for i in range(60)]
    x = 0.2 * hard[:30] + generator.normal(0.0, 0.05, 30)
    one = metric_question("lateral_distance_m", 0.1, "non-inferior")
    plain = adjusted_draws(x, one, order, None)
    known = adjusted_draws(
        x, one, order, Control({s: (h,) for s, h in zip(order, hard, strict=True)}, ("difficulty",))
    )
    lows = [float(asymptotic.lower_bound(draws, PLAN)) for draws in (plain, known)]
    assert lows[1] > lows[0]


def test_families_are_files_or_folders_and_one_alone_is_refused():
    by_seed = of_families(
        {"a-1": "x/a.yaml", "a-2": "x/a.yaml", "b-1": "x/b.yaml", "b-2": "x/b.yaml"}
    )
    assert by_seed.names == ("family a", "family b")
    assert by_seed.features["b-2"] == (0.0, 1.0)
    assert of_families({"a": "x/a.yaml", "b": "y/b.yaml"}).names == ("family x", "family y")
    with pytest.raises(InputError, match="one family, x"):
        of_families({"a": "x/a.yaml", "b": "x/b.yaml"})


def test_an_earlier_run_gives_differences_and_difficulty_and_must_hold_half_of_the_suite():
    rows = [
        {
            "renderer": r,
            "policy": "p",
            "scene": s,
            "seed": 0,
            "status": "ok",
            "progress": v,
            "progress_valid": True,
        }
        for r, s, v in (
            ("clean", "a", 0.9),
            ("3dgs", "a", 0.7),
            ("clean", "b", 0.5),
            ("3dgs", "b", 0.5),
        )
    ]
    found = of_rows(rows, "progress", ["a", "b", "c"], "3dgs", "clean", "runs/old")
    assert found.features["a"] == pytest.approx((-0.2, 0.9))
    assert found.features["c"] == pytest.approx((-0.1, 0.7))  # not there: the mean
    with pytest.raises(InputError, match="2 of 5 scenes"):
        of_rows(rows, "progress", list("abcde"), "3dgs", "clean", "runs/old")
