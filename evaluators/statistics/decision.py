"""Sequential decisions: whether one variant is worse than another, after any number of scenes.

After every scene the state follows from the differences so far and their order alone. Each metric
has an e-process by betting for each of its two answers (`evaluators.statistics.betting`).

The average of e-processes is an e-process however they depend on each other, so the hypothesis that
none of a set of metrics is worse is refuted where the average over the set reaches 1 / alpha.
Metric i is worse if every set that holds it is refuted (closed testing; Vovk and Wang, E-values:
calibration, combination and applications, Annals of Statistics 49, 2021). This refutes whatever
Bonferroni does. All metrics are non-inferior if each is (intersection-union test).

``decision.json`` keeps the question, every interim analysis and the answer.
"""

from __future__ import annotations

import math
import os
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from typing_extensions import TypedDict

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.files import read_json_as
from alpasim_plugin.core.metric_types import RATE_MARGIN
from alpasim_plugin.core.types import F64, I64, Bool, MetricInfo
from alpasim_plugin.log.run_folder.schema import DECISION
from alpasim_plugin.log.run_folder.sides import Side
from evaluators.metrics import METRICS
from evaluators.results import Cause, Outcome
from evaluators.statistics.betting import (
    Draws,
    Plan,
    bet_sizes,
    log_capital,
    lower_bound,
)
from evaluators.statistics.differences import beyond_words, claim_of, is_cut, reach_of
from evaluators.statistics.paired import Pairs

Answer = Literal["good", "bad", "open"]

SCHEMA_VERSION = 4
MOST_SCENES = 4000  # that are asked for
AGAIN = "give the command of the run again: finished rollouts are kept"
WORDS: dict[Answer, str] = {"good": "non-inferior", "bad": "worse", "open": "undecided"}
CAUSES: dict[str, Cause] = {"non-inferior": "pass", "worse": "regression", "undecided": "undecided"}


@dataclass(frozen=True)
class MetricQuestion:
    """The question about one metric: is it at most ``margin`` worse?

    Attributes:
        facts: The metric.
        margin: How much worse is accepted, in the metric's unit.
        binding: The decision waits for this metric; otherwise the metric counts only if it is shown
            to be worse.
    """

    facts: MetricInfo
    margin: float
    binding: bool = True

    @property
    def metric(self) -> str:
        """Give the metric's name."""
        return self.facts.name

    @property
    def reach(self) -> float:
        """Give the greatest difference of a scene that counts."""
        return reach_of(self.facts, self.margin)

    @property
    def claim(self) -> str:
        """Give what the answer is about, in words."""
        claim = claim_of(self.facts, self.margin)
        if claim is None:
            raise EvaluatorError(f"{self.metric}: no claim", "give a margin")
        return claim

    @property
    def words(self) -> str:
        """Name the metric, with what the answer is about where that is not its mean."""
        return f"{self.metric} ({self.claim})" if is_cut(self.facts) else self.metric


@dataclass(frozen=True)
class Question:
    """Everything that is to be decided, and how sure.

    Attributes:
        metrics: One or several.
        alpha: Probability that the decision is wrong, over all interim analyses.
    """

    metrics: tuple[MetricQuestion, ...]
    alpha: float = 0.05

    @property
    def rule(self) -> str:
        """Say how several metrics are joined."""
        bar = f"{1 / self.alpha:g}"
        if len(self.metrics) == 1:
            return f"one metric; each answer is given at an e-value of {bar}"
        n_binding = sum(question.binding for question in self.metrics)
        return (
            f"non-inferior if all {n_binding} binding metrics are, each at an e-value of {bar} "
            f"(intersection-union test: no correction); worse if any of {len(self.metrics)} "
            "metrics is, by closed testing with averages of e-values"
        )


def metric_question(
    metric: str, margin: float | None = None, binding: bool = True
) -> MetricQuestion:
    """Make the question about one metric.

    Args:
        metric: Its name.
        margin: In its unit; None: the metric's own.
        binding: As in `MetricQuestion`.

    Raises:
        InputError: A negative margin, or one of 0 where the metric has no better side or where
            nothing else bounds how much a scene can differ.
    """
    facts = METRICS.info(metric)
    accepted = facts.accepted if margin is None else margin
    if accepted < 0.0 or not math.isfinite(accepted):
        raise InputError(
            f"--metric {metric}={accepted:g}: the margin must be >= 0.", "Give for example 0.05."
        )
    question = MetricQuestion(facts, accepted, binding)
    if accepted == 0.0 and facts.direction == "none":
        raise InputError(
            f"--metric {metric}: the metric has no better side and the margin is 0.",
            "Give a margin: the change to either side that is accepted.",
        )
    if question.reach == 0.0:
        raise InputError(
            f"--metric {metric}: nothing bounds how much a scene can differ.", "Give a margin."
        )
    return question


def scene_harm(candidate: Side, baseline: Side, metric: MetricInfo, scenes: Sequence[str]) -> F64:
    """Return the mean difference ``(n,)`` of each scene named, positive is worse; without a better
    side as it is.

    A scene with a rollout that lacks its pair has no difference, NaN: which pairs are lost may
    depend on how the rollout went.

    Args:
        candidate: Rollouts of the variant in question, of one policy.
        baseline: Those of the variant that it is compared with.
        metric: What is compared.
        scenes: In the order in which they were drawn.
    """
    pairs = Pairs(candidate, baseline, metric.name)
    diff = (
        pairs.base_values - pairs.values
        if metric.direction == "higher"
        else pairs.values - pairs.base_values
    )
    of_scene: dict[str, list[float]] = {scene: [] for scene in scenes}
    for (_, scene, _), value in zip(candidate.cells, diff.tolist(), strict=True):
        of_scene[scene].append(value)
    for i in pairs.only_base.tolist():
        of_scene[baseline.cells[i][1]].append(math.nan)
    return np.array([np.mean(of_scene[scene] or [math.nan]) for scene in scenes])


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
    top = np.maximum(np.max(log_e, axis=0), 0.0)
    scale = np.where(np.isfinite(top), top, 0.0)
    e = np.exp(np.minimum(log_e - scale, 700.0))  # scaled by the largest, so that none overflows
    ordered = np.sort(e, axis=0)
    sums = np.cumsum(ordered, axis=0)
    least = e.copy()
    for size in range(2, len(log_e) + 1):
        # i with the size - 1 smallest others: if i is among the smallest, the size smallest of all.
        is_among = e <= ordered[size - 2]
        total = np.where(is_among, sums[size - 1], e + sums[size - 2])
        least = np.minimum(least, total / size)
    with np.errstate(divide="ignore"):
        return np.log(least) + scale


class BeyondLook(TypedDict):
    """A `evaluators.results.Beyond`."""

    event: str
    n: int
    n_scenes: int
    at_most: float


class MetricLook(TypedDict):
    """What is known of one metric after the scenes of an interim analysis."""

    verdict: str  # non-inferior, worse or undecided
    n_scenes: int  # with a difference
    diff: float | None  # mean, in the metric's own sign; None without scenes
    # bounds in the metric's own sign: each is wrong in at most a share alpha of runs, over all
    # interim analyses; None: no bound yet
    interval: list[float | None]
    e_good: float  # greatest e-value so far against what the good answer denies
    e_bad: float  # the same for the bad answer, adjusted for several metrics
    # scenes of which only the cap counts; its ``at_most`` holds over all interim analyses, wrong in a
    # share alpha of runs; None where nothing is cut, or before the first scene
    beyond: BeyondLook | None


@dataclass(frozen=True)
class State:
    """What is known after n scenes.

    Attributes:
        n_scenes: Scenes driven.
        answer: Over all metrics.
        metrics: By name, in the order of the question.
    """

    n_scenes: int
    answer: Answer
    metrics: Mapping[str, MetricLook]


def state_after(question: Question, values: Mapping[str, F64], horizon: int) -> State:
    """Return the state after the scenes so far, however many interim analyses came before.

    Args:
        question: What is to be decided.
        values: METRIC -> ``(n,)`` differences in the order drawn, positive is worse; NaN where a
            scene has none.
        horizon: Most scenes that can be driven: the ceiling that bets are made for.
    """
    n = len(next(iter(values.values())))
    evidence = [
        _Evidence.of(
            criterion,
            values[criterion.metric],
            Plan(criterion.margin or None, horizon, question.alpha),
        )
        for criterion in question.metrics
    ]
    paths = [one_metric.paths(len(question.metrics), n) for one_metric in evidence]
    log_good = np.maximum.accumulate(np.array([good for good, _ in paths]), axis=1)
    log_bad = np.maximum.accumulate(closed(np.array([bad for _, bad in paths])), axis=1)
    bar = -math.log(question.alpha)
    is_good: Bool = log_good >= bar
    is_bad: Bool = log_bad >= bar
    binding = [criterion.binding for criterion in question.metrics]
    all_good = is_good[binding].all(axis=0) & any(binding)
    answer = _first(np.asarray(all_good), np.asarray(is_bad.any(axis=0)))
    states: dict[str, MetricLook] = {}
    for i, (criterion, metric_evidence) in enumerate(zip(question.metrics, evidence, strict=True)):
        x = values[criterion.metric]
        center = float(np.nanmean(x)) if np.isfinite(x).any() else None
        low, high = metric_evidence.interval()
        if criterion.facts.direction == "higher":
            center, low, high = (None if end is None else -end for end in (center, high, low))
        e_good, e_bad = (
            float(np.exp(min(path[i, -1], 700.0))) if n else 0.0 for path in (log_good, log_bad)
        )
        states[criterion.metric] = {
            "verdict": WORDS[_first(is_good[i], is_bad[i])],
            "n_scenes": metric_evidence.draws.n,
            "diff": center,
            "interval": [low, high],
            "e_good": e_good,
            "e_bad": e_bad,
            "beyond": metric_evidence.beyond(),
        }
    return State(n, answer, states)


def least_scenes(question: Question, most: int = MOST_SCENES) -> int | None:
    """Return how many scenes without a single difference give the good answer; None where ``most``
    do not.
    """

    def is_good(n: int) -> bool:
        values = {criterion.metric: np.zeros(n) for criterion in question.metrics}
        return state_after(question, values, n).answer == "good"

    upper = 1
    while not is_good(upper):
        if upper == most:
            return None
        upper = min(2 * upper, most)
    numbers = range(1, upper + 1)
    return numbers[bisect_left(numbers, True, key=is_good)]


@dataclass(frozen=True)
class _Evidence:
    """The evidence on one metric.

    Attributes:
        question: What is asked about it.
        draws: The differences that are known.
        is_beyond: ``(k,)`` of them, those that are worse than what counts.
        places: ``(k,)`` scenes to which they belong.
        plan: Of the bets.
    """

    question: MetricQuestion
    draws: Draws
    is_beyond: Bool
    places: I64
    plan: Plan

    @classmethod
    def of(cls, question: MetricQuestion, x: F64, plan: Plan) -> _Evidence:
        places = np.flatnonzero(np.isfinite(x))
        reach = question.reach
        harms = np.abs(x[places]) if question.facts.direction == "none" else x[places]
        draws = Draws(np.clip(x[places], -reach, reach), reach)
        return cls(question, draws, harms > reach, places, plan)

    def paths(self, sharing: int, n: int) -> tuple[F64, F64]:
        """Return the log e-processes for the good and for the bad answer after each of n scenes.

        Args:
            sharing: Metrics of which one is enough for the bad answer: its evidence is averaged
                over them.
            n: Scenes.
        """
        margin = self.question.margin
        mirror = self.draws.mirrored()
        if self.question.facts.direction == "none":
            # A change to either side counts: the size is within the margin if both ends are, and
            # beyond it if either is.
            below = np.maximum.accumulate(self._above(mirror, -margin))
            above = np.maximum.accumulate(self._above(self.draws, -margin))
            good = np.minimum(below, above)
            beyond = self._above(self.draws, margin, 2 * sharing)
            bad = np.logaddexp(beyond, self._above(mirror, margin, 2 * sharing)) - math.log(2.0)
        else:
            good = self._above(mirror, -margin)
            bad = self._above(self.draws, margin, sharing)
        return self._over_scenes(good, n), self._over_scenes(bad, n)

    def _above(self, draws: Draws, mean: float, sharing: int = 1) -> F64:
        """Return the log e-process against "the mean is at most ``mean``", aimed at ``sharing`` /
        alpha.
        """
        plan = Plan(self.plan.distance, self.plan.horizon, self.plan.alpha / sharing)
        return log_capital(draws, mean, bet_sizes(draws, mean, plan))

    def _over_scenes(self, path: F64, n: int) -> F64:
        """Spread a path over n scenes: it stays between the scenes that it knows, and is -inf
        (nothing said) before the first.
        """
        count = np.searchsorted(self.places, np.arange(n), side="right")
        return np.append(-np.inf, path)[count]

    def interval(self) -> tuple[float | None, float | None]:
        """Return the bounds of the mean, positive is worse."""
        if self.draws.n == 0:
            return None, None
        return self._bound(self.draws, 1.0), -self._bound(self.draws.mirrored(), -1.0)

    def beyond(self) -> BeyondLook | None:
        """Count the scenes that are worse than what counts, with a bound of their rate that holds at
        whatever scene one stops.
        """
        metric = self.question.facts
        if self.draws.n == 0 or not is_cut(metric):
            return None
        events = Draws(-self.is_beyond.astype(np.float64), 1.0)
        sizes = bet_sizes(events, -RATE_MARGIN, replace(self.plan, distance=RATE_MARGIN))
        at_most = -float(lower_bound(events, sizes, self.plan.log_bar))
        event = beyond_words(metric, self.question.margin)
        return {
            "event": event,
            "n": int(np.sum(self.is_beyond)),
            "n_scenes": self.draws.n,
            "at_most": at_most,
        }

    def _bound(self, draws: Draws, sign: float) -> float:
        sizes = bet_sizes(draws, sign * self.question.margin, self.plan)
        return float(lower_bound(draws, sizes, self.plan.log_bar))


def _first(good: Bool, bad: Bool) -> Answer:
    """Return which answer was given first; the bad one of two at once."""
    when_good = int(np.argmax(good)) if good.any() else len(good)
    when_bad = int(np.argmax(bad)) if bad.any() else len(bad)
    if when_good == when_bad == len(good):
        return "open"
    return "good" if when_good < when_bad else "bad"


def outcome_of(question: Question, state: State, ceiling: str) -> Outcome:
    """Return the outcome of a decision, with one sentence a metric.

    Args:
        question: What was asked.
        state: At the end.
        ceiling: Why no more scenes are driven, for an undecided end.
    """
    if state.answer == "good":
        return Outcome("pass")
    if state.answer == "bad":
        worse = [
            criterion.words
            for criterion in question.metrics
            if state.metrics[criterion.metric]["verdict"] == WORDS["bad"]
        ]
        return Outcome("regression", tuple(f"{words} is worse" for words in worse))
    left = [
        criterion.words
        for criterion in question.metrics
        if criterion.binding and state.metrics[criterion.metric]["verdict"] == WORDS["open"]
    ]
    return Outcome("undecided", (f"{', '.join(left) or 'nothing'} undecided: {ceiling}",))


class MetricAsked(TypedDict):
    """One metric of the question."""

    margin: float  # in the metric's unit
    claim: str  # what the answer is about
    binding: bool


class AskedRecord(TypedDict):
    """The question."""

    alpha: float  # probability of a wrong decision over all interim analyses
    rule: str  # how several metrics are joined
    metrics: dict[str, MetricAsked]


class Look(TypedDict):
    """One interim analysis."""

    n_scenes: int
    rollouts: int
    answer: str  # good, bad or open
    metrics: dict[str, MetricLook]


class Decision(TypedDict):
    """The file ``decision.json``."""

    schema_version: int
    question: AskedRecord
    candidate: str
    baseline: str
    policy: str
    order_seed: int
    look_every: int
    ceiling: dict[str, int]  # scenes, rollouts
    order: list[str]  # scenes driven, in their order
    looks: list[Look]
    verdict: str
    stopped: str  # why no more scenes are driven; empty while the run goes on
    outcome: dict[str, Any]
    rollouts: int


def question_as_dict(question: Question) -> AskedRecord:
    """Return a question for JSON."""
    return {
        "alpha": question.alpha,
        "rule": question.rule,
        "metrics": {
            criterion.metric: {
                "margin": criterion.margin,
                "claim": criterion.claim,
                "binding": criterion.binding,
            }
            for criterion in question.metrics
        },
    }


def read_decision(root: Path) -> Decision | None:
    """Read ``decision.json`` of a run folder; None where the run was no decision.

    Raises:
        InputError: It is damaged.
    """
    path = root / DECISION
    if not os.path.exists(path):
        return None
    return read_json_as(Decision, path, do_this=AGAIN)


def stopping_note(root: Path) -> str | None:
    """Say that the intervals of a fixed number of scenes do not hold for a run that stopped when it
    was decided; None of any other run.
    """
    if read_decision(root) is None:
        return None
    return (
        f"note: {root} was driven until it was decided: only the intervals of {DECISION} and of "
        "the report's first section hold for it"
    )
