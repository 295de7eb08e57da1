"""Whether each of the paper's claims holds here: every contest with its paired interval, and one word for the claim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from evaluators.paper.claims import CLAIMS, CLOSE, Claim, Contest
from evaluators.paper.measured import Difference, Measured

Outcome = Literal["for", "against", "open", "not measured"]
Verdict = Literal["holds", "does not hold", "undecided at our scale", "not measured"]


@dataclass(frozen=True)
class Result:
    """A contest with its outcome; ``difference`` is None where it was not measured, and ``missing`` then says what is missing."""

    contest: Contest
    outcome: Outcome
    difference: Difference | None
    missing: str = ""


@dataclass(frozen=True)
class Judged:
    """A claim with its verdict and the results of all of its contests."""

    claim: Claim
    verdict: Verdict
    results: tuple[Result, ...]

    def count(self, outcome: Outcome) -> int:
        """Return how many contests came out so."""
        return sum(result.outcome == outcome for result in self.results)


def judge_claims(measured: Mapping[str, Measured], claims: Sequence[Claim] = CLAIMS) -> tuple[Judged, ...]:
    """Judge every claim.

    Args:
        measured: PROTOCOL -> what was measured under it; a protocol that was not run is not there.
        claims: Those of the paper.

    Returns:
        A verdict each: ``does not hold`` where one contest is decided against it, else ``not measured`` where one was not measured, else
        ``undecided at our scale`` where one is open, else ``holds``.
    """
    return tuple(_judged(claim, measured) for claim in claims)


def in_both(first: Verdict, second: Verdict) -> Verdict:
    """Return the verdict on a claim that was judged under two budgets of training: it holds if it holds in both, and fails in either."""
    for verdict in ("does not hold", "not measured", "undecided at our scale"):
        if verdict in (first, second):
            return verdict
    return "holds"


def _judged(claim: Claim, measured: Mapping[str, Measured]) -> Judged:
    results = tuple(_result(contest, measured.get(contest.protocol)) for contest in claim.contests)
    outcomes = {result.outcome for result in results}
    verdict: Verdict = "holds"
    if "against" in outcomes:
        verdict = "does not hold"
    elif "not measured" in outcomes:
        verdict = "not measured"
    elif "open" in outcomes:
        verdict = "undecided at our scale"
    return Judged(claim, verdict, results)


def _result(contest: Contest, measured: Measured | None) -> Result:
    if measured is None:
        return Result(contest, "not measured", None, f"protocol {contest.protocol}")
    for arm in contest.arms:
        if not measured.has(arm, contest.metric):
            missing = f"{contest.metric} of {arm}" if arm in measured.values else f"arm {arm}"
            return Result(contest, "not measured", None, missing)
    if contest.bound is None:
        found = measured.difference(contest.metric, contest.first, contest.second)
    else:
        found = measured.margin(contest.metric, contest.first, contest.bound)
    return Result(contest, _outcome(contest, found, measured), found)


def _outcome(contest: Contest, found: Difference, measured: Measured) -> Outcome:
    if contest.relation == "better":
        return "for" if found.favours > 0 else "against" if found.favours < 0 else "open"
    if contest.relation == "not better":
        # Shown better refutes it; shown worse, or no better within what can be seen, is what it says.
        return "against" if found.favours > 0 else "for"
    if found.low is None or found.high is None:
        return "open"
    width = CLOSE * abs(measured.mean(contest.second, contest.metric).centre)
    if -width <= found.low and found.high <= width:
        return "for"
    return "against" if found.low > width or found.high < -width else "open"
