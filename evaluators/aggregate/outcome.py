"""Outcome of a run or a gate: one object that gives the printed verdict and the process exit code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Cause = Literal["pass", "regression", "policy", "undecided", "infrastructure", "evaluator"]

EXIT_CODES: dict[Cause, int] = {"pass": 0, "regression": 1, "policy": 2, "undecided": 3, "infrastructure": 4, "evaluator": 5}
WORDS: dict[Cause, str] = {
    "pass": "PASS",
    "regression": "FAIL",
    "policy": "POLICY FAILURE",
    "undecided": "UNDECIDED",
    "infrastructure": "INFRASTRUCTURE FAILURE",
    "evaluator": "EVALUATOR FAILURE",
}
# Where causes meet, the first one found here decides: numbers from an incomplete run may mislead either way.
SEVERITY: tuple[Cause, ...] = ("evaluator", "infrastructure", "policy", "regression", "undecided", "pass")


@dataclass(frozen=True)
class Outcome:
    """A cause with one sentence for each thing that led to it."""

    cause: Cause
    reasons: tuple[str, ...] = ()

    @property
    def exit_code(self) -> int:
        """Give the process exit code (docs/cli.md)."""
        return EXIT_CODES[self.cause]

    @property
    def title(self) -> str:
        """Give the verdict as a heading."""
        return WORDS[self.cause]

    def as_dict(self) -> dict[str, Any]:
        """Return the outcome for JSON."""
        return {"cause": self.cause, "exit_code": self.exit_code, "reasons": list(self.reasons)}


def worst(outcomes: list[Outcome]) -> Outcome:
    """Return the outcome that decides, with the reasons of all that share its cause.

    Example:
        >>> worst([Outcome("pass"), Outcome("undecided", ("too few scenes",))]).exit_code
        3
    """
    for cause in SEVERITY:
        mine = [one for one in outcomes if one.cause == cause]
        if mine:
            return Outcome(cause, tuple(reason for one in mine for reason in one.reasons))
    return Outcome("pass")


def outcome_of_failures(failures: Mapping[str, Any], max_share: float = 0.0) -> Outcome:
    """Judge rollouts that could not be run or scored.

    Args:
        failures: The ``failures`` block of summary.json: ``n_failed``, ``n_rollouts``, ``by_class``.
        max_share: Share of the planned rollouts that may fail.
    """
    n, n_failed, by_class = int(failures["n_rollouts"]), int(failures["n_failed"]), failures["by_class"]
    if n_failed <= max_share * n:
        return Outcome("pass")
    causes = ", ".join(f"{name} {count}" for name, count in by_class.items())
    said = f"{n_failed} of {n} rollouts could not be run or scored ({causes})"
    alone: Cause | None = next((cause for cause in ("evaluator", "policy") if set(by_class) == {cause}), None)
    return Outcome(alone or "infrastructure", (said,))
