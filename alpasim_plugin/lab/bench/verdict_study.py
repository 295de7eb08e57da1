"""Monte-Carlo study of verdicts with the truth on the margin: how often each is given, which is how
often it is wrong.

``python -m alpasim_plugin.lab.bench.verdict_study`` prints the tables of
docs/experiments/verdict-error.md; ``--write PAGE`` puts them between the markers of that page. The
families are adverse: a few scenes go very wrong, or most get a little better and a few much worse;
for the verdict "worse" the other way round. Beside them the worst of many random distributions is
looked for.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import scipy

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
from evaluators.statistics.verdicts import ALPHA

SEEDS = 5
SCENES = (20, 40, 60, 100, 200, 300)
SCENES_OF_POWER = (60, 80, 100, 120, 146, 200, 300, 600)
BASE_RATE = 0.069
REPEATS = 4000
BLOCK = 500

Draw = Callable[
    [np.random.Generator, int, int], F64
]  # (generator, runs, scenes) -> harm (runs, scenes, seeds)


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
    """Return scenes of which a share is ``size`` worse and a share ``size`` better, in all seeds;
    the others differ by normal noise.
    """

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
    """Return outcomes of two renderers with shared random numbers, as `interval_study` draws
    them.
    """

    def draw(generator: np.random.Generator, runs: int, scenes: int) -> F64:
        mine, base = pairs(
            Design(scenes, SEEDS, BASE_RATE + worse, correlation),
            BASE_RATE,
            SHARED_NOISE,
            runs,
            generator,
        )
        return np.asarray(mine - base)

    return draw


def one_rate(worse: float, correlation: float) -> Draw:
    """Return outcomes of a renderer that only gains events, correlated within a scene."""

    def draw(generator: np.random.Generator, runs: int, scenes: int) -> F64:
        return flags(Design(scenes, SEEDS, worse, correlation), runs, generator)

    return draw


def long_tail(mean: float, sigma: float, reach: float) -> Draw:
    """Return log-normal harm cut at ``reach``, scaled so that the mean after the cut is
    ``mean``.
    """
    sample = np.exp(sigma * stream("verdicts", 0, "aggregate/study").standard_normal(400_000))
    low, high = 1e-9, 1e3
    for _ in range(100):
        middle = float(np.sqrt(low * high))
        low, high = (
            (low, middle)
            if float(np.minimum(middle * sample, reach).mean()) > mean
            else (middle, high)
        )

    def draw(generator: np.random.Generator, runs: int, scenes: int) -> F64:
        return np.asarray(
            np.minimum(low * np.exp(sigma * generator.standard_normal((runs, scenes, 1))), reach)
        )

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


def seldom_better(harm: float, share: float, size: float, noise: float = 0.0) -> Draw:
    """Return scenes that are all ``harm`` worse, but for a share that is ``size`` better than
    these.
    """

    def draw(generator: np.random.Generator, runs: int, scenes: int) -> F64:
        x = np.where(generator.random((runs, scenes, 1)) < share, harm - size, harm)
        return np.asarray(x + noise * generator.standard_normal(x.shape))

    return draw


def mirrored(draw: Draw, margin: float) -> Draw:
    """Return harm on the other side of the margin."""
    return lambda generator, runs, scenes: 2.0 * margin - draw(generator, runs, scenes)


def families_against_worse() -> list[Family]:
    """Return families whose true harm is the margin, and of which many draws look worse."""
    both = [one for one in adverse_families() if one.is_rate and one.margin == 0.05]
    metres = partial(Family, margin=0.1, reach=4.0, is_rate=False)
    return [
        *both,
        Family("progress: 10 % far better", seldom_better(0.1, 0.1, 0.5), 0.05, is_rate=False),
        metres("metres: 2.5 % of scenes better by 4 m", seldom_better(0.2, 0.025, 4.0, 0.05)),
        metres("metres: 5 % better by 2 m", seldom_better(0.2, 0.05, 2.0, 0.05)),
        metres("metres: 5 % worse, 2.5 % better by 4 m", jumps(0.05, 4.0, 0.025)),
        metres(
            "metres: log-normal, sigma 1, its tail better", mirrored(long_tail(0.1, 1.0, 4.0), 0.1)
        ),
        metres("metres: normal, 0.5 m", mirrored(jumps(0.0, noise=0.5), 0.05)),
    ]


def harmless_families() -> list[Family]:
    """Return families without harm, for the power."""
    return [
        Family("rates, margin 5 points: no event", jumps(0.0), 0.05),
        Family("rates, margin 5 points: equal rates, correlation 0.6", two_rates(0.0, 0.6), 0.05),
        Family(
            "rates, margin 5 points: 5 % of scenes up, 5 % down", jumps(0.05, better=0.05), 0.05
        ),
        Family(
            "rates, margin 2 points: 1 % of scenes up, 3 % down", jumps(0.01, better=0.03), 0.02
        ),
        Family("metres, margin 0.1: noise of 0.1 m", jumps(0.0, noise=0.1), 0.1, 4.0, False),
        Family("metres, margin 0.1: noise of 0.5 m", jumps(0.0, noise=0.5), 0.1, 4.0, False),
        Family(
            "metres, margin 0.1: 1 % up, 1 % down by 4 m",
            jumps(0.01, 4.0, 0.01, 0.1),
            0.1,
            4.0,
            False,
        ),
    ]


def harmful_families() -> list[Family]:
    """Return families in metres that are worse, turned over: what takes few scenes to be
    "non-inferior" here is soon called "worse".
    """
    metres = partial(Family, margin=-0.1, reach=4.0, is_rate=False)
    return [
        metres("metres, margin 0.1: all 0.3 m worse", turned(seldom_better(0.3, 0.0, 0.0))),
        metres(
            "metres, margin 0.1: 0.5 m worse, noise of 0.5 m",
            turned(seldom_better(0.5, 0.0, 0.0, 0.5)),
        ),
        metres("metres, margin 0.1: all 1 m worse", turned(seldom_better(1.0, 0.0, 0.0))),
        metres("metres, margin 0.1: 20 % of scenes 2 m worse", turned(jumps(0.2, 2.0))),
        metres(
            "metres, margin 0.1: 0.5 m worse, 2 % by 4 m better",
            turned(seldom_better(0.5, 0.02, 4.0, 0.1)),
        ),
    ]


def turned(draw: Draw) -> Draw:
    """Return harm as benefit."""
    return lambda generator, runs, scenes: -draw(generator, runs, scenes)


def by_spread(harm: F64, family: Family) -> F64:
    """Return where ``(runs,)`` the interval of what was seen is below the margin: t, or for rates
    the joined bounds.
    """
    if not family.is_rate:
        return np.asarray(t_bounds(harm.mean(axis=2))[1] < family.margin)
    gained, lost = np.maximum(harm, 0.0).mean(axis=2), np.maximum(-harm, 0.0).mean(axis=2)
    return np.asarray(flag_bounds(gained, lost)[1] < family.margin)


def guarded(harm: F64, family: Family) -> F64:
    """Return where ``(runs,)`` the guarded bound is below the margin: what a verdict asks for."""
    cut = np.clip(harm.mean(axis=2), -family.reach, family.reach)
    return np.asarray(chance_above(cut, family.margin, family.reach) < TAIL)


def bet(harm: F64, family: Family) -> F64:
    """Return where ``(runs,)`` a bet against "the mean is the margin" wins, as ``simrun decide``
    makes it; its error is proved.
    """
    x = -np.clip(harm.mean(axis=2), -family.reach, family.reach)
    draws, plan = (
        independent(x, -family.reach, family.reach),
        Plan(abs(family.margin), x.shape[1], TAIL),
    )
    sizes = betting.bet_sizes(draws, -family.margin, plan)
    return np.asarray(betting.log_capital(draws, -family.margin, sizes).max(axis=1) >= plan.log_bar)


def hedged(harm: F64, family: Family) -> F64:
    """Return where ``(runs,)`` a bet that knows no expected difference wins: Waudby-Smith and
    Ramdas 2024, the predictable plug-in.
    """
    x = (np.clip(harm.mean(axis=2), -family.reach, family.reach) + family.reach) / (
        2.0 * family.reach
    )
    at, n = (family.margin + family.reach) / (2.0 * family.reach), x.shape[1]
    count = np.arange(2, n + 2)
    mean = (0.5 + np.cumsum(x, axis=1)) / count
    spread = (0.25 + np.cumsum((x - mean) ** 2, axis=1)) / count
    before = np.concatenate([np.full((len(x), 1), 0.25), spread[:, :-1]], axis=1)
    stake = np.minimum(np.sqrt(2.0 * np.log(1.0 / TAIL) / (n * before)), 0.9 / (1.0 - at))
    return np.asarray(
        np.cumsum(np.log1p(stake * (at - x)), axis=1).max(axis=1) >= np.log(1.0 / TAIL)
    )


def bernstein(harm: F64, family: Family) -> F64:
    """Return where ``(runs,)`` the empirical Bernstein bound of Maurer and Pontil (2009) is below
    the margin.
    """
    x = np.clip(harm.mean(axis=2), -family.reach, family.reach)
    n, level = x.shape[1], np.log(2.0 / TAIL)
    error = np.sqrt(2.0 * x.var(axis=1, ddof=1) * level / n) + 14.0 * family.reach * level / (
        3.0 * (n - 1)
    )
    return np.asarray(x.mean(axis=1) + error < family.margin)


def worse_by_spread(harm: F64, family: Family) -> F64:
    """Return where ``(runs,)`` what was seen is worse than the margin, and the test of no
    difference rejects.
    """
    means = harm.mean(axis=2)
    up, down = (means > 0).sum(axis=1), (means < 0).sum(axis=1)
    p = 2.0 * scipy.special.bdtr(np.minimum(up, down), up + down, 0.5)
    if family.is_rate:
        return np.asarray(
            (
                flag_bounds(
                    np.maximum(harm, 0.0).mean(axis=2), np.maximum(-harm, 0.0).mean(axis=2)
                )[0]
                > family.margin
            )
            & (p < ALPHA)
        )
    alike = np.ptp(means, axis=1) < 1e-12  # the bounds are then the guarded ones
    low = t_bounds(means)[0]
    t = (means.mean(axis=1)) / np.where(
        alike, 1.0, means.std(axis=1, ddof=1) / np.sqrt(means.shape[1])
    )
    p = np.where(alike, p, 2.0 * scipy.special.stdtr(means.shape[1] - 1, -np.abs(t)))
    return np.asarray(
        np.where(alike, worse_by(guarded)(harm, family), low > family.margin) & (p < ALPHA)
    )


def worse_by(method: Callable[[F64, Family], F64]) -> Callable[[F64, Family], F64]:
    """Return where ``(runs,)`` a method's bound is above the margin."""
    return lambda harm, family: method(-harm, replace(family, margin=-family.margin))


Methods = dict[str, Callable[[F64, Family], F64]]
METHODS: Methods = {"spread": by_spread, "betting": bet, "guarded": guarded}
WORSE: Methods = {"spread": worse_by_spread, "betting": worse_by(bet), "guarded": worse_by(guarded)}
VALID: Methods = {"guarded": guarded, "betting": bet, "hedged": hedged, "Bernstein": bernstein}


def shares(
    family: Family, scenes: int, repeats: int, methods: Methods = METHODS
) -> dict[str, float]:
    """Return how often each method gives its verdict."""
    sizes = [min(BLOCK, repeats - start) for start in range(0, repeats, BLOCK)]
    found: dict[str, float] = dict.fromkeys(methods, 0.0)
    for i, size in enumerate(sizes):
        harm = family.draw(stream(f"{family.name}/{scenes}", 0, "aggregate/study", i), size, scenes)
        for name, method in methods.items():
            found[name] += float(np.sum(method(harm, family))) / repeats
    return found


def table(
    families: Sequence[Family], scenes: Sequence[int], repeats: int, methods: Methods = METHODS
) -> str:
    """Return a Markdown table with a row for each family, the methods' shares in percent with
    slashes between.
    """
    lines = [
        f"| family | {' | '.join(f'{n} scenes' for n in scenes)} |",
        f"| --- |{' --- |' * len(scenes)}",
    ]
    for family in families:
        cells = [
            " / ".join(
                f"{100 * share:.1f}" for share in shares(family, n, repeats, methods).values()
            )
            for n in scenes
        ]
        lines.append(f"| {family.name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def picked(values: F64, chance: F64) -> Draw:
    """Return scenes with one of some values each."""
    return lambda generator, runs, scenes: generator.choice(values, (runs, scenes, 1), p=chance)


def random_family(generator: np.random.Generator, margin: float, reach: float) -> Family:
    """Return three to five values between ``-reach`` and ``reach``, the ends among them more often
    than not, with the margin as mean.
    """
    while True:
        values = np.where(
            generator.random(5) < 0.3,
            generator.choice([-reach, 0.0, reach]),
            generator.uniform(-reach, reach, 5),
        )
        values[0] = reach if generator.random() < 0.7 else values[0]
        values = np.unique(values[: generator.integers(3, 6)])
        weights = generator.dirichlet(np.full(len(values), 0.3))
        seen, rest = float(weights[:-1] @ values[:-1]), float(weights[:-1].sum())
        # The share of the greatest value is what brings the mean to the margin; the others keep
        # their proportions.
        if rest > 0.0 and seen / rest < margin < values[-1]:
            top = (margin - seen / rest) / (values[-1] - seen / rest)
            chance = np.append(weights[:-1] / rest * (1.0 - top), top)
            return Family("random", picked(values, chance), margin, reach, False)


def worst_found(scenes: int, margin: float, reach: float, candidates: int, repeats: int) -> float:
    """Return the largest share of wrong verdicts by the guarded bound among random distributions;
    the worst ten are drawn afresh.
    """
    generator = stream(f"worst/{scenes}/{margin}", 0, "aggregate/study")
    families = [random_family(generator, margin, reach) for _ in range(candidates)]
    first = [
        float(guarded(one.draw(generator, repeats // 16, scenes), one).mean()) for one in families
    ]
    return max(
        float(guarded(families[k].draw(generator, repeats, scenes), families[k]).mean())
        for k in np.argsort(first)[-10:]
    )


def worst_table(scenes: Sequence[int], candidates: int, repeats: int) -> str:
    """Return a Markdown table of `worst_found`: rates, metres, and both turned, which is the
    verdict "worse".
    """
    asked = {
        "-1 to 1, margin 0.02": (0.02, 1.0),
        "-1 to 1, margin 0.05": (0.05, 1.0),
        "-4 to 4, margin 0.1": (0.1, 4.0),
    }
    asked |= {f"{name}, worse": (-margin, reach) for name, (margin, reach) in asked.items()}
    lines = [
        f"| differences | {' | '.join(f'{n} scenes' for n in scenes)} |",
        f"| --- |{' --- |' * len(scenes)}",
    ]
    for name, (margin, reach) in asked.items():
        cells = [f"{100 * worst_found(n, margin, reach, candidates, repeats):.1f}" for n in scenes]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


POWER, MOST_SCENES = 0.8, 1600


def scenes_to_decide(
    family: Family, method: Callable[[F64, Family], F64], repeats: int
) -> int | None:
    """Return the number of scenes from which on a method says "non-inferior" in 80 % of runs, to 1
    %; None where none does.
    """
    harm = family.draw(stream(f"{family.name}/needed", 0, "aggregate/study"), repeats, MOST_SCENES)
    low, high = 2, MOST_SCENES
    if float(method(harm, family).mean()) < POWER:
        return None
    while high - low > max(1, high // 100):
        middle = (low + high) // 2
        low, high = (
            (low, middle)
            if float(method(harm[:, :middle], family).mean()) >= POWER
            else (middle, high)
        )
    return high


def needed_table(families: Sequence[Family], repeats: int) -> str:
    """Return a Markdown table of the scenes that each valid method needs, and of the guarded
    bound's as a share of the best other.
    """
    lines = [
        f"| family | {' | '.join(VALID)} | guarded / best other |",
        f"| --- |{' --- |' * (len(VALID) + 1)}",
    ]
    for family in families:
        found = {name: scenes_to_decide(family, method, repeats) for name, method in VALID.items()}
        others = [n for name, n in found.items() if n is not None and name != "guarded"]
        ratio = f"{found['guarded'] / min(others):.2f}" if found["guarded"] and others else "-"
        lines.append(
            f"| {family.name} | {' | '.join(str(n or f'over {MOST_SCENES}') for n in found.values())} | {ratio} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the tables, or write them into a page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=REPEATS, help="Runs for each cell.")
    parser.add_argument("--write", type=Path, help="Page whose tables are replaced.")
    options = parser.parse_args()
    made = {
        "wrong": table(adverse_families(), SCENES, options.repeats),
        "worse": table(families_against_worse(), SCENES, options.repeats, WORSE),
        "worst": worst_table(SCENES, options.repeats // 5, 8 * options.repeats),
        "power": table(harmless_families(), SCENES_OF_POWER, max(200, options.repeats // 4)),
        "needed": needed_table(harmless_families(), max(200, options.repeats // 4)),
        "needed-worse": needed_table(harmful_families(), max(200, options.repeats // 4)),
    }
    if options.write is None:
        print("\n".join(f"{name}\n\n{text}" for name, text in made.items()))
    else:
        write_into(options.write, made)


if __name__ == "__main__":
    main()
