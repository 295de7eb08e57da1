"""The state of a decision after any number of scenes: e-values, intervals, answers; several metrics
by closed testing.

The average of e-processes is an e-process however they depend on each other, so the hypothesis that
none of a set of metrics is worse is refuted where the average over the set reaches 1 / alpha.
Metric i is worse if every set that holds it is refuted (closed testing; Vovk and Wang, E-values:
calibration, combination and applications, Annals of Statistics 49, 2021). This refutes whatever
Bonferroni does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from alpasim_plugin.core.types import F64, I64, Bool
from evaluators.statistics.paired import reach_of
from evaluators.statistics.sequential import asymptotic, betting, group
from evaluators.statistics.sequential.draws import Draws, independent
from evaluators.statistics.sequential.line import Plan
from evaluators.statistics.sequential.question import (
    OPPOSITE,
    Look,
    MetricLook,
    MetricQuestion,
    Question,
)
from evaluators.statistics.verdicts import Cause, Outcome


def closed(log_e: F64) -> F64:
    """Return the log of the adjusted e-values ``(k, ...)``: for each metric the least average over
    all sets that hold it.

    The least average of i and any others takes the smallest others, so prefixes of the sorted
    values are enough.

    Args:
        log_e: ``(k, ...)`` log e-values of k metrics.

    Example:
        >>> [round(float(e), 3) for e in np.exp(closed(np.log([60.0, 1.0])))]
        [30.5, 1.0]
    """
    k = len(log_e)
    top = np.maximum(np.max(log_e, axis=0), 0.0)
    finite = np.where(np.isfinite(top), top, 0.0)
    e = np.exp(
        np.minimum(log_e - finite, 700.0)
    )  # scaled by the largest; what is infinite stays far above any bar
    order = np.sort(e, axis=0)
    sums = np.cumsum(order, axis=0)
    least = e.copy()
    for size in range(2, k + 1):
        # i with the size - 1 smallest others: if i is among the smallest, the size smallest of all.
        rank_in = e <= order[size - 2]
        with_others = np.where(rank_in, sums[size - 1], e + sums[size - 2])
        least = np.minimum(least, with_others / size)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(least) + finite)


Answer = Literal["good", "bad", "open"]


@dataclass(frozen=True)
class MetricState:
    """What is known of one metric after n scenes.

    Attributes:
        metric: Its name.
        answer: In the words of the question, or ``undecided``.
        n_scenes: Scenes with a difference.
        diff: Mean difference in the metric's own sign; None without scenes.
        interval: Bounds in the metric's own sign; each is wrong in at most a share alpha of runs,
            over all looks. None: no bound yet.
        e_good: Greatest e-value so far against what the good answer denies.
        e_bad: The same for the bad answer, adjusted for several metrics.
    """

    metric: str
    answer: str
    n_scenes: int
    diff: float | None
    interval: tuple[float | None, float | None]
    e_good: float
    e_bad: float


@dataclass(frozen=True)
class State:
    """What is known after n scenes.

    Attributes:
        n_scenes: Scenes driven.
        answer: Over all metrics.
        metrics: One each, in the order of the question.
    """

    n_scenes: int
    answer: Answer
    metrics: tuple[MetricState, ...]


def state_after(
    question: Question,
    values: Mapping[str, F64],
    horizon: int,
    adjusted: Mapping[str, Draws] | None = None,
    size: int | None = None,
) -> State:
    """Return the state after the scenes so far; it depends on their order, and not on how often one
    looked before.

    Args:
        question: What is to be decided.
        values: METRIC -> ``(n,)`` differences in the order drawn, positive is worse; NaN where a
            scene has none.
        horizon: Most scenes that can be driven: the ceiling that bets are made for.
        adjusted: METRIC -> the draws where they are not simply ``values``: without replacement, or
            with a control. Without NaN.
        size: Scenes of the suite; None: all can be driven.
    """
    n = len(next(iter(values.values())))
    good = []
    bad = []
    seen = []
    for one in question.metrics:
        x = values[one.metric]
        known = np.flatnonzero(np.isfinite(x))
        draws = (adjusted or {}).get(one.metric) or independent(x[known], *one.harm_bounds)
        is_whole = question.population == "suite" and n == (size or horizon) and len(known) == n
        plan = Plan(one.distance, horizon, question.alpha)
        guard = _guard(one, x[known], draws)
        seen.append(
            _Seen(
                one,
                draws,
                plan,
                len(question.metrics),
                question.first_look,
                x if is_whole else None,
                guard,
            )
        )
        paths = seen[-1].paths() if len(known) else (np.empty(0), np.empty(0))
        good.append(_hold(paths[0], known, n))
        bad.append(_hold(paths[1], known, n))
    bar = -np.log(question.alpha)
    ever_good = np.maximum.accumulate(np.array(good), axis=1)
    ever_bad = np.maximum.accumulate(closed(np.array(bad)), axis=1)
    is_good, is_bad = ever_good >= bar, ever_bad >= bar
    binding = np.array([one.binding for one in question.metrics])
    all_good = is_good[binding].all(axis=0) if binding.any() else np.zeros(n, dtype=bool)
    answer = _first(all_good, is_bad.any(axis=0)) if n >= question.min_scenes else "open"
    states = []
    for i, (one, mine) in enumerate(zip(question.metrics, seen, strict=True)):
        words = {"good": one.asked, "bad": OPPOSITE[one.asked], "open": "undecided"}
        x = values[one.metric]
        centre = float(np.nanmean(x)) if np.isfinite(x).any() else None
        low, high = mine.interval() if mine.draws.n else (None, None)
        if one.direction == "higher":
            centre, low, high = (None if v is None else -v for v in (centre, high, low))
        e_good, e_bad = (
            float(np.exp(min(path[i, -1], 700.0))) if n else 0.0 for path in (ever_good, ever_bad)
        )
        states.append(
            MetricState(
                one.metric,
                words[_first(is_good[i], is_bad[i])],
                mine.draws.n,
                centre,
                (low, high),
                e_good,
                e_bad,
            )
        )
    return State(n, answer, tuple(states))


def look_as_dict(state: State, rollouts: int, seeds: int) -> Look:
    """Return a look for ``decision.json``."""
    metrics: dict[str, MetricLook] = {
        one.metric: {
            "verdict": one.answer,
            "n_scenes": one.n_scenes,
            "diff": one.diff,
            "interval": list(one.interval),
            "e_good": one.e_good,
            "e_bad": one.e_bad,
        }
        for one in state.metrics
    }
    return {
        "n_scenes": state.n_scenes,
        "rollouts": rollouts,
        "seeds": seeds,
        "answer": state.answer,
        "metrics": metrics,
    }


def outcome_of(question: Question, state: State, ceiling: str) -> Outcome:
    """Return the outcome of a decision, with one sentence a metric.

    Args:
        question: What was asked.
        state: At the end.
        ceiling: Why no more scenes are driven, for an undecided end.
    """
    cause: Cause = {"good": "pass", "bad": "regression", "open": "undecided"}[state.answer]  # type: ignore[assignment]
    bad = OPPOSITE[question.metrics[0].asked]
    if cause == "regression":
        named = [one.metric for one in state.metrics if one.answer == bad]
        return Outcome(cause, tuple(f"{name} is {bad}" for name in named))
    if cause == "undecided":
        left = [
            one.metric
            for one, q in zip(state.metrics, question.metrics, strict=True)
            if q.binding and one.answer == "undecided"
        ]
        return Outcome(cause, (f"{', '.join(left) or 'nothing'} undecided: {ceiling}",))
    return Outcome(cause)


@dataclass(frozen=True)
class _Seen:
    """The draws of one metric, and what follows from them."""

    question: MetricQuestion
    draws: Draws
    plan: Plan
    sharing: (
        int  # metrics of which one is enough for the bad answer: its evidence is averaged over them
    )
    first_look: int
    whole: F64 | None = (
        None  # the differences of a suite all of whose scenes are driven: its mean is known
    )
    guard: Draws | None = (
        None  # the differences cut to `reach_of`: an answer must hold for these by betting too
    )

    def paths(self) -> tuple[F64, F64]:
        """Return the log e-processes ``(n,)`` for the good and for the bad answer."""
        good, bad = self._estimated()
        if self.whole is not None:
            mean = float(self.whole.mean())
            is_good = (
                abs(mean) if self.question.direction == "none" else mean
            ) <= self.question.threshold
            good[-1], bad[-1] = (np.inf, bad[-1]) if is_good else (good[-1], np.inf)
        return good, bad

    def _estimated(self) -> tuple[F64, F64]:
        at, mirror = self.question.threshold, self.draws.mirrored()
        if self.question.direction != "none":
            return self._guarded(mirror, -at), self._guarded(self.draws, at, self.sharing)
        # A change to either side counts: the size is within the margin if both ends are, and beyond
        # it if either is.
        below, low_above = self._guarded(mirror, -at), self._guarded(self.draws, -at)
        above, low_below = (
            self._guarded(self.draws, at, 2 * self.sharing),
            self._guarded(mirror, at, 2 * self.sharing),
        )
        good = np.minimum(np.maximum.accumulate(below), np.maximum.accumulate(low_above))
        return good, np.logaddexp(above, low_below) - np.log(2.0)

    def interval(self) -> tuple[float | None, float | None]:
        if self.whole is not None:
            return float(self.whole.mean()), float(self.whole.mean())
        low, high = self._bound(self.draws, 1.0), self._bound(self.draws.mirrored(), -1.0)
        return low, None if high is None else -high

    def _guarded(self, draws: Draws, mean: float, sharing: int = 1) -> F64:
        """Return what `_above` gives where it holds for scenes that were not drawn too."""
        path = self._above(draws, mean, sharing)
        if self.guard is None:
            return path
        cut = self.guard if draws is self.draws else self.guard.mirrored()
        plan = replace(self.plan, alpha=self.plan.alpha / sharing)
        bets = betting.log_capital(cut, mean, betting.bet_sizes(cut, mean, plan))
        return np.minimum(np.maximum.accumulate(path), np.maximum.accumulate(bets))

    def _above(self, draws: Draws, mean: float, sharing: int) -> F64:
        """Return the log e-process against "the mean is at most ``mean``", aimed at ``sharing`` /
        alpha.
        """
        plan = replace(self.plan, alpha=self.plan.alpha / sharing)
        if self.question.method == "asymptotic":
            return asymptotic.log_evidence(draws, mean, plan, self.first_look)
        if self.question.method != "betting":
            return group.log_evidence(draws, mean, plan, self.question.method)
        return betting.log_capital(draws, mean, betting.bet_sizes(draws, mean, plan))

    def _bound(self, draws: Draws, sign: float) -> float | None:
        if self.question.method != "betting":
            if self.question.method == "asymptotic":
                found = float(asymptotic.lower_bound(draws, self.plan, self.first_look))
            else:
                found = group.lower_bound(draws, self.plan, self.question.method)
            return found if np.isfinite(found) else None
        least, most = sorted(sign * bound for bound in self.question.harm_bounds)
        sizes = betting.bet_sizes(draws, sign * self.question.threshold, self.plan)
        return float(betting.lower_bound(draws, sizes, self.plan.log_bar, least, most))


def _guard(asked: MetricQuestion, x: F64, draws: Draws) -> Draws | None:
    """Return the differences cut to how much worse a scene can be, where nothing else bounds them:
    scenes that look alike hide no tail.

    As for the verdicts of `compare`. Only for independent scenes; of a suite whose scenes run out,
    the mean becomes known.
    """
    reach = reach_of(asked.facts, asked.margin)
    if asked.method != "asymptotic" or not reach or np.any(draws.slope != 1.0):
        return None
    return independent(np.clip(x, -reach, reach), -reach, reach)


def _hold(path: F64, at: I64, n: int) -> F64:
    """Spread a path over all scenes: between the scenes that it knows it stays; -inf (nothing said)
    before the first.
    """
    held = np.full(n, -np.inf)
    count = np.searchsorted(at, np.arange(n), side="right")
    held[count > 0] = path[count[count > 0] - 1]
    return held


def _first(good: Bool, bad: Bool) -> Answer:
    """Return which answer was given first; the bad one of two at once."""
    when_good = int(np.argmax(good)) if good.any() else len(good)
    when_bad = int(np.argmax(bad)) if bad.any() else len(bad)
    if when_good == when_bad == len(good):
        return "open"
    return "good" if when_good < when_bad else "bad"
