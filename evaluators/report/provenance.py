"""Where a run comes from, and what did not enter its numbers: failures and removed steps. Rows are
dictionaries for the templates.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from typing import Any

from alpasim_plugin.core.json_types import JsonObject
from evaluators.numbers import Cell, finite, fixed, interval, missing
from evaluators.opening import Run

MAX_SCENES = 1000
MAX_FAILURE_ROWS = 200
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


def provenance(run: Run) -> JsonObject:
    """Return what is needed to make the run again, and what it did not model, from ``run.json``."""
    info = run.info
    project = info.get("project") or {}
    commit = project.get("commit")
    facts = {
        "preset": run.summary.get("preset") or info.get("preset"),
        "started": info.get("started_at"),
        "commit": f"{commit}, files changed" if commit and project.get("dirty") else commit,
        "simrun": info.get("version"),
        "run key": info.get("key"),
        "seeds": ", ".join(map(str, info.get("seeds") or ())),
        "schema": info.get("schema_version"),
    }
    scenes = []
    stored = info.get("scenes") or {}
    for name, entry in list(stored.items())[:MAX_SCENES]:
        path = run.scene_path(name)
        link = path.relative_to(run.folder).as_posix() if path else None
        empty = {"source": "", "content_hash": "", "notes": ()}
        scenes.append(empty | entry | {"scene": name, "map_href": link})
    command = info.get("command") or ""
    tables = {key: _pairs(info.get(key)) for key in ("hardware", "versions", "weights")}
    return tables | {
        "command": command if isinstance(command, str) else shlex.join(map(str, command)),
        "facts": [(key, str(value)) for key, value in facts.items() if value not in (None, "")],
        "scenes": scenes,
        "more_scenes": len(stored) - len(scenes),
        "left_out": [str(note) for note in info.get("left_out") or ()],
        "config": json.dumps(info.get("config") or {}, indent=2),
    }


def _pairs(value: Any) -> list[tuple[str, str]]:
    if not isinstance(value, Mapping):
        return []
    texts = {key: "none" if one is None else one for key, one in value.items()}
    return [(key, one if isinstance(one, str) else json.dumps(one)) for key, one in texts.items()]


def failure_rows(run: Run) -> tuple[list[JsonObject], int]:
    """List failed rollouts with message and hint.

    Returns:
        The rows, and how many more there are than are shown.
    """
    cells = (run.summary.get("failures") or {}).get("cells") or []
    errors = {
        (cell["renderer"], cell["policy"], cell["scene"], cell["seed"]): cell.get("error") or {}
        for cell in cells
    }
    failed = [rollout for rollout in run.rollouts if not rollout.ok]
    rows = []
    for rollout in failed[:MAX_FAILURE_ROWS]:
        error = {"message": rollout.failure or "no message was recorded"}
        error |= errors.get(rollout.cell, {})
        parts = [(label, str(error[label])) for label in ("message", "hint") if error.get(label)]
        rows.append({"rollout": rollout, "parts": parts, "folder": run.href(rollout)})
    return rows, len(failed) - len(rows)


def ledger(run: Run, rates: tuple[str, ...]) -> list[JsonObject]:
    """Lay out the censoring ledger; empty where the summary has none.

    Args:
        rates: Rates whose best and worst case are shown, should every rollout without a value have
            been without or with the event.

    Returns:
        Per renderer: ``counts`` in the order of `LEDGER_COLUMNS`, ``bounds`` in that of the rates.
    """
    rows = []
    for renderer, entry in (run.summary.get("censoring") or {}).items():
        if "rollouts" not in entry:
            continue
        counts = [_count(entry.get(key)) for key, _, _ in LEDGER_COLUMNS]
        bounds = []
        for rate in rates:
            ends = interval((entry.get("bounds") or {}).get(rate))
            if ends is None:
                bounds.append(missing("not a rate of this run"))
                continue
            texts = dict.fromkeys(fixed(100 * end, 1) for end in ends)
            bounds.append(Cell(f"{' to '.join(texts)}\u00a0%", sort=ends[1]))
        rows.append({"renderer": renderer, "counts": counts, "bounds": bounds})
    return rows


def _count(value: Any) -> Cell:
    """Print a number, or the sum of numbers by cause."""
    if isinstance(value, Mapping):
        causes = ", ".join(f"{cause} {count}" for cause, count in value.items())
        return Cell(str(sum(value.values())), detail=causes, sort=sum(value.values()))
    number = finite(value)
    return missing("not counted") if number is None else Cell(fixed(number, 0), sort=number)


def invalid_rows(run: Run) -> list[JsonObject]:
    """List every metric that is invalid in some rollouts of a renderer, and why."""
    rows = []
    for renderer, entry in (run.summary.get("censoring") or {}).items():
        for metric, facts in (entry.get("invalid") or {}).items():
            reasons = (facts.get("reasons") or {}).items()
            text = "; ".join(f"{reason} ({count})" for reason, count in reasons)
            row = {"renderer": renderer, "metric": metric, "reasons": text or "not given"}
            rows.append(row | {"rollouts": int(facts.get("rollouts") or 0)})
    return rows
