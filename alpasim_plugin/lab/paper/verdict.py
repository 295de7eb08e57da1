"""Whether each of the paper's claims holds here: every comparison against its margin, what it could
have shown, and one word for the claim.

A gain is the difference of two arms with its sign such that more is better; m is the metric's
margin.

    better       for: shown above 0 and not shown below m     against: shown below m
    not better   the opposite
    equal        for: shown within -m and m                   against: shown beyond them
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Protocol

import numpy as np
import scipy.special

from alpasim_plugin.lab.paper.claims import (
    CLAIMS,
    DRIFT,
    PER_FRAME,
    PSNR,
    RAW,
    STANDS_IN,
    Claim,
    Comparison,
    margin,
)
from alpasim_plugin.lab.paper.measured import ALPHA, Difference
from alpasim_plugin.lab.video_metrics.facts import KNOWN
from evaluators.statistics.intervals import Interval
from evaluators.statistics.verdicts import holm

Outcome = Literal["for", "against", "open", "not trained", "not measured"]
Verdict = Literal[
    "does not hold", "not measured", "not trained", "no room for a history", "undecided", "holds"
]
VERDICTS: tuple[Verdict, ...] = (
    "does not hold",
    "not measured",
    "not trained",
    "no room for a history",
    "undecided",
    "holds",
)
ORACLE = "oracle history"


class Evidence(Protocol):
    """Measurements of arms under one protocol, new or recorded; see
    `alpasim_plugin.lab.paper.measured.Measured`.
    """

    def has(self, arm: str, metric: str) -> bool:
        """Whether an arm has a metric."""
        ...

    def compares(self, metric: str, first: str, second: str) -> bool:
        """Whether two arms have a paired difference."""
        ...

    def mean(self, arm: str, metric: str) -> Interval:
        """Return an arm's mean."""
        ...

    def difference(self, metric: str, first: str, second: str, share: float = 0.0) -> Difference:
        """Return the paired difference of the first and of what is left of the second without a
        share of it.
        """
        ...

    def margin(self, metric: str, arm: str, bound: float) -> Difference:
        """Return by how much an arm exceeds a bound."""
        ...


@dataclass(frozen=True)
class Result:
    """A comparison with its outcome.

    Args:
        comparison: Which.
        outcome: By its own 95 % interval; ``not trained`` where it is decided and one of the arms
            does not beat the raw render.
        difference: None where it was not measured.
        missing: What was not measured, or what stands in its place.
        power: Chance that the interval of this width decides for the claim: where the truth is the
            margin for ``better``, else no difference. It is a function of the width alone.
        refutes: One-sided p-value that it goes against the claim, corrected by Holm for all
            comparisons of the claim.
    """

    comparison: Comparison
    outcome: Outcome
    difference: Difference | None = None
    missing: str = ""
    power: float | None = None
    refutes: float | None = None


@dataclass(frozen=True)
class Judged:
    """A claim with its verdict and the results of all of its comparisons."""

    claim: Claim
    verdict: Verdict
    results: tuple[Result, ...]
    oracle: Difference | None = (
        None  # what the truth as history would gain, of a claim on histories
    )

    def count(self, outcome: Outcome) -> int:
        """Return how many comparisons came out so."""
        return sum(result.outcome == outcome for result in self.results)

    @property
    def power(self) -> float | None:
        """Chance that the weakest of the measured comparisons decides for the claim; None where
        none was measured.
        """
        return min(
            (result.power for result in self.results if result.power is not None), default=None
        )


class _Gain(NamedTuple):
    centre: float
    low: float
    high: float
    df: float  # of the t distribution; infinite where whole sets were swapped
    # p-value; of whole sets that of the swaps, beyond which their normal distribution is not to be
    # trusted
    least: float = 0.0

    def chance(self, at: float, above: bool) -> float:
        """Return the one-sided p-value that the gain is ``above`` a value, or below it."""
        distance = self.centre - at if above else at - self.centre
        half = self.centre - self.low if above else self.high - self.centre
        if half <= 0.0:
            return float(distance <= 0.0)
        return max(
            float(scipy.special.stdtr(self.df, -distance / half * self.quantile)), self.least
        )

    @property
    def quantile(self) -> float:
        return float(scipy.special.stdtrit(self.df, 1 - ALPHA / 2))

    def power(self, m: float, equal: bool) -> float:
        half = (self.high - self.low) / 2
        if half <= 0.0:
            return 1.0
        once = float(scipy.special.stdtr(self.df, (m / half - 1) * self.quantile))
        return max(2 * once - 1, 0.0) if equal else once


def judge_claims(
    measured: Mapping[str, Evidence], claims: Sequence[Claim] = CLAIMS
) -> tuple[Judged, ...]:
    """Judge every claim.

    Args:
        measured: PROTOCOL -> what was measured under it; a protocol that was not run is not there.
        claims: Those of the paper.

    Returns:
        A verdict each. ``does not hold``: a comparison is decided against it, corrected for their
        number. A claim that needs all of its comparisons needs no correction to hold
        (intersection-union test).
    """
    return tuple(_judged(claim, measured) for claim in claims)


def in_both(first: Verdict, second: Verdict) -> Verdict:
    """Return the verdict on a claim that was judged under two budgets of training: it holds if it
    holds in both, and fails in either.
    """
    return min(first, second, key=VERDICTS.index)


def contest_results(
    comparisons: Sequence[Comparison], measured: Mapping[str, Evidence]
) -> list[Result]:
    """Return every comparison with its outcome, its p-value uncorrected for their number."""
    return [_result(comparison, measured.get(comparison.protocol)) for comparison in comparisons]


def _judged(claim: Claim, measured: Mapping[str, Evidence]) -> Judged:
    found = contest_results(claim.comparisons, measured)
    results = tuple(
        replace(result, refutes=p)
        for result, p in zip(found, holm([r.refutes for r in found]), strict=True)
    )
    oracle = _oracle(claim, measured) if claim.of_history else None
    outcomes = {result.outcome for result in results}
    verdict: Verdict = "undecided"
    if claim.of_history and oracle is None:
        verdict = "not measured"
    elif oracle is not None and oracle.high is not None and oracle.high < margin(PSNR):
        verdict = "no room for a history"
    elif any(
        result.outcome == "against" and (result.refutes or 0.0) <= ALPHA / 2 for result in results
    ):
        verdict = "does not hold"
    elif "not measured" in outcomes:
        verdict = "not measured"
    elif "not trained" in outcomes:
        verdict = "not trained"
    elif outcomes == {"for"}:
        verdict = "holds"
    return Judged(claim, verdict, results, oracle)


def _oracle(claim: Claim, measured: Mapping[str, Evidence]) -> Difference | None:
    """Return what the truth as history would gain: the claim's first arm, or the shipped generator
    where it was measured beside it.
    """
    one = claim.comparisons[0]
    found = measured.get(one.protocol)
    for arm in (one.first, PER_FRAME):
        if found is not None and found.compares(PSNR, f"{arm}, {ORACLE}", arm):
            return found.difference(PSNR, f"{arm}, {ORACLE}", arm)
    return None


def _result(one: Comparison, measured: Evidence | None) -> Result:
    if measured is None:
        return Result(one, "not measured", missing=f"protocol {one.protocol}")
    metric = one.metric
    if not all(measured.has(arm, metric) for arm in one.arms) and all(
        measured.has(arm, STANDS_IN.get(metric, "")) for arm in one.arms
    ):
        metric = STANDS_IN[metric]
    for arm in one.arms:
        if not measured.has(arm, metric):
            return Result(one, "not measured", missing=f"{metric} of {arm}")
    if one.bound is not None:
        found = measured.margin(metric, one.first, one.bound)
    elif not measured.compares(metric, one.first, one.second):
        return Result(
            one, "not measured", missing=f"{metric} of {one.first} and {one.second}, paired"
        )
    else:
        found = measured.difference(metric, one.first, one.second, one.share)
    gain, m = _gain(found), 0.0 if one.share or one.bound is not None else margin(metric)
    if gain is None:
        return Result(one, "open", found, "no interval")
    outcome, refutes = _outcome(one, gain, m)
    if (
        outcome in ("for", "against")
        and RAW not in one.arms
        and any(_is_untrained(measured, metric, arm) for arm in one.arms)
    ):
        outcome, refutes = "not trained", 1.0
    seen = (1 - one.share) * measured.mean(one.second, metric).centre if one.share else m
    power = gain.power(seen, one.relation == "equal")
    return Result(
        one,
        outcome,
        found,
        f"{metric} in place of {one.metric}" if metric != one.metric else "",
        power,
        refutes,
    )


def _outcome(one: Comparison, gain: _Gain, m: float) -> tuple[Outcome, float]:
    """Return the outcome and the one-sided p-value against the claim."""
    if one.relation == "equal":
        beyond = min(gain.chance(m, above=True), gain.chance(-m, above=False))
        if -m < gain.low and gain.high < m:
            return "for", beyond
        return ("against" if gain.low > m or gain.high < -m else "open"), beyond
    small, better = gain.high < m, gain.low > 0.0
    if one.relation == "better":
        return ("against" if small else "for" if better else "open"), gain.chance(m, above=False)
    return ("for" if small else "against" if better else "open"), gain.chance(0.0, above=True)


def _gain(found: Difference) -> _Gain | None:
    """Return a difference with its bounds, turned so that more is better."""
    sign = -1.0 if KNOWN.info(found.metric).direction == "lower" else 1.0
    if found.bounds is None:
        return None
    low, high = sorted(sign * bound for bound in found.bounds)
    whole_set = found.low is None
    return _Gain(
        sign * found.difference,
        low,
        high,
        np.inf if whole_set else max(found.n - 1, 1),
        (found.p_value or 0.0) / 2 if whole_set else 0.0,
    )


def _is_untrained(measured: Evidence, metric: str, arm: str) -> bool:
    """Whether an arm, which was given the raw render, has no better mean than it."""
    if metric == DRIFT or not measured.has(RAW, metric):
        return False
    better = -1.0 if KNOWN.info(metric).direction == "lower" else 1.0
    return better * (measured.mean(arm, metric).centre - measured.mean(RAW, metric).centre) <= 0.0
