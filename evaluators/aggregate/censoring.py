"""The censoring ledger: what every rule removed, per renderer, and what the removed part could have made of each rate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from evaluators.aggregate.rows import Row, failure_of, is_ok, metric_names, reason_of, renderers, value_of
from evaluators.metrics import info

STEP_RULES = ("steps_total", "steps_warmup", "steps_after_event", "steps_after_drift", "steps_scored")
CUT_RULES = ("steps_after_event", "steps_after_drift")  # the policy drove there, but what happened does not count
FIXER_GUARD = "fixer-"  # frame events of this kind: the fixer's frame was replaced by the raw one


def censoring(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Count what did not enter the table, per renderer and cause.

    Args:
        rows: Rollout rows or manifests as for `aggregate`, with ``censored`` (a `Ledger` as dict), ``frames`` and ``frame_events`` where a
            rollout was scored, and ``failure_class`` or ``error`` where it failed.

    Returns:
        RENDERER -> ``rollouts`` (planned), ``failed`` (by failure class), ``dropped`` (by reason), the step counts of the ledger summed
        over rollouts, ``frames`` (rendered in rollouts that ran to their end), ``frame_events`` (by kind: ``black``, ``fixer-nan``, ...),
        ``frames_passed_raw`` (the fixer's guard took the raw frame), ``invalid`` (METRIC -> number of rollouts and their reasons), and for
        every rate METRIC -> [least, greatest]: ``bounds_rollouts`` (every missing rollout without, and with, the event) and ``bounds``
        (also every step that was cut from a scored rollout without, and with, the event), with ``cut`` (METRIC -> rollouts that were cut
        before the event was seen).
    """
    names = metric_names(rows)
    return {name: _of_renderer([row for row in rows if row["renderer"] == name], names) for name in renderers(rows)}


def _of_renderer(rows: Sequence[Row], names: Sequence[str]) -> dict[str, Any]:
    done = [row for row in rows if is_ok(row)]
    ledgers = [row["censored"] for row in done if row.get("censored")]
    events: Counter[str] = Counter()
    for row in done:
        events.update(row.get("frame_events") or {})
    out: dict[str, Any] = {
        "rollouts": len(rows),
        "failed": dict(Counter(failure_of(row) for row in rows if not is_ok(row))),
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
    for name in names:
        absent = [row for row in done if value_of(row, name) is None]
        if absent:
            out["invalid"][name] = {"rollouts": len(absent), "reasons": dict(Counter(reason_of(row, name) for row in absent))}
        if info(name).is_flag:
            out["bounds_rollouts"][name], out["bounds"][name], out["cut"][name] = rate_bounds(rows, name)
    return out


def rate_bounds(rows: Sequence[Row], metric: str) -> tuple[list[float], list[float], int]:
    """Return the least and greatest that a rate could be, given what is missing.

    Args:
        rows: All planned rollouts of one renderer, at least one.
        metric: A flag.

    Returns:
        Bounds over missing rollouts; bounds over missing rollouts and cut steps; how many rollouts were cut before the event was seen.
    """
    least = greatest = missing = 0.0
    seen: list[float] = []
    n_cut = 0
    for row in rows:
        value = value_of(row, metric) if is_ok(row) else None
        if value is None:
            missing += 1
            continue
        low, high = _with_cut_steps(value, row.get("censored") or {}, info(metric).aggregation == "mean")
        seen.append(value)
        least, greatest = least + low, greatest + high
        n_cut += high > value
    n, total = len(rows), sum(seen)
    return [total / n, (total + missing) / n], [least / n, (greatest + missing) / n], n_cut


def _with_cut_steps(value: float, ledger: Mapping[str, Any], is_share: bool) -> tuple[float, float]:
    """Return the least and greatest value of a rollout had its cut steps counted: a share of steps, or whether any step fired."""
    cut, scored = sum(int(ledger.get(rule) or 0) for rule in CUT_RULES), int(ledger.get("steps_scored") or 0)
    if not cut:
        return value, value
    if is_share:
        return value * scored / (scored + cut), (value * scored + cut) / (scored + cut)
    return value, 1.0
