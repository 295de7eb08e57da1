"""Monte-Carlo study of the verdict "non-inferior" with the truth on the margin: how often it is given, which is how often it is wrong.

``python -m alpasim_plugin.lab.bench.verdict_study`` prints the tables of docs/experiments/verdicts.md; ``--write PAGE`` puts them between
the markers of that page. The families are adverse: a few scenes go very wrong, or most get a little better and a few much worse.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.bench.coverage import write_into
from alpasim_plugin.lab.bench.interval_study import SHARED_NOISE, Design, flags, pairs
from evaluators.statistics.bounded import chance_above
from evaluators.statistics.intervals import TAIL, t_bounds
from evaluators.statistics.paired import flag_bounds
from evaluators.statistics.sequential import betting
from evaluators.statistics.sequential.draws import independent
from evaluators.statistics.sequential.line import Plan

SEEDS = 5
SCENES = (20, 40, 60, 100, 200, 300)
SCENES_OF_POWER = (60, 80, 100, 120, 146, 200, 300, 600)
BASE_RATE = 0.069
REPEATS = 4000
BLOCK = 500

Draw = Callable[[np.random.Generator, int, int], F64]  # (generator, runs, scenes) -> harm (runs, scenes, seeds)


@dataclass(frozen=True)
class Family:
    """Differences of scenes, positive is worse.

    Attributes:
        name: For the table.
        draw: Gives them.
        margin: How much worse is accepted.
        reach: The most that a scene can be worse.
        is_rate: Seeds have an event or not.
    """

    name: str
    draw: Draw
    margin: float
    reach: float = 1.0
    is_rate: bool = True


def jumps(worse: float, size: float = 1.0, better: float = 0.0, noise: float = 0.0) -> Draw:
    """Return scenes of which a share is ``size`` worse and a share ``size`` better, in all seeds; the others differ by normal noise."""

    def draw(generator: np.random.Generator, runs: int, scenes: int) -> F64:
        u = generator.random((runs, scenes, 1))
        x = np.where(u < worse, size, np.where(u < worse + better, -size, 0.0))
        return np.asarray(x + noise * generator.standard_normal(x.shape))

    return draw


def single_seeds(worse: float, better: float = 0.0) -> Draw:
    """Return outcomes that every seed gains or loses by itself."""

    def draw(generator: np.random.Generator, runs: int, scenes: int) -> F64:
        u = generator.random((runs, scenes, SEEDS))
        return np.where(u < worse, 1.0, np.where(u < worse + better, -1.0, 0.0))

    return draw


def two_rates(worse: float, correlation: float) -> Draw:
    """Return outcomes of two renderers with shared random numbers, as `interval_study` draws them."""

    def draw(generator: np.random.Generator, runs: int, scenes: int) -> F64:
        mine, base = pairs(Design(scenes, SEEDS, BASE_RATE + worse, correlation), BASE_RATE, SHARED_NOISE, runs, generator)
        return np.asarray(mine - base)

    return draw


def one_rate(worse: float, correlation: float) -> Draw:
    """Return outcomes of a renderer that only gains events, correlated within a scene."""

    def draw(generator: np.random.Generator, runs: int, scenes: int) -> F64:
        return flags(Design(scenes, SEEDS, worse, correlation), runs, generator)

    return draw


def long_tail(mean: float, sigma: float, reach: float) -> Draw:
    """Return log-normal harm cut at ``reach``, scaled so that the mean after the cut is ``mean``."""
    sample = np.exp(sigma * stream("verdicts", 0, "aggregate/study").standard_normal(400_000))
    low, high = 1e-9, 1e3
    for _ in range(100):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if float(np.minimum(middle * sample, reach).mean()) > mean else (middle, high)

    def draw(generator: np.random.Generator, runs: int, scenes: int) -> F64:
        return np.asarray(np.minimum(low * np.exp(sigma * generator.standard_normal((runs, scenes, 1))), reach))

    return draw


def adverse_families() -> list[Family]:
    """Return families whose true harm is the margin."""
    found = []
    for m in (0.02, 0.05):
        label = f"rates, margin {100 * m:g} points: "
        found += [
            Family(f"{label}one-sided, whole scenes", jumps(m), m),
            Family(f"{label}one-sided, single seeds", single_seeds(m), m),
            Family(f"{label}one-sided, correlation 0.6", one_rate(m, 0.6), m),
            Family(f"{label}both sides, whole scenes", jumps(2 * m, better=m), m),
            Family(f"{label}both sides, single seeds", single_seeds(3 * m, 2 * m), m),
            Family(f"{label}two renderers, correlation 0.6", two_rates(m, 0.6), m),
            Family(f"{label}two renderers, correlation 0.8", two_rates(m, 0.8), m),
        ]
    metres = partial(Family, margin=0.1, reach=4.0, is_rate=False)
    return [
        *found,
        metres("metres: 2.5 % of scenes by 4 m", jumps(0.025, 4.0)),
        metres("metres: the same, others noisy by 0.1 m", jumps(0.025, 4.0, noise=0.1)),
        metres("metres: 5 % by 2 m", jumps(0.05, 2.0)),
        metres("metres: 10 % by 1 m", jumps(0.1, 1.0)),
        metres("metres: 5 % worse, 2.5 % better by 4 m", jumps(0.05, 4.0, 0.025)),
        metres("metres: log-normal, sigma 1", long_tail(0.1, 1.0, 4.0)),
        metres("metres: log-normal, sigma 2", long_tail(0.1, 2.0, 4.0)),
        Family("progress: 10 % stop half-way", jumps(0.1, 0.5), 0.05, is_rate=False),
    ]


def harmless_families() -> list[Family]:
    """Return families without harm, for the power."""
    return [
        Family("rates, margin 5 points: no event", jumps(0.0), 0.05),
        Family("rates, margin 5 points: equal rates, correlation 0.6", two_rates(0.0, 0.6), 0.05),
        Family("rates, margin 5 points: 5 % of scenes up, 5 % down", jumps(0.05, better=0.05), 0.05),
        Family("rates, margin 2 points: 1 % of scenes up, 3 % down", jumps(0.01, better=0.03), 0.02),
        Family("metres, margin 0.1: noise of 0.1 m", jumps(0.0, noise=0.1), 0.1, 4.0, False),
        Family("metres, margin 0.1: noise of 0.5 m", jumps(0.0, noise=0.5), 0.1, 4.0, False),
        Family("metres, margin 0.1: 1 % up, 1 % down by 4 m", jumps(0.01, 4.0, 0.01, 0.1), 0.1, 4.0, False),
    ]


def by_spread(harm: F64, family: Family) -> F64:
    """Return where ``(runs,)`` the interval of what was seen is below the margin: t, or for rates the joined bounds."""
    if not family.is_rate:
        return np.asarray(t_bounds(harm.mean(axis=2))[1] < family.margin)
    gained, lost = np.maximum(harm, 0.0).mean(axis=2), np.maximum(-harm, 0.0).mean(axis=2)
    return np.asarray(flag_bounds(gained, lost)[1] < family.margin)


def guarded(harm: F64, family: Family) -> F64:
    """Return where ``(runs,)`` the guarded bound is below the margin: what a verdict asks for."""
    cut = np.clip(harm.mean(axis=2), -family.reach, family.reach)
    return np.asarray(chance_above(cut, family.margin, family.reach) < TAIL)


def bet(harm: F64, family: Family) -> F64:
    """Return where ``(runs,)`` a bet against "the mean is the margin" wins, as ``simrun decide`` makes it; its error is proved."""
    x = -np.clip(harm.mean(axis=2), -family.reach, family.reach)
    draws, plan = independent(x, -family.reach, family.reach), Plan(family.margin, x.shape[1], TAIL)
    sizes = betting.bet_sizes(draws, -family.margin, plan)
    return np.asarray(betting.log_capital(draws, -family.margin, sizes).max(axis=1) >= plan.log_bar)


METHODS: dict[str, Callable[[F64, Family], F64]] = {"spread": by_spread, "betting": bet, "guarded": guarded}


def shares(family: Family, scenes: int, repeats: int) -> dict[str, float]:
    """Return how often each method says "non-inferior"."""
    sizes = [min(BLOCK, repeats - start) for start in range(0, repeats, BLOCK)]
    found: dict[str, float] = dict.fromkeys(METHODS, 0.0)
    for i, size in enumerate(sizes):
        harm = family.draw(stream(f"{family.name}/{scenes}", 0, "aggregate/study", i), size, scenes)
        for name, method in METHODS.items():
            found[name] += float(np.sum(method(harm, family))) / repeats
    return found


def table(families: Sequence[Family], scenes: Sequence[int], repeats: int) -> str:
    """Return a Markdown table with a row for each family, ``spread / betting / guarded`` in percent."""
    lines = [f"| family | {' | '.join(f'{n} scenes' for n in scenes)} |", f"| --- |{' --- |' * len(scenes)}"]
    for family in families:
        cells = [" / ".join(f"{100 * share:.1f}" for share in shares(family, n, repeats).values()) for n in scenes]
        lines.append(f"| {family.name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the tables, or write them into a page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=REPEATS, help="Runs for each cell.")
    parser.add_argument("--write", type=Path, help="Page whose tables are replaced.")
    options = parser.parse_args()
    made = {
        "wrong": table(adverse_families(), SCENES, options.repeats),
        "power": table(harmless_families(), SCENES_OF_POWER, max(200, options.repeats // 4)),
    }
    if options.write is None:
        print("\n".join(f"{name}\n\n{text}" for name, text in made.items()))
    else:
        write_into(options.write, made)


if __name__ == "__main__":
    main()
