"""Measure how often the rules of docs/statistics.md are wrong and how often they decide, beside
classical tests, and write the tables into docs/experiments/verdict-error.md.

    python docs/scripts/calibration.py [REPEATS [PART...]]

Differences are drawn scene by scene. "Wrong" is how often a rule answers although its answer is
false, with the truth as near to it as it can be; "right" is how often it answers where that is
true. A classical test stands beside a rule where it keeps its level for that kind of differences.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from pages import DOCS, replaced, table
from scipy.stats import ttest_1samp

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, MetricInfo
from alpasim_plugin.log.run_folder.sides import Side
from evaluators.metrics import METRICS
from evaluators.statistics.betting import Draws, Plan, bet_sizes, log_capital
from evaluators.statistics.bounded import mean_interval
from evaluators.statistics.intervals import TAIL, exact_rate, t_interval
from evaluators.statistics.paired import compare, flag_interval, reach_of
from evaluators.statistics.verdicts import ALPHA, sign_flip, sign_test

PAGE = DOCS / "experiments" / "verdict-error.md"
METRES, RATE, PROGRESS = (METRICS[n] for n in ("lateral_distance_m", "offroad", "progress"))
Draw = Callable[[np.random.Generator, int], F64]  # generator, scenes -> differences


def normal(mean: float) -> Draw:
    """Return draws with a spread of 0.2."""
    return lambda g, n: g.normal(mean, 0.2, n)


def heavy(mean: float) -> Draw:
    """Return draws of t with two degrees of freedom: their variance is infinite."""
    return lambda g, n: mean + 0.1 * g.standard_t(2, n)


def rare(mean: float, jump: float) -> Draw:
    """Return draws that are 0 but in rare scenes."""
    return lambda g, n: np.where(g.random(n) < mean / jump, jump, 0.0)


def seeds(gained: float, of: int) -> Draw:
    """Return differences of a rate over some seeds a scene: 2 % of scenes lose events, ``gained``
    more of them gain some.
    """

    def draw(g: np.random.Generator, n: int) -> F64:
        sign = g.choice([1.0, -1.0, 0.0], n, p=[gained + 0.02, 0.02, 0.96 - gained])
        return np.asarray(sign * g.integers(1, of + 1, n) / of)

    return draw


def signs(x: F64) -> float:
    """Return the exact p of the sign test on scenes; McNemar's of one seed."""
    return sign_test(int(np.sum(x > 0)), int(np.sum(x < 0)))


def t_test(x: F64) -> float:
    """Return the two-sided p of the paired t test."""
    return float(ttest_1samp(x, 0.0).pvalue)


def classical_bounds(x: F64, reach: float) -> list[float]:
    """Return upper bounds of a mean of values within a reach of 0 that hold for every distribution:
    Hoeffding's, Maurer and Pontil's (empirical Bernstein), and Clopper and Pearson's of how many
    scenes are worse at all.
    """
    x, n, log = np.clip(x, -reach, reach), len(x), math.log(1 / TAIL)
    hoeffding = np.mean(x) + 2 * reach * math.sqrt(log / (2 * n))
    log += math.log(2.0)
    spread = math.sqrt(2 * float(np.var(x, ddof=1)) * log / n)
    bernstein = np.mean(x) + spread + 14 * reach * log / (3 * (n - 1))
    return [hoeffding, bernstein, reach * exact_rate(float(np.sum(x > 0)), n)[1]]


def verdict_on(x: F64, metric: MetricInfo, margin: float) -> str:
    """Return what `compare` says of scene differences, positive is worse; a scene that is worse by
    what counts of it at most has left the route.
    """
    worse = -x if metric.direction == "higher" else x
    base = np.maximum(-worse, 0.0)
    left = (x >= reach_of(metric, margin)).astype(float)
    sides = [
        Side.of([{"policy": "p", "scene": f"s{i:04d}", "seed": 0, metric.name: a, "left_route": b}
                 for i, (a, b) in enumerate(zip(values, of, strict=True))])
        for values, of in ((base + worse, left), (base, np.zeros(len(x))))
    ]  # fmt: skip
    return str(compare(sides[0], sides[1], metric, "base", margin)["verdict"])


def share(hits: Iterable[bool]) -> str:
    """Print a share in percent."""
    return f"{100 * float(np.mean(list(hits))):.1f}"


def differs(g: np.random.Generator, n: int, repeats: int, *case: Any) -> str:
    """Measure "differs on these scenes"."""
    null, effect, classical = case
    alike = [sign_flip(null(g, n))[0] <= ALPHA for _ in range(repeats)]
    drawn = [effect(g, n) for _ in range(repeats // 2)]
    own = [sign_flip(x)[0] <= ALPHA for x in drawn]
    return " / ".join(map(share, (alike, own, [classical(x) <= ALPHA for x in drawn])))


def verdicts(g: np.random.Generator, n: int, repeats: int, *case: Any) -> str:
    """Measure `non-inferior` and `worse`."""
    answer, metric, margin, at_margin, truth = case
    sign = -1 if answer == "worse" else 1
    false = [at_margin(g, n) for _ in range(repeats)]
    true = [truth(g, n) for _ in range(repeats // 4)]
    given = [share(verdict_on(x, metric, margin) == answer for x in some) for some in (false, true)]
    bounds = np.array([classical_bounds(sign * x, reach_of(metric, margin)) for x in true])
    best = 100 * (bounds < sign * margin).mean(axis=0).max()
    return f"{given[0]} / {given[1]} / {best:.1f}"


def intervals(g: np.random.Generator, n: int, repeats: int, *case: Any) -> str:
    """Measure the intervals of a mean."""
    metric, truth, draw = case
    held, by_t = [], []
    for x in (draw(g, n) for _ in range(repeats)):
        means = x.reshape(n, -1).mean(axis=1)
        own = mean_interval(means, metric) if metric else flag_interval(
            x.ravel(), np.repeat(np.arange(n), x.shape[1]))  # fmt: skip
        low, high = own.bounds or (0.0, 0.0)
        held.append(low <= truth <= high)
        low, high = t_interval(means).bounds or (means[0], means[0])
        by_t.append(low <= truth <= high)
    return f"{share(held)} / {share(by_t)}"


def betting(g: np.random.Generator, n: int, repeats: int, *case: Any) -> str:
    """Measure ``--until-decided`` with a ceiling of n scenes."""
    reach, margin, at_margin, truth = case
    plan = Plan(margin, n, ALPHA)
    answers = []
    for draw in (at_margin, truth):
        x = np.clip([draw(g, n) for _ in range(repeats)], -reach, reach)
        draws = Draws(-x, reach)
        capital = log_capital(draws, -margin, bet_sizes(draws, -margin, plan))
        answers.append(capital.max(axis=-1) >= plan.log_bar)
    fixed = [min(classical_bounds(one, reach)) < margin for one in x[:200]]
    return " / ".join(map(share, (*answers, fixed)))


def always(g: np.random.Generator, n: int) -> F64:
    """Draw events of ten seeds: always in 10 % of scenes, in 5 % of seeds in others."""
    chance = np.where(g.random(n) < 0.1, 1.0, 0.05)
    return (g.random((n, 10)) < chance[:, None]).astype(float)


QUIET, NOISE, SAFE = rare(0.0, 1.0), normal(0.0), "non-inferior"
CASES = {
    differs: ((6, 14, 42, 100), {
        "0.1 m, spread 0.2 m; t test": (normal(0.0), normal(0.1), t_test),
        "0.1 m, tails of t(2); t test": (heavy(0.0), heavy(0.1), t_test),
        "rate +10 points, 1 seed; McNemar": (seeds(0.0, 1), seeds(0.1, 1), signs),
        "rate +10 points, 5 seeds; sign test": (seeds(0.0, 5), seeds(0.1, 5), signs),
    }),
    verdicts: ((42, 100, 400), {
        "0.1 m: all alike, spread 0.2 m": (SAFE, METRES, 0.1, normal(0.1), NOISE),
        "0.1 m: 2.5 % of scenes by 4 m": (SAFE, METRES, 0.1, rare(0.1, 4.0), QUIET),
        "0.1 m: 1 % of scenes by 15 m": (SAFE, METRES, 0.1, rare(0.15, 15.0), QUIET),
        "5 points: 5 % of scenes": (SAFE, RATE, 0.05, rare(0.05, 1.0), QUIET),
        "5 points, 5 seeds": (SAFE, RATE, 0.05, seeds(0.083, 5), QUIET),
        "0.05 of progress: 10 % by half": (SAFE, PROGRESS, 0.05, rare(0.05, 0.5), QUIET),
        "0.1 m: 1 m, spread 0.2 m": ("worse", METRES, 0.1, normal(0.1), normal(1.0)),
        "5 points: 30 % of scenes": ("worse", RATE, 0.05, rare(0.05, 1.0), rare(0.3, 1.0)),
    }),
    intervals: ((3, 6, 12, 20, 60), {
        "progress, one drive in ten stops early": (PROGRESS, 0.94, lambda g, n: np.where(
            g.random(n) < 0.1, g.uniform(0.0, 0.8, n), 1.0)),
        "metres, 2 % of scenes by 3 m": (METRES, 0.17, lambda g, n: (
            0.1 + 0.02 * g.random(n) + np.where(g.random(n) < 0.02, 3.0, 0.0))),
        "rate of 10 %, 1 seed": (RATE, 0.1, lambda g, n: (g.random(n) < 0.1).astype(float)),
        "rate of 10 %, 5 seeds, correlated": (RATE, 0.1, lambda g, n: (
            g.binomial(5, g.beta(0.3, 2.7, n)) / 5.0)),
        "rate, 10 seeds, always in 10 % of scenes, 5 % in others": (RATE, 0.145, always),
        "difference of that rate from 0": (None, 0.145, always),
    }),
    betting: ((400,), {
        "0.1 m: spread 0.2 m": (4.0, 0.1, normal(0.1), NOISE),
        "0.1 m: 2.5 % of scenes by 4 m": (4.0, 0.1, rare(0.1, 4.0), QUIET),
        "5 points: 5 % of scenes": (1.0, 0.05, rare(0.05, 1.0), QUIET),
        "5 points, 5 seeds": (1.0, 0.05, seeds(0.083, 5), seeds(0.0, 5)),
    }),
}  # fmt: skip


if __name__ == "__main__":
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    text = PAGE.read_text(encoding="utf-8")
    for measure, (scenes, cases) in CASES.items():
        if sys.argv[2:] and measure.__name__ not in sys.argv[2:]:
            continue
        rows = []
        for words, case in cases.items():
            of = [measure(stream(words, n, "docs/calibration"), n, repeats, *case) for n in scenes]
            rows.append([words if measure is not verdicts else f"`{case[0]}`, {words}", *of])
        head = ["differences", *(f"{n} scenes" for n in scenes)]
        text = replaced(text, measure.__name__, table(head, rows, "---:"))
    PAGE.write_text(text, encoding="utf-8")
