"""Excluded data: rollouts that failed, and steps that the scoring rules removed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from alpasim_plugin.run_folder.rows import Rollout
from evaluators.opening import Run
from evaluators.report.numbers import Cell, finite, fixed, interval, missing

MAX_FAILURE_ROWS = 200


@dataclass(frozen=True)
class FailureRow:
    """One rollout that could not be run or scored."""

    rollout: Rollout
    parts: tuple[tuple[str, str], ...]  # label, text
    folder: str | None


def failure_rows(run: Run) -> tuple[list[FailureRow], int]:
    """List failed rollouts with what was attempted, with which object, what was found, and what to do.

    Returns:
        The rows, and how many more there are than are shown.
    """
    cells = (run.summary.get("failures") or {}).get("cells") or []
    errors = {(c["renderer"], c["policy"], c["scene"], c["seed"]): c.get("error") or {} for c in cells}
    failed = [r for r in run.rollouts if not r.ok]
    rows = []
    for rollout in failed[:MAX_FAILURE_ROWS]:
        error = errors.get(rollout.cell, {})
        parts = tuple((label, str(error[label])) for label in ("doing", "with", "found", "do") if error.get(label))
        rows.append(FailureRow(rollout, parts or (("found", rollout.failure or "no message was recorded"),), run.href(rollout)))
    return rows, len(failed) - len(rows)


@dataclass(frozen=True)
class LedgerRow:
    """What did not enter the numbers of one renderer."""

    renderer: str
    counts: tuple[Cell, ...]  # in the order of LEDGER_COLUMNS
    bounds: tuple[Cell, ...]  # in the order of the rates shown


LEDGER_COLUMNS = (  # key, head, what it means
    ("rollouts", "planned", "rollouts planned"),
    ("failed", "failed", "rollouts that could not be run or scored"),
    ("dropped", "dropped", "rollouts that a rule removed"),
    ("steps_total", "steps", "steps driven"),
    ("steps_warmup", "warm-up", "steps before the policy drives"),
    ("steps_after_event", "after event", "steps after the first collision or off-road event"),
    ("steps_after_drift", "after drift", "steps after leaving the logged path too far"),
    ("steps_scored", "scored", "steps that enter the metrics"),
    ("frames", "frames", "camera frames of rollouts that ran to their end"),
    ("frame_events", "of them bad", "frames in which a guard saw something: black, or a fixer's frame that was replaced by the raw one"),
)


def ledger(run: Run, rates: tuple[str, ...]) -> list[LedgerRow]:
    """Lay out the censoring ledger; empty where the summary has none.

    Args:
        rates: Rates whose best and worst case are shown, should every rollout without a value have been without or with the event.
    """
    rows = []
    for renderer, entry in (run.summary.get("censoring") or {}).items():
        if not isinstance(entry, Mapping) or "rollouts" not in entry:
            continue
        bounds = entry.get("bounds") or {}
        rows.append(
            LedgerRow(renderer, tuple(_tally(entry.get(key)) for key, _, _ in LEDGER_COLUMNS), tuple(_bound(bounds.get(r)) for r in rates))
        )
    return rows


@dataclass(frozen=True)
class InvalidRow:
    """A metric without a valid value in some rollouts of a renderer, and why."""

    renderer: str
    metric: str
    rollouts: int
    reasons: str


def invalid_rows(run: Run) -> list[InvalidRow]:
    """List every metric that is invalid somewhere."""
    rows = []
    for renderer, entry in (run.summary.get("censoring") or {}).items():
        for metric, found in ((entry or {}).get("invalid") or {}).items():
            reasons = "; ".join(f"{reason} ({n})" for reason, n in (found.get("reasons") or {}).items())
            rows.append(InvalidRow(renderer, metric, int(found.get("rollouts") or 0), reasons or "not given"))
    return rows


def _tally(value: Any) -> Cell:
    if isinstance(value, Mapping):
        total = sum(int(n) for n in value.values())
        return Cell(str(total), "", ", ".join(f"{cause} {n}" for cause, n in value.items()), sort=total)
    number = finite(value)
    return missing("not counted") if number is None else Cell(fixed(number, 0), sort=number)


def _bound(value: Any) -> Cell:
    bounds = interval(value)
    if bounds is None:
        return missing("not a rate of this run")
    low, high = (fixed(100 * v, 1) for v in bounds)
    return Cell(f"{low}\u00a0%" if low == high else f"{low} to {high}\u00a0%", sort=bounds[1])
