"""What a frame costs behind each renderer, and what its fixer did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from alpasim_plugin.core.json_types import JsonObject, JsonView
from evaluators.numbers import Cell, duration, finite, fixed, missing, plural, short
from evaluators.opening import Run

GUARD = "fixer-"
COLUMNS = (  # head, what it means
    ("fixer", "what it is, and whose weights it has"),
    (
        "mode",
        "frame: every frame is fixed as it is rendered; speculative: blocks are drafted along the plan in force; "
        "chunk: the plan is committed for a whole block",
    ),
    ("frames", "camera frames that went through it"),
    ("hit rate", "share of drafted frames whose true pose came within tolerance"),
    ("made again", "how often a block was drafted again before it was complete, per block"),
    (
        "pose error",
        "largest distance between the camera pose of a frame handed to the policy and the true one",
    ),
    ("refused", "frames that the guard replaced by the raw frame"),
)
TIMES = ("ms_per_frame_mean", "ms_per_frame_p95", "frames_per_s", "first_frame_ms")


def fixer_rows(summary: JsonView) -> list[JsonObject]:
    """Lay out the fixers of a run: ``renderer``, ``trained``, and ``cells`` in the order of
    `COLUMNS`.
    """
    rows = []
    for name, entry in (summary.get("fixers") or {}).items():
        events = refused(summary, name)
        hits, blocks, redrafts = (finite(entry.get(k)) for k in ("hit_rate", "blocks", "redrafts"))
        frames = finite(entry.get("frames"))
        pose_error_m = finite((entry.get("shown_error") or {}).get("camera_m"))
        per_block = None
        if entry.get("mode") == "speculative" and redrafts is not None and blocks:
            per_block = redrafts / blocks
        undrafted = "only where blocks are drafted"
        cells = (
            Cell(str(entry.get("label"))),
            Cell(str(entry.get("mode"))),
            _cell(frames, "not counted", f"{frames or 0:.0f}"),
            _cell(hits, undrafted, f"{fixed(100 * (hits or 0.0), 1)}\u00a0%"),
            _cell(per_block, undrafted),
            _cell(pose_error_m, undrafted, short(pose_error_m, "m")),
            Cell(str(sum(events.values())), _kinds(events), sort=sum(events.values())),
        )
        rows.append({"renderer": name, "trained": bool(entry.get("trained")), "cells": cells})
    return rows


def _cell(value: float | None, reason: str, text: str = "") -> Cell:
    return missing(reason) if value is None else Cell(text or short(value), sort=value)


def _kinds(events: Mapping[str, int]) -> str:
    return ", ".join(f"{kind.removeprefix(GUARD)} {n}" for kind, n in sorted(events.items()))


def fixer_cautions(summary: JsonView) -> list[str]:
    """Say what a reader must know of the fixers before using the numbers."""
    cautions = []
    for name, entry in (summary.get("fixers") or {}).items():
        if not entry.get("trained"):
            label = entry.get("label")
            cautions.append(f"{name} is {label}: its results say nothing about a trained fixer.")
        events = refused(summary, name)
        if events:
            cautions.append(
                f"{name}: the fixer failed on {plural(sum(events.values()), 'frame')} of "
                f"{entry.get('frames')} ({_kinds(events)}); the raw frames were passed on."
            )
    return cautions


def refused(summary: JsonView, renderer: str) -> dict[str, int]:
    """Return how many frames of a renderer the fixer's guard replaced, by kind of event."""
    events = ((summary.get("censoring") or {}).get(renderer) or {}).get("frame_events") or {}
    return {kind: int(count) for kind, count in events.items() if kind.startswith(GUARD)}


@dataclass(frozen=True)
class Speed:
    """The speed table.

    Attributes:
        rows: Per renderer: ``renderer``, ``cells`` in the order of `TIMES`, and ``stages`` (their
            cells).
        stages: Names of the stages.
        pool: Workers, frames per second and wall time of the run.
    """

    rows: tuple[JsonObject, ...]
    stages: tuple[str, ...]
    pool: str


def speed(run: Run) -> Speed:
    """Lay out milliseconds per frame, whole and by stage."""
    entries: Mapping[str, JsonView] = run.summary.get("speed") or {}
    names = list(dict.fromkeys(stage for e in entries.values() for stage in e.get("stages") or {}))
    absent = "no finished rollout has a frame after its first"
    rows = []
    for renderer, entry in entries.items():
        stages = entry.get("stages") or {}
        rows.append(
            {
                "renderer": renderer,
                "cells": [_cell(finite(entry.get(key)), absent) for key in TIMES],
                "stages": [_stage(stages.get(name) or {}) for name in names],
            }
        )
    pool = run.summary.get("pool") or {}
    texts = []
    if pool.get("workers"):
        threads = plural(int(pool.get("threads_per_worker") or 1), "thread")
        texts.append(f"{plural(int(pool['workers']), 'worker')} with {threads} each")
    frames, wall_s = finite(pool.get("frames_per_s_total")), finite(pool.get("wall_s"))
    if frames is not None:
        texts.append(f"{short(frames)} camera frames/s in total")
    if wall_s is not None:
        texts.append(f"{duration(wall_s)} of wall time")
    return Speed(tuple(rows), tuple(names), ", ".join(texts))


def _stage(entry: JsonView) -> Cell:
    p50, p95, share = (finite(entry.get(key)) for key in ("p50_ms", "p95_ms", "share"))
    if p50 is None:
        return missing("this renderer has no such stage")
    texts = [] if p95 is None else [f"p95 {short(p95)}"]
    texts += [] if share is None else [f"{fixed(100 * share, 0)}\u00a0%"]
    note = "median; 95th percentile; share of the loop's time"
    return Cell(short(p50), note, " \u00b7 ".join(texts), sort=p50)
