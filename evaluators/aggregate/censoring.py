"""Censoring: what each rule removed, per renderer, and the bounds on each rate that the removed part allows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.run_folder.sides import RendererRows, Row, by_renderer, failure_of, metric_names, reason_of
from evaluators.metrics import METRICS, MetricTable

STEP_RULES = ("steps_total", "steps_warmup", "steps_after_event", "steps_after_drift", "steps_scored")
CUT_RULES = ("steps_after_event", "steps_after_drift")  # the policy drove there, but what happened does not count
FIXER_GUARD = "fixer-"  # frame events of this kind: the fixer's frame was replaced by the raw one


def censoring(rows: Sequence[Row], known: MetricTable = METRICS) -> dict[str, dict[str, Any]]:
    """Count what did not enter the table, per renderer and cause.

    Args:
        rows: Rollout rows or manifests as for `aggregate`, with ``censored`` (a `Ledger` as dict), ``frames`` and ``frame_events`` where a
            rollout was scored, and ``failure_class`` or ``error`` where it failed.
        known: What the metrics are.

    Returns:
        RENDERER -> ``rollouts`` (planned), ``failed`` (by failure class), ``dropped`` (by reason), the step counts of the ledger summed
        over rollouts, ``frames`` (rendered in rollouts that ran to their end), ``frame_events`` (by kind: ``black``, ``fixer-nan``, ...),
        ``frames_passed_raw`` (the fixer's guard took the raw frame), ``invalid`` (METRIC -> number of rollouts and their reasons), and for
        every rate METRIC -> [least, greatest]: ``bounds_rollouts`` (every missing rollout without, and with, the event) and ``bounds``
        (also every step that was cut from a scored rollout without, and with, the event), with ``cut`` (METRIC -> rollouts that were cut
        before the event was seen).
    """
    names = metric_names(rows)
    return {name: _of_renderer(side, names, known) for name, side in by_renderer(rows).items()}


def _of_renderer(side: RendererRows, names: Sequence[str], known: MetricTable) -> dict[str, Any]:
    done = [row for row, ok in zip(side.rows, side.ok, strict=True) if ok]
    ledgers = [row["censored"] for row in done if row.get("censored")]
    events: Counter[str] = Counter()
    for row in done:
        events.update(row.get("frame_events") or {})
    out: dict[str, Any] = {
        "rollouts": len(side.rows),
        "failed": dict(Counter(failure_of(row) for row, ok in zip(side.rows, side.ok, strict=True) if not ok)),
        "dropped": dict(Counter(ledger["dropped"] for ledger in ledgers if ledger["dropped"])),
        **{rule: sum(int(ledger[rule]) for ledger in ledgers) for rule in STEP_RULES},
        "frames": sum(int(row.get("frames") or 0) for row in done),
        "frame_events": dict(events),
        "frames_passed_raw": sum(n for event, n in events.items() if event.startswith(FIXER_GUARD)),
        "invalid": {},
        "bounds": {},
        "bounds_rollouts": {},
        "cut": {},
    }
    cut, scored = (np.array([_steps(row, rules) for row in side.rows], dtype=np.float64) for rules in (CUT_RULES, ("steps_scored",)))
    for name in names:
        values = side.raw(name)
        absent = np.flatnonzero(side.ok & ~np.isfinite(values))
        if len(absent):
            reasons = Counter(reason_of(side.rows[i], name) for i in absent)
            out["invalid"][name] = {"rollouts": len(absent), "reasons": dict(reasons)}
        metric = known.info(name)
        if metric.is_flag:
            is_share = metric.aggregation == "mean"
            out["bounds_rollouts"][name], out["bounds"][name], out["cut"][name] = rate_bounds(values, cut, scored, is_share)
    return out


def rate_bounds(values: F64, cut: F64, scored: F64, is_share: bool) -> tuple[list[float], list[float], int]:
    """Return the least and greatest that a rate could be, given what is missing.

    Args:
        values: ``(R,)`` the flag of each planned rollout, NaN where missing; at least one.
        cut: ``(R,)`` steps that a rule cut from each rollout after the policy took over.
        scored: ``(R,)`` steps that were scored.
        is_share: The flag of a rollout is the share of its steps that fired, not whether any did.

    Returns:
        Bounds over missing rollouts; bounds over missing rollouts and cut steps; how many rollouts were cut before the event was seen.
    """
    known = np.isfinite(values)
    seen, n, missing = values[known], len(values), int(np.sum(~known))
    cut, scored = cut[known], scored[known]
    least, greatest = seen, np.where(cut > 0, 1.0, seen)
    if is_share:
        steps = np.maximum(scored + cut, 1.0)
        least, greatest = np.where(cut > 0, seen * scored / steps, seen), np.where(cut > 0, (seen * scored + cut) / steps, seen)
    over_rollouts = [float(seen.sum()) / n, (float(seen.sum()) + missing) / n]
    return over_rollouts, [float(least.sum()) / n, (float(greatest.sum()) + missing) / n], int(np.sum(greatest > seen))


def _steps(row: Row, rules: Sequence[str]) -> int:
    ledger = row.get("censored") or {}
    return sum(int(ledger.get(rule) or 0) for rule in rules)
