"""Monte-Carlo study of sequential decisions: errors over all looks, and scenes against a fixed
design of equal power.

Scene differences come from the model of `interval_study` (rates), or from distributions without
bounds. What is under test is what ``simrun decide`` runs: `evaluators.statistics.sequential`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.lab.bench.interval_study import RATES, SHARED_NOISE, Design, pairs
from evaluators.statistics.sequential import asymptotic, betting
from evaluators.statistics.sequential.control import predictions
from evaluators.statistics.sequential.decision import closed
from evaluators.statistics.sequential.differences import SceneDifferences, next_seeds
from evaluators.statistics.sequential.draws import (
    Draws,
    Strata,
    independent,
    stratified,
    without_replacement,
)
from evaluators.statistics.sequential.line import Plan
from evaluators.statistics.verdicts import scenes_needed

ALPHA = 0.05
GAP = RATES[0] - RATES[1]  # the difference of docs/experiments/verdict-error.md
LOOK_EVERY = 5
BLOCK = 250  # runs at a time, so that memory stays small
NEVER = 1 << 40

Way = Literal["random", "control", "stratified"]
Draw = Callable[
    [int, int, np.random.Generator], F64
]  # (runs, scenes, generator) -> differences (runs, scenes)


@dataclass(frozen=True)
class Case:
    """What is drawn, and what is asked of it.

    Attributes:
        name: Keys the random stream.
        draw: Differences, positive is worse.
        threshold: Where the answer changes.
        distance: Planned distance of the truth from it.
        bounded: Differences lie in [-1, 1] and are bet on; otherwise the asymptotic sequence is
            used.
        first_look: Of the asymptotic sequence.
    """

    name: str
    draw: Draw
    threshold: float
    distance: float
    bounded: bool = True
    first_look: int = asymptotic.FIRST_LOOK


@dataclass(frozen=True)
class Ends:
    """When runs ended.

    Attributes:
        good: ``(runs,)`` scenes at the look at which the good answer was given; `NEVER` where it
            was not.
        bad: The same for the bad one.
    """

    good: I64
    bad: I64

    def share(self, which: I64, ceiling: int) -> float:
        """Return the share of runs that gave an answer within so many scenes, before the other
        one.
        """
        other = self.bad if which is self.good else self.good
        return float(np.mean((which <= ceiling) & (which <= other)))

    def mean_scenes(self, ceiling: int) -> float:
        """Return the mean number of scenes, with a ceiling."""
        return float(np.minimum(np.minimum(self.good, self.bad), ceiling).mean())


def rate_pairs(candidate: float, baseline: float, correlation: float, seeds: int) -> Draw:
    """Return a draw of scene differences of two rates, with shared random numbers."""

    def draw(runs: int, scenes: int, generator: np.random.Generator) -> F64:
        mine, base = pairs(
            Design(scenes, seeds, candidate, correlation), baseline, SHARED_NOISE, runs, generator
        )
        return np.asarray((mine - base).mean(axis=2))

    return draw


def shape(name: str, mean: float) -> Draw:
    """Return a draw of differences without bounds, of variance 1: normal, the difference of two
    log-normal, or one of them.
    """

    def draw(runs: int, scenes: int, generator: np.random.Generator) -> F64:
        if name == "normal":
            return generator.standard_normal((runs, scenes)) + mean
        one = np.exp(generator.standard_normal((runs, scenes)))
        var = (math.e - 1.0) * math.e
        if name == "log-normal difference":
            return (one - np.exp(generator.standard_normal((runs, scenes)))) / math.sqrt(
                2.0 * var
            ) + mean
        if name == "log-normal":
            return (one - math.exp(0.5)) / math.sqrt(var) + mean
        return (math.exp(0.5) - one) / math.sqrt(var) + mean  # its long tail on the good side

    return draw


def logs(case: Case, draws: Draws, plan: Plan) -> tuple[F64, F64]:
    """Return the log e-processes ``(runs, n)`` against "at least the threshold" (good) and "at most
    the threshold" (bad).
    """
    mirror, at = draws.mirrored(), case.threshold
    if case.bounded:
        good = betting.log_capital(mirror, -at, betting.bet_sizes(mirror, -at, plan))
        return good, betting.log_capital(draws, at, betting.bet_sizes(draws, at, plan))
    first = case.first_look
    return asymptotic.log_evidence(mirror, -at, plan, first), asymptotic.log_evidence(
        draws, at, plan, first
    )


def ends(
    case: Case, runs: int, scenes: int, alpha: float = ALPHA, look_every: int = LOOK_EVERY
) -> Ends:
    """Simulate runs of at most ``scenes`` scenes and return when each answer was given."""
    plan = Plan(case.distance, scenes, alpha)
    found: list[tuple[I64, I64]] = []
    for block, start in enumerate(range(0, runs, BLOCK)):
        generator = stream(case.name, 0, "decide/study", block)
        x = case.draw(min(BLOCK, runs - start), scenes, generator)
        bound = 1.0 if case.bounded else math.inf
        good, bad = logs(case, independent(x, -bound, bound), plan)
        found.append((_when(good, plan.log_bar, look_every), _when(bad, plan.log_bar, look_every)))
    return Ends(*(np.concatenate(side) for side in zip(*found, strict=True)))


def fixed_scenes(distance: float, spread: float, power: float, tail: float) -> int:
    """Return the scenes at which a one-sided t test of level ``tail`` has the power.

    Raises:
        EvaluatorError: No number of scenes that can be driven has it.
    """
    found = scenes_needed(distance, spread, power, tail)
    if found is None:
        raise EvaluatorError(
            f"distance {distance:g}, spread {spread:g}: too many scenes, or none would do",
            "plan for a larger difference",
        )
    return found


def ceiling_for(case: Case, runs: int, fixed: int, power: float) -> tuple[int, Ends]:
    """Return the least ceiling at which decisions have the power, in steps of 5 % of the fixed
    design, and the runs that it gives.
    """
    ratio = 1.0
    while True:
        ceiling = round(ratio * fixed)
        done = ends(case, runs, ceiling)
        reached = done.share(done.good, ceiling)
        if reached >= power:
            return ceiling, done
        ratio += 0.05 if reached > power - 0.06 else 0.15


def spread_of(draw: Draw, name: str, scenes: int = 200_000) -> float:
    """Return the standard deviation of scene differences."""
    return float(draw(1, scenes, stream(name, 0, "decide/spread")).std())


def _when(path: F64, bar: float, look_every: int) -> I64:
    over = path >= bar
    first = np.where(over.any(axis=1), over.argmax(axis=1) + 1, NEVER)
    looked = np.minimum(
        -(-first // look_every) * look_every, path.shape[1]
    )  # the last look is at the ceiling
    return np.where(first == NEVER, NEVER, looked)


def overall(
    runs: int, k: int, correlation: float, truths: str, scenes: int = 300
) -> tuple[float, float]:
    """Return the shares of runs that end non-inferior, and worse, over k normal metrics with
    correlated scenes.

    Args:
        runs: Simulated runs.
        k: Metrics.
        correlation: Between the metrics of a scene.
        truths: ``all on the threshold``, or ``one on the threshold`` and the others far on the good
            side.
        scenes: At most.
    """
    plan = Plan(0.3, scenes, ALPHA)
    shared = Plan(0.3, scenes, ALPHA / k)
    bar = -math.log(ALPHA)
    good_runs, bad_runs = [], []
    for block, start in enumerate(range(0, runs, BLOCK)):
        generator = stream(f"overall {k} {correlation} {truths}", 0, "decide/study", block)
        n = min(BLOCK, runs - start)
        common = generator.standard_normal((n, scenes))
        good, bad = [], []
        for i in range(k):
            x = math.sqrt(correlation) * common + math.sqrt(
                1.0 - correlation
            ) * generator.standard_normal((n, scenes))
            far = 0.0 if i == 0 or truths == "all on the threshold" else -0.6
            one = Case("", shape("normal", 0.0), 0.0, 0.3, False)
            draws = independent(x + far, -math.inf, math.inf)
            good.append(np.maximum.accumulate(logs(one, draws, plan)[0], axis=1))
            bad.append(logs(one, draws, shared)[1])
        all_good = np.all(np.array(good) >= bar, axis=0).any(axis=1)
        any_bad = np.any(closed(np.array(bad)) >= bar, axis=0).any(axis=1)
        good_runs.append(all_good)
        bad_runs.append(any_bad)
    return float(np.concatenate(good_runs).mean()), float(np.concatenate(bad_runs).mean())


def suite_ends(runs: int, size: int, explained: float | None, on_threshold: bool) -> Ends:
    """Return when decisions about finite suites end; `NEVER` before all scenes are driven.

    Args:
        runs: Simulated runs, each with a suite of its own.
        size: Scenes of the suite, with differences of variance 1.
        explained: Share of the variance that a control knows beforehand; None: the population is
            asked about, not the suite.
        on_threshold: The suite's mean is the threshold; otherwise the planned 0.4 below it.
    """
    distance = 0.4
    plan = Plan(distance, size, ALPHA)
    case = Case("", shape("normal", 0.0), 0.0, distance, False)
    times: list[tuple[I64, I64]] = []
    for run in range(runs):
        generator = stream(f"suite {size} {explained} {on_threshold}", run, "decide/study")
        z = generator.standard_normal(size)
        share = explained or 0.0
        x = math.sqrt(share) * z + math.sqrt(1.0 - share) * generator.standard_normal(size)
        target = 0.0 if on_threshold else -distance
        x = x + target if explained is None else x - x.mean() + target
        if explained is None:
            draws = independent(x, -math.inf, math.inf)
        else:
            removed = predictions(x, z[:, None]) if explained else (None, None)
            draws = without_replacement(x, -math.inf, math.inf, size, *removed)
        good, bad = logs(case, draws, plan)
        times.append(
            (
                _when(good[None], plan.log_bar, LOOK_EVERY),
                _when(bad[None], plan.log_bar, LOOK_EVERY),
            )
        )
    return Ends(*(np.concatenate(side) for side in zip(*times, strict=True)))


def family_ends(
    runs: int,
    sizes: Sequence[int],
    between: float,
    way: Way,
    on_threshold: bool,
    bounded: bool = False,
) -> Ends:
    """Return when decisions about finite suites of families of scenes end; `NEVER` before all
    scenes are driven.

    Args:
        runs: Simulated runs, each with a suite of its own.
        sizes: Scenes of each family.
        between: Share of the variance that is between families; where bounded, of that of a share
            that worsens.
        way: ``random`` order; ``control``: random order with the families as control;
            ``stratified`` order.
        on_threshold: The suite's mean is the threshold; otherwise the planned distance below it.
        bounded: Differences are -1, 0 or 1, about a quarter and a tenth of them not 0, and are bet
            on; otherwise normal with variance 1.
    """
    size, distance, bound = sum(sizes), *((0.2, 1.0) if bounded else (0.4, math.inf))
    family, weight = np.repeat(np.arange(len(sizes)), sizes), np.array(sizes) / size
    batches = [min(LOOK_EVERY, size - begun) for begun in range(0, size, LOOK_EVERY)]
    strata = Strata({f"{i:04}": f"{own:02}" for i, own in enumerate(family)}, tuple(batches))
    plan = Plan(distance, size, ALPHA)
    times: list[tuple[I64, I64]] = []
    for run in range(runs):
        generator = stream(
            f"families {sizes} {between} {way} {on_threshold} {bounded}", run, "decide/study"
        )
        effect = generator.standard_normal(len(sizes))
        effect = effect - weight @ effect
        effect = math.sqrt(between) * (effect / math.sqrt(weight @ effect**2))[family]
        if bounded:
            worse = generator.random(size) < np.clip(0.25 + 0.25 * effect, 0.0, 0.9)
            x = worse.astype(np.float64) - (generator.random(size) < 0.1)
        else:
            x = effect + math.sqrt(1.0 - between) * generator.standard_normal(size)
        case = Case(
            "",
            shape("normal", 0.0),
            float(x.mean()) + (0.0 if on_threshold else distance),
            distance,
            bounded,
        )
        if way == "stratified":
            order = np.array([int(name) for name in strata.order(generator)])
            draws = stratified(
                x[order], -bound, bound, family[order], strata.begins(size), less_means=not bounded
            )
        else:
            order = generator.permutation(size)
            known = (
                predictions(x[order], np.eye(len(sizes))[family[order]])
                if way == "control"
                else (None, None)
            )
            draws = without_replacement(x[order], -bound, bound, size, *known)
        good, bad = logs(case, draws, plan)
        times.append(
            (
                _when(good[None], plan.log_bar, LOOK_EVERY),
                _when(bad[None], plan.log_bar, LOOK_EVERY),
            )
        )
    return Ends(*(np.concatenate(side) for side in zip(*times, strict=True)))


def hidden_suites(runs: int, share: float, bounded: bool, scenes: int = 300) -> float:
    """Return how often a metric is called non-inferior whose mean lies on the margin because of a
    few scenes that change from 0 to 1.
    """
    case = Case(
        f"hidden {share}",
        lambda r, n, g: (g.random((r, n)) < share).astype(np.float64),
        share,
        share,
        bounded,
    )
    return float(np.mean(ends(case, runs, scenes).good < NEVER))


def seed_costs(
    runs: int, within: float, scene_cost: float, rule: int, distance: float = 0.4, scenes: int = 400
) -> tuple[float, float]:
    """Return the mean cost of a decision in pairs of rollouts, scenes included, and the mean number
    of seeds.

    Args:
        runs: Simulated runs.
        within: Variance between the seeds of a scene; that between scenes is 1.
        scene_cost: Of a new scene, in pairs of rollouts.
        rule: Seeds of every scene; 0: up to five, chosen as ``simrun decide --seeds auto:5`` does.
        distance: Planned and true distance from the threshold.
        scenes: At most.
    """
    case = Case("", shape("normal", 0.0), 0.0, distance, False)
    plan = Plan(distance, scenes, ALPHA)
    costs, chosen = [], []
    for run in range(runs):
        generator = stream(f"seeds {within} {scene_cost}", run, "decide/study")
        values = (
            generator.standard_normal((scenes, 1))
            + math.sqrt(within) * generator.standard_normal((scenes, 5))
            - distance
        )
        x = np.empty(0)
        spread = np.empty(0)
        count = np.empty(0)
        while len(x) < scenes:
            found = SceneDifferences(x, spread, count, 0)
            m = rule or next_seeds(found, distance, plan.log_bar, scene_cost, scenes, 5)
            new = values[len(x) : len(x) + LOOK_EVERY, :m]
            x, count = np.append(x, new.mean(axis=1)), np.append(count, np.full(len(new), float(m)))
            spread = np.append(
                spread, new.var(axis=1, ddof=1) if m > 1 else np.full(len(new), np.nan)
            )
            good, bad = logs(case, independent(x, -math.inf, math.inf), plan)
            if max(good[-LOOK_EVERY:].max(), bad[-LOOK_EVERY:].max()) >= plan.log_bar:
                break
        costs.append(float(count.sum() + scene_cost * len(count)))
        chosen.append(float(count.mean()))
    return float(np.mean(costs)), float(np.mean(chosen))
