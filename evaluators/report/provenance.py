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
from evaluators.report.numbers import Cell, duration, finite, fixed, interval, missing, plural

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


@dataclass(frozen=True)
class Component:
    """One component of the repeated rollout."""

    name: str
    same: bool
    digest: str
    repeated: str


@dataclass(frozen=True)
class Certificate:
    """Result of the repeated rollout as the page shows it."""

    word: str  # badge
    tone: str
    text: str
    components: tuple[Component, ...]


def certificate(run: Run) -> Certificate:
    """Read the certificate of a run; a run without one says so."""
    entry = run.summary.get("determinism")
    fork = run.info.get("fork")
    if isinstance(fork, Mapping):
        said = f"{fork.get('of')} was made again up to the change and is the same as its log there, to the bit"
        after = {"equal": ", and so is what follows"}.get(str(fork.get("continuation")), "")
        return Certificate("equal", "better", f"{said}{after}.", ())
    if not isinstance(entry, Mapping):
        return Certificate(
            "none",
            "unclear",
            "This run has no certificate: nothing was driven, or an older version made it.",
            (),
        )
    if entry.get("status") == "skipped":
        return Certificate(
            "not made", "unclear", f"No rollout was repeated: {entry.get('reason')}.", ()
        )
    cell = entry.get("cell") or {}
    wall = finite(entry.get("wall_s"))
    what = f"{cell.get('renderer')} · {cell.get('policy')} · {cell.get('scene')} · seed {cell.get('seed')}"
    steps = f"{plural(int(entry.get('steps') or 0), 'step')}" + (
        f", {duration(wall)}" if wall is not None else ""
    )
    digests, repeated = entry.get("digests") or {}, entry.get("repeated") or {}
    components = tuple(
        Component(name, repeated.get(name) == value, value, repeated.get(name, ""))
        for name, value in digests.items()
    )
    if entry.get("status") == "equal":
        return Certificate(
            "equal",
            "better",
            f"{what} was made again ({steps}) and is the same to the bit.",
            components,
        )
    return Certificate(
        "different",
        "worse",
        f"{what} was made again ({steps}) and differs first in {_first(entry)}.",
        components,
    )


def certificate_caution(run: Run) -> list[str]:
    """Say at the head of the report that results cannot be repeated, where that was found."""
    entry = run.summary.get("determinism") or {}
    if entry.get("status") != "different":
        return []
    return [
        f"The run is not deterministic: a repeated rollout differs first in {_first(entry)}. Paired differences hold that noise too."
    ]


def _first(entry: Mapping[str, Any]) -> str:
    first = entry.get("first_difference") or {}
    at = f" at step {first['step']}" if first.get("step") is not None else ""
    return f"{first.get('component')}{at} ({first.get('what')})"


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
