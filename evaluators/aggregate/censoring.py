"""The censoring ledger: what every rule removed, per renderer, and what the removed rollouts could have made of each rate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from evaluators.aggregate.rows import Row, is_ok, metric_names, renderers, value_of
from evaluators.metrics import info

STEP_RULES = ("steps_total", "steps_warmup", "steps_after_event", "steps_after_drift", "steps_scored")


def censoring(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Count what did not enter the table, per renderer and cause.

    Args:
        rows: Rollout rows or manifests as for `aggregate`, with ``censored`` (a `Ledger` as dict) where a rollout was scored, and
            ``failure_class`` or ``error`` where it failed.

    Returns:
        RENDERER -> ``rollouts`` (planned), ``failed`` (by failure class), ``dropped`` (by reason), the step counts of the ledger summed
        over rollouts, ``invalid`` (METRIC -> number of rollouts and their reasons), and ``bounds`` (METRIC -> [least, greatest] for every
        rate: the mean if every missing rollout were without, and with, the event).
    """
    names = metric_names(rows)
    return {name: _of_renderer([row for row in rows if row["renderer"] == name], names) for name in renderers(rows)}


def _of_renderer(rows: Sequence[Row], names: Sequence[str]) -> dict[str, Any]:
    failed = Counter(_failure_class(row) for row in rows if not is_ok(row))
    ledgers = [row["censored"] for row in rows if is_ok(row) and row.get("censored")]
    invalid: dict[str, dict[str, Any]] = {}
    bounds: dict[str, list[float]] = {}
    for name in names:
        found = [value_of(row, name) if is_ok(row) else None for row in rows]
        missing = sum(value is None for value in found)
        absent = [row for row, value in zip(rows, found, strict=True) if value is None and is_ok(row)]
        if absent:
            invalid[name] = {"rollouts": len(absent), "reasons": dict(Counter(_reason(row, name) for row in absent))}
        if info(name).is_flag and rows:
            total = sum(value for value in found if value is not None)
            bounds[name] = [total / len(rows), (total + missing) / len(rows)]
    return {
        "rollouts": len(rows),
        "failed": dict(failed),
        "dropped": dict(Counter(ledger["dropped"] for ledger in ledgers if ledger["dropped"])),
        **{rule: sum(int(ledger[rule]) for ledger in ledgers) for rule in STEP_RULES},
        "invalid": invalid,
        "bounds": bounds,
    }


def _failure_class(row: Row) -> str:
    error = row.get("error") or {}
    return str(row.get("failure_class") or error.get("failure_class") or "unknown")


def _reason(row: Row, metric: str) -> str:
    nested = row.get("metrics")
    entry = nested.get(metric) if isinstance(nested, dict) else None
    if entry is None:
        return str(row.get(f"{metric}_reason") or "not given")
    return str(entry["reason"] if isinstance(entry, dict) else entry.reason)
