"""Milliseconds per frame, whole and by stage, and what the pool achieved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from alpasim_plugin.run_folder.reader import Run
from evaluators.report.numbers import Cell, duration, finite, fixed, missing, plural, short


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
    variant: int
    cells: tuple[Cell, ...]  # mean, p95, frames per second, first frame
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
    sums = {r: sum(_per_frame(s) or 0.0 for s in (e.get("stages") or {}).values()) for r, e in entries.items()}
    longest = max(sums.values(), default=0.0)
    index = {name: i for i, name in enumerate(run.renderers)}
    rows = []
    for renderer, entry in entries.items():
        stages = entry.get("stages") or {}
        bar = [
            Segment(i, name, short(ms, "ms"), round(100.0 * ms / longest, 2))
            for i, name in enumerate(names)
            if longest and (ms := _per_frame(stages.get(name) or {}))
        ]
        rows.append(
            SpeedRow(
                renderer,
                index.get(renderer, 0),
                tuple(_ms(entry.get(key)) for key in ("ms_per_frame_mean", "ms_per_frame_p95", "frames_per_s", "first_frame_ms")),
                tuple(_stage(stages.get(name)) for name in names),
                tuple(bar),
                short(sums[renderer] or None, "ms"),
            )
        )
    return Speed(tuple(rows), tuple(names), _pool(run.summary.get("pool") or {}))


def _per_frame(stage: Mapping[str, Any]) -> float | None:
    """Return what a stage costs per frame: its mean where it is stated, since some stages run once for several frames."""
    mean = finite(stage.get("per_frame_ms"))
    return finite(stage.get("p50_ms")) if mean is None else mean


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
