"""Whether each of the paper's claims holds here: every comparison with its paired interval, and one word for the claim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from alpasim_plugin.lab.paper.claims import CLAIMS, CLOSE, Claim, Comparison
from alpasim_plugin.lab.paper.measured import ALPHA, Difference, Measured, beyond
from alpasim_plugin.lab.video_metrics.facts import KNOWN
from evaluators.statistics.intervals import Interval

Outcome = Literal["for", "against", "open", "not measured"]
Verdict = Literal["holds", "does not hold", "undecided at our scale", "not measured"]


@dataclass(frozen=True)
class Result:
    """A comparison with its outcome.

    Args:
        comparison: Which.
        outcome: By its own 95 % interval or p-value.
        difference: None where it was not measured.
        missing: What was not measured.
        refutes: One-sided p-value that it goes against the claim, corrected by Holm for all comparisons of the claim; None: not measured.
    """

    comparison: Comparison
    outcome: Outcome
    difference: Difference | None
    missing: str = ""
    refutes: float | None = None


@dataclass(frozen=True)
class Judged:
    """A claim with its verdict and the results of all of its comparisons."""

    claim: Claim
    verdict: Verdict
    results: tuple[Result, ...]

    def count(self, outcome: Outcome) -> int:
        """Return how many comparisons came out so."""
        return sum(result.outcome == outcome for result in self.results)


def judge_claims(measured: Mapping[str, Measured], claims: Sequence[Claim] = CLAIMS) -> tuple[Judged, ...]:
    """Judge every claim.

    Args:
        measured: PROTOCOL -> what was measured under it; a protocol that was not run is not there.
        claims: Those of the paper.

    Returns:
        A verdict each: ``does not hold`` where one comparison is decided against it, corrected for the claim's number of comparisons; else
        ``not measured`` where one was not measured, else ``holds`` where all are decided for it, else ``undecided at our scale``. A claim
        that needs all of its comparisons needs no correction to hold (intersection-union test).
    """
    return tuple(_judged(claim, measured) for claim in claims)


def in_both(first: Verdict, second: Verdict) -> Verdict:
    """Return the verdict on a claim that was judged under two budgets of training: it holds if it holds in both, and fails in either."""
    for verdict in ("does not hold", "not measured", "undecided at our scale"):
        if verdict in (first, second):
            return verdict
    return "holds"


def contest_results(comparisons: Sequence[Comparison], measured: Mapping[str, Measured]) -> list[Result]:
    """Return every comparison with its outcome, uncorrected for their number.

    Args:
        comparisons: In any order.
        measured: PROTOCOL -> what was measured under it.
    """
    return [_result(comparison, measured.get(comparison.protocol)) for comparison in comparisons]


def _judged(claim: Claim, measured: Mapping[str, Measured]) -> Judged:
    found = contest_results(claim.comparisons, measured)
    against = [None if r.difference is None else _p_against(r.comparison, r.difference, measured[r.comparison.protocol]) for r in found]
    results = tuple(replace(result, refutes=p) for result, p in zip(found, holm(against), strict=True))
    outcomes = {result.outcome for result in results}
    verdict: Verdict = "undecided at our scale"
    if any(result.refutes is not None and result.refutes <= ALPHA / 2 for result in results):
        verdict = "does not hold"
    elif "not measured" in outcomes:
        verdict = "not measured"
    elif outcomes == {"for"}:
        verdict = "holds"
    return Judged(claim, verdict, results)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Return p-values corrected for their number by Holm's step-down method; what is None is no test and stays so.

    Source: Holm, Scandinavian Journal of Statistics 6 (1979).

    Example:
        >>> holm([0.01, None, 0.04, 0.03])
        [0.03, None, 0.06, 0.06]
    """
    tested = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    out: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, i) in enumerate(tested):
        largest = max(largest, min((len(tested) - rank) * p, 1.0))
        out[i] = largest
    return out


def _p_against(comparison: Comparison, found: Difference, measured: Measured) -> float | None:
    """Return the one-sided p-value that a comparison goes against its claim."""
    p_value, toward = found.p_value, found.difference * {"higher": 1, "lower": -1}.get(KNOWN.info(found.metric).direction, 0)
    if comparison.relation == "close" and found.low is not None and found.high is not None:
        width = CLOSE * abs(measured.mean(comparison.second, comparison.metric).centre)
        p_value = beyond(Interval(found.difference, found.low, found.high), width, found.n)
        return None if p_value is None else p_value / 2
    if p_value is None:
        return None
    is_against = toward > 0 if comparison.relation == "not better" else toward < 0
    return p_value / 2 if is_against else 1 - p_value / 2


def _result(comparison: Comparison, measured: Measured | None) -> Result:
    if measured is None:
        return Result(comparison, "not measured", None, f"protocol {comparison.protocol}")
    for arm in comparison.arms:
        if not measured.has(arm, comparison.metric):
            missing = f"{comparison.metric} of {arm}" if arm in measured.values else f"arm {arm}"
            return Result(comparison, "not measured", None, missing)
    if comparison.bound is None:
        found = measured.difference(comparison.metric, comparison.first, comparison.second)
    else:
        found = measured.margin(comparison.metric, comparison.first, comparison.bound)
    return Result(comparison, _outcome(comparison, found, measured), found)


def _outcome(comparison: Comparison, found: Difference, measured: Measured) -> Outcome:
    if comparison.relation == "better":
        return "for" if found.favours > 0 else "against" if found.favours < 0 else "open"
    if comparison.relation == "not better":
        # Shown better refutes it; shown worse, or no better within what can be seen, is what it says.
        return "against" if found.favours > 0 else "for"
    if found.low is None or found.high is None:
        return "open"
    width = CLOSE * abs(measured.mean(comparison.second, comparison.metric).centre)
    if -width <= found.low and found.high <= width:
        return "for"
    return "against" if found.low > width or found.high < -width else "open"
