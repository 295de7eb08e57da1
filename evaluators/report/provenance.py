"""Where a run comes from, whether a repeated rollout is bit-identical, and what did not enter its
numbers: failures and removed steps.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.opening import Run
from evaluators.report.numbers import Cell, finite, fixed, interval, missing

MAX_SCENES = 1000


@dataclass(frozen=True)
class SceneSource:
    """Where a scene came from."""

    scene: str
    source: str
    content_hash: str
    notes: tuple[str, ...]
    map_href: str | None


@dataclass(frozen=True)
class Provenance:
    """What is needed to make the run again, and what it did not model."""

    command: str
    facts: tuple[tuple[str, str], ...]
    hardware: tuple[tuple[str, str], ...]
    versions: tuple[tuple[str, str], ...]
    weights: tuple[tuple[str, str], ...]
    scenes: tuple[SceneSource, ...]
    more_scenes: int  # that are not among them
    left_out: tuple[str, ...]
    config: str


def provenance(run: Run) -> Provenance:
    """Collect provenance from ``run.json``."""
    info = run.info
    facts = {
        "preset": run.summary.get("preset") or info.get("preset"),
        "started": info.get("started_at"),
        "commit": commit_text(info),
        "simrun": info.get("version"),
        "run key": info.get("key"),
        "seeds": ", ".join(str(s) for s in info.get("seeds") or []),
        "schema": info.get("schema_version"),
    }
    scenes, of_run = [], info.get("scenes") or {}
    for name, entry in list(of_run.items())[:MAX_SCENES]:
        path = run.scene_path(name)
        notes = tuple(str(n) for n in entry.get("notes") or ())
        href = path.relative_to(run.folder).as_posix() if path else None
        scenes.append(
            SceneSource(
                name,
                str(entry.get("source") or ""),
                str(entry.get("content_hash") or ""),
                notes,
                href,
            )
        )
    command = info.get("command") or []
    return Provenance(
        shlex.join(str(word) for word in command) if isinstance(command, list) else str(command),
        tuple((k, str(v)) for k, v in facts.items() if v not in (None, "")),
        _pairs(info.get("hardware")),
        _pairs(info.get("versions")),
        _pairs(info.get("weights")),
        tuple(scenes),
        len(of_run) - len(scenes),
        tuple(str(note) for note in info.get("left_out") or ()),
        json.dumps(info.get("config") or {}, indent=2),
    )


def commit_text(info: Mapping[str, Any]) -> str:
    """Name the project's commit of a ``run.json``, with a word where files differed from it; empty
    where there is none.
    """
    project = info.get("project") or {}
    return (
        f"{project['commit']}{', files changed' if project.get('dirty') else ''}"
        if project.get("commit")
        else ""
    )


def _pairs(value: Any) -> tuple[tuple[str, str], ...]:
    if not isinstance(value, Mapping):
        return ()
    return tuple(
        (str(k), "none" if v is None else v if isinstance(v, str) else json.dumps(v))
        for k, v in value.items()
    )


def repeat_caution(run: Run) -> list[str]:
    """Say at the head of the report that the policy is not repeatable, where `run --repeat` found
    that.
    """
    repeat = run.info.get("repeat") or {}
    if repeat.get("repeatable") is not False:
        return []
    first = repeat.get("first_difference") or {"component": "log", "step": None}
    step = "" if first["step"] is None else f" at step {first['step']}"
    return [
        f"The policy is not repeatable: a rollout that was driven twice differs first in "
        f"{first['component']}{step}. Paired differences hold that noise too."
    ]


MAX_FAILURE_ROWS = 200


@dataclass(frozen=True)
class FailureRow:
    """One rollout that could not be run or scored."""

    rollout: Rollout
    parts: tuple[tuple[str, str], ...]  # label, text
    folder: str | None


def failure_rows(run: Run) -> tuple[list[FailureRow], int]:
    """List failed rollouts with what was attempted, with which object, what was found, and what to
    do.

    Returns:
        The rows, and how many more there are than are shown.
    """
    cells = (run.summary.get("failures") or {}).get("cells") or []
    errors = {
        (c["renderer"], c["policy"], c["scene"], c["seed"]): c.get("error") or {} for c in cells
    }
    failed = [r for r in run.rollouts if not r.ok]
    rows = []
    for rollout in failed[:MAX_FAILURE_ROWS]:
        error = errors.get(rollout.cell, {})
        parts = tuple(
            (label, str(error[label])) for label in ("message", "hint") if error.get(label)
        )
        rows.append(
            FailureRow(
                rollout,
                parts or (("message", rollout.failure or "no message was recorded"),),
                run.href(rollout),
            )
        )
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
    (
        "frame_events",
        "of them bad",
        "frames in which a guard saw something: black, or a fixer's frame that was replaced by the raw one",
    ),
)


def ledger(run: Run, rates: tuple[str, ...]) -> list[LedgerRow]:
    """Lay out the censoring ledger; empty where the summary has none.

    Args:
        rates: Rates whose best and worst case are shown, should every rollout without a value have
            been without or with the event.
    """
    rows = []
    for renderer, entry in (run.summary.get("censoring") or {}).items():
        if not isinstance(entry, Mapping) or "rollouts" not in entry:
            continue
        counts, bounds = [], []
        for key, _, _ in LEDGER_COLUMNS:
            found = entry.get(key)
            number = finite(found)
            if isinstance(found, Mapping):
                total = sum(int(n) for n in found.values())
                counts.append(
                    Cell(
                        str(total),
                        "",
                        ", ".join(f"{cause} {n}" for cause, n in found.items()),
                        sort=total,
                    )
                )
            else:
                counts.append(
                    missing("not counted")
                    if number is None
                    else Cell(fixed(number, 0), sort=number)
                )
        for rate in rates:
            ends = interval((entry.get("bounds") or {}).get(rate))
            if ends is None:
                bounds.append(missing("not a rate of this run"))
                continue
            low, high = (fixed(100 * v, 1) for v in ends)
            bounds.append(
                Cell(f"{low}\u00a0%" if low == high else f"{low} to {high}\u00a0%", sort=ends[1])
            )
        rows.append(LedgerRow(renderer, tuple(counts), tuple(bounds)))
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
            reasons = "; ".join(
                f"{reason} ({n})" for reason, n in (found.get("reasons") or {}).items()
            )
            rows.append(
                InvalidRow(
                    renderer, metric, int(found.get("rollouts") or 0), reasons or "not given"
                )
            )
    return rows
