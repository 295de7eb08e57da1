"""Rows for the parts of the report beside the result tables: scenes, failures, speed and provenance."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from evaluators.report.events import COLLISION
from evaluators.report.metric_info import in_percent
from evaluators.report.numbers import Cell, duration, finite, fixed, interval, missing, plural, short
from evaluators.report.run_folder import Rollout, Run

MAX_SCENE_ROWS = 1200
MAX_FAILURE_ROWS = 200
SCENE_METRICS = ("route_distance_m", "progress")


@dataclass(frozen=True)
class Chip:
    """One rollout in the scene table: its seed and how it ended."""

    text: str
    state: str  # ok | collision | offroad | failed
    title: str
    folder: str | None
    clip: str | None


@dataclass(frozen=True)
class SceneRow:
    """One scene under one renderer and policy."""

    scene: str
    renderer: str
    policy: str
    arm: int
    chips: tuple[Chip, ...]
    collisions: Cell
    offroad: Cell
    values: tuple[Cell, ...]


def scene_rows(run: Run) -> tuple[list[SceneRow], int]:
    """Lay out scenes x arms.

    Returns:
        The rows, and how many more there are than are shown.
    """
    groups: dict[tuple[str, str, str], list[Rollout]] = {}
    for rollout in run.rollouts:
        groups.setdefault((rollout.scene, rollout.renderer, rollout.policy), []).append(rollout)
    renderer_index = {name: i for i, name in enumerate(run.renderers)}
    rank = {name: i for i, name in enumerate(run.scenes)}
    keys = sorted(groups, key=lambda k: (rank[k[0]], renderer_index[k[1]], k[2]))
    rows = [_scene_row(run, key, groups[key], renderer_index[key[1]]) for key in keys[:MAX_SCENE_ROWS]]
    return rows, len(keys) - len(rows)


def _scene_row(run: Run, key: tuple[str, str, str], rollouts: list[Rollout], arm: int) -> SceneRow:
    done = [r for r in rollouts if r.ok]
    chips = tuple(_chip(run, r) for r in sorted(rollouts, key=lambda r: r.seed))
    return SceneRow(
        *key,
        arm=arm,
        chips=chips,
        collisions=_count(done, COLLISION),
        offroad=_count(done, ("offroad",)),
        values=tuple(_mean(run, done, name) for name in SCENE_METRICS),
    )


def _chip(run: Run, rollout: Rollout) -> Chip:
    if not rollout.ok:
        state, letter, said = "failed", " F", f"failed ({rollout.failure_class or 'unknown cause'})"
    elif rollout.flag(*COLLISION):
        state, letter, said = "collision", " C", "collision" + (" and off-road" if rollout.flag("offroad") else "")
    elif rollout.flag("offroad"):
        state, letter, said = "offroad", " O", "off-road"
    else:
        state, letter, said = "ok", "", "no collision, not off-road"
    facts = [f"seed {rollout.seed}: {said}"]
    facts += [f"{rollout.frames} frames"] if rollout.frames is not None else []
    facts += [duration(rollout.wall_s)] if rollout.wall_s is not None else []
    return Chip(f"{rollout.seed}{letter}", state, ", ".join(facts), run.href(rollout), run.href(rollout, "front.mp4"))


def _count(done: list[Rollout], names: tuple[str, ...]) -> Cell:
    known = [r for r in done if any(r.metrics.get(name) is not None for name in names)]
    if not known:
        return missing("no rollout finished" if not done else "the metric is valid in no rollout")
    k = sum(r.flag(*names) for r in known)
    return Cell(f"{k} of {len(known)}", sort=k / len(known), tone="worse" if k else "")


def _mean(run: Run, done: list[Rollout], name: str) -> Cell:
    values = [v for r in done if (v := r.metrics.get(name)) is not None]
    if not values:
        return missing("no rollout finished" if not done else "the metric is valid in no rollout")
    mean = float(np.mean(values))
    note = "" if len(values) == len(done) else f"valid in {len(values)} of {len(done)}"
    return Cell(f"{fixed(100 * mean, 1)}\u00a0%" if in_percent(name, "") else short(mean, "m"), note, sort=mean)


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
class Segment:
    """One stage in a speed bar; ``width`` in percent of the slowest renderer's sum of stages."""

    stage: int
    name: str
    text: str
    width: float


@dataclass(frozen=True)
class SpeedRow:
    """One renderer's speed."""

    renderer: str
    arm: int
    cells: tuple[Cell, ...]  # p50, p95, frames per second, first frame
    stages: tuple[Cell, ...]
    bar: tuple[Segment, ...]
    sum_text: str


@dataclass(frozen=True)
class Speed:
    """The speed table."""

    rows: tuple[SpeedRow, ...]
    stages: tuple[str, ...]
    pool: str


def speed(run: Run) -> Speed:
    """Lay out milliseconds per frame, whole and by stage."""
    entries: Mapping[str, Mapping[str, Any]] = run.summary.get("speed") or {}
    names = list(dict.fromkeys(stage for e in entries.values() for stage in e.get("stages") or {}))
    sums = {r: sum(finite(s.get("p50_ms")) or 0.0 for s in (e.get("stages") or {}).values()) for r, e in entries.items()}
    longest = max(sums.values(), default=0.0)
    index = {name: i for i, name in enumerate(run.renderers)}
    rows = []
    for renderer, entry in entries.items():
        stages = entry.get("stages") or {}
        bar = [
            Segment(i, name, short(ms, "ms"), round(100.0 * ms / longest, 2))
            for i, name in enumerate(names)
            if longest and (ms := finite((stages.get(name) or {}).get("p50_ms")))
        ]
        rows.append(
            SpeedRow(
                renderer,
                index.get(renderer, 0),
                tuple(_ms(entry.get(key)) for key in ("ms_per_frame_p50", "ms_per_frame_p95", "frames_per_s", "first_frame_ms")),
                tuple(_stage(stages.get(name)) for name in names),
                tuple(bar),
                short(sums[renderer] or None, "ms"),
            )
        )
    return Speed(tuple(rows), tuple(names), _pool(run.summary.get("pool") or {}))


def _ms(value: Any) -> Cell:
    number = finite(value)
    return missing("no finished rollout has a frame after its first") if number is None else Cell(short(number), sort=number)


def _stage(entry: Mapping[str, Any] | None) -> Cell:
    p50 = finite((entry or {}).get("p50_ms"))
    if entry is None or p50 is None:
        return missing("this renderer has no such stage")
    p95, share = finite(entry.get("p95_ms")), finite(entry.get("share"))
    detail = " \u00b7 ".join(
        ([f"p95 {short(p95)}"] if p95 is not None else []) + ([f"{fixed(100 * share, 0)}\u00a0%"] if share is not None else [])
    )
    return Cell(short(p50), "median; 95th percentile; share of the loop's time", detail, sort=p50)


def _pool(pool: Mapping[str, Any]) -> str:
    said = []
    if pool.get("workers"):
        said.append(f"{plural(int(pool['workers']), 'worker')} with {plural(int(pool.get('threads_per_worker') or 1), 'thread')} each")
    total, wall = finite(pool.get("frames_per_s_total")), finite(pool.get("wall_s"))
    said += [f"{short(total)} camera frames/s in total"] if total is not None else []
    said += [f"{duration(wall)} of wall time"] if wall is not None else []
    return ", ".join(said)


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
    left_out: tuple[str, ...]
    config: str


def provenance(run: Run) -> Provenance:
    """Collect provenance from ``run.json``."""
    info = run.info
    facts = {
        "preset": run.summary.get("preset") or info.get("preset"),
        "started": info.get("started_at"),
        "simrun": info.get("version"),
        "run key": info.get("key"),
        "seeds": ", ".join(str(s) for s in info.get("seeds") or []),
        "schema": info.get("schema_version"),
    }
    scenes = []
    for name, entry in (info.get("scenes") or {}).items():
        path = run.scene_path(name)
        notes = tuple(str(n) for n in entry.get("notes") or ())
        href = path.relative_to(run.folder).as_posix() if path else None
        scenes.append(SceneSource(name, str(entry.get("source") or ""), str(entry.get("content_hash") or ""), notes, href))
    command = info.get("command") or []
    return Provenance(
        shlex.join(str(word) for word in command) if isinstance(command, list) else str(command),
        tuple((k, str(v)) for k, v in facts.items() if v not in (None, "")),
        _pairs(info.get("hardware")),
        _pairs(info.get("versions")),
        _pairs(info.get("weights")),
        tuple(scenes),
        tuple(str(note) for note in info.get("left_out") or ()),
        json.dumps(info.get("config") or {}, indent=2),
    )


def _pairs(value: Any) -> tuple[tuple[str, str], ...]:
    if not isinstance(value, Mapping):
        return ()
    return tuple((str(k), "none" if v is None else v if isinstance(v, str) else json.dumps(v)) for k, v in value.items())


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
        rows.append(LedgerRow(renderer, tuple(_tally(entry.get(key)) for key, _, _ in LEDGER_COLUMNS), tuple(_bound(bounds.get(r)) for r in rates)))
    return rows


def _tally(value: Any) -> Cell:
    if isinstance(value, Mapping):
        total = sum(int(n) for n in value.values())
        return Cell(str(total), "; ".join(f"{cause}: {n}" for cause, n in value.items()), sort=total)
    number = finite(value)
    return missing("not counted") if number is None else Cell(fixed(number, 0), sort=number)


def _bound(value: Any) -> Cell:
    bounds = interval(value)
    if bounds is None:
        return missing("not a rate of this run")
    low, high = (fixed(100 * v, 1) for v in bounds)
    return Cell(f"{low}\u00a0%" if low == high else f"{low} to {high}\u00a0%", sort=bounds[1])
