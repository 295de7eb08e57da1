"""What is to be decided: metrics, margins, and how sure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Direction, MetricInfo
from evaluators.metrics import METRICS, MetricTable
from evaluators.sequential.asymptotic import FIRST_LOOK

Asked = Literal["non-inferior", "better"]
Method = Literal["betting", "asymptotic"]
Population = Literal["scenes", "suite"]
Order = Literal["random", "stratified"]

DOING = "asking a question"
OPPOSITE: dict[str, str] = {"non-inferior": "worse", "better": "not better"}
METHOD_NAMES: dict[str, str] = {
    "betting": "betting, holds for every number of scenes",
    "asymptotic": "asymptotic: approximate, as a t interval is",
}


@dataclass(frozen=True)
class MetricQuestion:
    """The question about one metric.

    Attributes:
        facts: The metric.
        margin: How much worse is accepted, or how much better is wanted, in the metric's unit.
        asked: ``non-inferior``: is the difference at most ``margin`` worse; ``better``: is it at least ``margin`` better.
        expected: Expected difference, positive is worse; None: see `distance`.
        binding: The decision waits for this metric; otherwise the metric counts only if it is shown to be worse.
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
        """Give how far from the threshold the difference is expected; without an expectation no difference (or twice the wanted one)."""
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
        population: ``scenes``: scenes are draws from a population, and its mean is asked for; ``suite``: the mean over this suite's scenes.
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
    known: MetricTable = METRICS,
) -> MetricQuestion:
    """Make the question about one metric.

    Args:
        metric: Its name.
        margin: In its unit; None: the metric's own for ``non-inferior``, 0 for ``better``.
        asked: As in `MetricQuestion`.
        expected: Expected difference, candidate minus baseline in the metric's own sign.
        binding: As in `MetricQuestion`.
        method: None: betting where differences are bounded, else asymptotic.
        known: The metrics that can be asked about.

    Raises:
        InputError: A negative margin, a metric without a better side for which none is possible, or betting on unbounded differences.
    """
    facts = known.info(metric)
    direction = facts.direction
    chosen = margin if margin is not None else facts.accepted if asked == "non-inferior" else 0.0
    if chosen < 0.0 or not math.isfinite(chosen):
        raise InputError(DOING, f"margin {chosen:g} for {metric}", "not a number from 0 up", "give how much worse is accepted, as 0.05")
    if direction == "none" and (asked == "better" or chosen == 0.0):
        found = "it has no better side" if asked == "better" else "it has no better side and a margin of 0"
        raise InputError(DOING, metric, found, "ask whether it is non-inferior, with a margin: the change to either side that is accepted")
    low, high = facts.difference_range
    bounded = math.isfinite(low) and math.isfinite(high)
    if method == "betting" and not bounded:
        raise InputError(DOING, f"--method betting for {metric}", "its differences have no bounds", "leave --method out")
    sign = -1.0 if direction == "higher" else 1.0
    harm = None if expected is None else sign * expected
    return MetricQuestion(facts, chosen, asked, harm, binding, method or ("betting" if bounded else "asymptotic"))
