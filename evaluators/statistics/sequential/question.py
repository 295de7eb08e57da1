"""What is to be decided (metrics, margins, how sure), and ``decision.json``: the question, every
look and the answer of such a run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NotRequired

from typing_extensions import TypedDict

from alpasim_plugin.core.checksums import read_sealed, write_sealed
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading.files import as_shape
from alpasim_plugin.core.types import Direction, MetricInfo
from evaluators.metrics import METRICS
from evaluators.statistics.sequential.asymptotic import FIRST_LOOK

Asked = Literal["non-inferior", "better"]
Method = Literal["betting", "asymptotic", "obrien-fleming", "pocock"]
Population = Literal["scenes", "suite"]
Order = Literal["random", "stratified"]

DOING = "asking a question"
OPPOSITE: dict[str, str] = {"non-inferior": "worse", "better": "not better"}
METHOD_NAMES: dict[str, str] = {
    "betting": "betting, holds for every number of scenes",
    "asymptotic": "asymptotic: approximate, as a t interval is",
    "obrien-fleming": "five looks, alpha spent as by O'Brien and Fleming: approximate, and wrong where few scenes are far worse",
    "pocock": "five looks, alpha spent as by Pocock: approximate, and wrong where few scenes are far worse",
}


@dataclass(frozen=True)
class MetricQuestion:
    """The question about one metric.

    Attributes:
        facts: The metric.
        margin: How much worse is accepted, or how much better is wanted, in the metric's unit.
        asked: ``non-inferior``: is the difference at most ``margin`` worse; ``better``: is it at
            least ``margin`` better.
        expected: Expected difference, positive is worse; None: see `distance`.
        binding: The decision waits for this metric; otherwise the metric counts only if it is shown
            to be worse.
        method: How its e-process is made.
    """

    facts: MetricInfo
    margin: float
    asked: Asked
    expected: float | None
    binding: bool
    method: Method

    @property
    def metric(self) -> str:
        """Give the metric's name."""
        return self.facts.name

    @property
    def direction(self) -> Direction:
        """Give the better side."""
        return self.facts.direction

    @property
    def threshold(self) -> float:
        """Give the difference at which the answer changes, positive is worse."""
        return self.margin if self.asked == "non-inferior" else -self.margin

    @property
    def distance(self) -> float | None:
        """Give how far from the threshold the difference is expected; without an expectation no
        difference (or twice the wanted one).
        """
        if self.expected is not None:
            return abs(self.expected - self.threshold) or None
        return self.margin or None

    @property
    def harm_bounds(self) -> tuple[float, float]:
        """Give the least and the greatest possible difference, positive is worse."""
        low, high = self.facts.difference_range
        return (-high, -low) if self.direction == "higher" else (low, high)


@dataclass(frozen=True)
class Question:
    """Everything that is to be decided, and how sure.

    Attributes:
        metrics: One or several.
        alpha: Chance that the decision is wrong, over all looks.
        population: ``scenes``: scenes are draws from a population, and its mean is asked for;
            ``suite``: the mean over this suite's scenes.
        first_look: Scenes before the first look of asymptotic metrics.
        min_scenes: Scenes before any decision.
    """

    metrics: tuple[MetricQuestion, ...]
    alpha: float = 0.05
    population: Population = "scenes"
    first_look: int = FIRST_LOOK
    min_scenes: int = 2

    @property
    def rule(self) -> str:
        """Say how several metrics are joined."""
        k, binding = len(self.metrics), sum(one.binding for one in self.metrics)
        if k == 1:
            return f"one metric; each answer is given at an e-value of {1 / self.alpha:g}"
        good, bad = self.metrics[0].asked, OPPOSITE[self.metrics[0].asked]
        return (
            f"{good} if all {binding} binding metrics are, each at an e-value of {1 / self.alpha:g} (intersection-union test: no "
            f"correction); {bad} if any of {k} metrics is, by closed testing with averages of e-values"
        )


def metric_question(
    metric: str,
    margin: float | None,
    asked: Asked,
    expected: float | None = None,
    binding: bool = True,
    method: Method | None = None,
) -> MetricQuestion:
    """Make the question about one metric.

    Args:
        metric: Its name.
        margin: In its unit; None: the metric's own for ``non-inferior``, 0 for ``better``.
        asked: As in `MetricQuestion`.
        expected: Expected difference, candidate minus baseline in the metric's own sign.
        binding: As in `MetricQuestion`.
        method: None: betting where differences are bounded, else asymptotic.

    Raises:
        InputError: A negative margin, a metric without a better side for which none is possible, or
            betting on unbounded differences.
    """
    facts = METRICS.info(metric)
    direction = facts.direction
    chosen = margin if margin is not None else facts.accepted if asked == "non-inferior" else 0.0
    if chosen < 0.0 or not math.isfinite(chosen):
        raise InputError(
            f"margin {chosen:g} for {metric}: not a number from 0 up",
            "give how much worse is accepted, as 0.05",
        )
    if direction == "none" and (asked == "better" or chosen == 0.0):
        found = (
            "it has no better side"
            if asked == "better"
            else "it has no better side and a margin of 0"
        )
        raise InputError(
            f"{metric}: {found}",
            "ask whether it is non-inferior, with a margin: the change to either side that is accepted",
        )
    low, high = facts.difference_range
    bounded = math.isfinite(low) and math.isfinite(high)
    if method == "betting" and not bounded:
        raise InputError(
            f"--method betting for {metric}: its differences have no bounds",
            "leave --method out",
        )
    sign = -1.0 if direction == "higher" else 1.0
    harm = None if expected is None else sign * expected
    return MetricQuestion(
        facts, chosen, asked, harm, binding, method or ("betting" if bounded else "asymptotic")
    )


DECISION = "decision.json"
SCHEMA_VERSION = 1
DOING = "reading a decision"
AGAIN = "give the command of the run again: finished rollouts are kept"


class MetricAsked(TypedDict):
    """One metric of the question."""

    margin: float  # in the metric's unit
    threshold: float  # difference at which the answer changes, positive is worse
    expected: float | None  # expected difference, positive is worse
    binding: bool
    method: str  # betting or asymptotic
    guarantee: str


class AskedRecord(TypedDict):
    """The question."""

    asked: str  # non-inferior or better
    population: str  # scenes or suite
    alpha: float  # chance of a wrong decision over all looks
    rule: str  # how several metrics are joined
    min_scenes: int
    first_look: int
    metrics: dict[str, MetricAsked]


class MetricLook(TypedDict):
    """One metric at one look."""

    verdict: str
    n_scenes: int
    diff: float | None
    interval: list[float | None]  # each end holds over all looks with probability 1 - alpha
    e_good: float
    e_bad: float


class Look(TypedDict):
    """One look."""

    n_scenes: int
    rollouts: int
    seeds: int  # of the scenes driven since the look before
    answer: str  # good, bad or open
    metrics: dict[str, MetricLook]


class Decision(TypedDict):
    """The file."""

    schema_version: int
    question: AskedRecord
    candidate: str
    baseline: str
    policy: str
    order_seed: int
    look_every: int
    ceiling: dict[str, int]  # scenes, rollouts
    seeds: dict[str, Any]  # how many a scene and why
    controls: dict[str, Any]  # what takes out variance, by metric
    drawn: NotRequired[
        dict[str, Any]
    ]  # order: random (where absent) or stratified, then the number of scenes of each family
    order: list[str]  # scenes driven, in their order
    looks: list[Look]
    verdict: str
    stopped: str  # why no more scenes are driven; empty while the run goes on
    outcome: dict[str, Any]
    rollouts: int


def question_as_dict(question: Question) -> AskedRecord:
    """Return a question for JSON."""
    return {
        "asked": question.metrics[0].asked,
        "population": question.population,
        "alpha": question.alpha,
        "rule": question.rule,
        "min_scenes": question.min_scenes,
        "first_look": question.first_look,
        "metrics": {
            one.metric: {
                "margin": one.margin,
                "threshold": one.threshold,
                "expected": one.expected,
                "binding": one.binding,
                "method": one.method,
                "guarantee": METHOD_NAMES[one.method],
            }
            for one in question.metrics
        },
    }


def write_decision(root: Path, decision: Decision) -> None:
    """Write ``decision.json`` with its seal.

    Raises:
        InfrastructureError: The disk refuses.
    """
    write_sealed(root / DECISION, decision)


def stopping_note(root: Path) -> str | None:
    """Say that the intervals of a fixed number of scenes do not hold for a run that stopped when it
    was decided; None of any other run.
    """
    if read_decision(root) is None:
        return None
    return f"note: {root} was driven until it was decided: only the intervals of {DECISION} and of the report's first section hold for it"


def read_decision(root: Path) -> Decision | None:
    """Read ``decision.json`` of a run folder; None where the run was no decision.

    Raises:
        InputError: It is damaged.
    """
    path = root / DECISION
    if not path.exists():
        return None
    found, _ = read_sealed(path, AGAIN)
    shaped: Mapping[str, Any] = as_shape(Decision, found, path, AGAIN)
    return shaped  # type: ignore[return-value]
