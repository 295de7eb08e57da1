"""What a frame costs behind each renderer, and what its fixer did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from evaluators.opening import Run
from evaluators.report.numbers import Cell, duration, finite, fixed, missing, plural, short

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


@dataclass(frozen=True)
class FixerRow:
    """One renderer with a fixer."""

    renderer: str
    trained: bool
    cells: tuple[Cell, ...]  # in the order of COLUMNS


def fixer_rows(summary: Mapping[str, Any]) -> list[FixerRow]:
    """Lay out the fixers of a run; empty where there are none."""
    fixers = summary.get("fixers") or {}
    return [
        FixerRow(name, bool(entry.get("trained")), _cells(entry, refused(summary, name)))
        for name, entry in fixers.items()
    ]


def fixer_lines(summary: Mapping[str, Any]) -> list[str]:
    """Say in one line each what the fixers of a run were; whatever is untrained says so."""
    lines = []
    for name, entry in (summary.get("fixers") or {}).items():
        rate, events = finite(entry.get("hit_rate")), refused(summary, name)
        parts = [str(entry.get("label")), str(entry.get("mode"))]
        parts += [f"hit rate {fixed(100 * rate, 1)} %"] if rate is not None else []
        parts += [f"{plural(sum(events.values()), 'frame')} refused by its guard"] if events else []
        lines.append(f"{name}: {', '.join(parts)}")
    return lines


def fixer_cautions(summary: Mapping[str, Any]) -> list[str]:
    """Say what a reader must know of the fixers before using the numbers."""
    said = []
    for name, entry in (summary.get("fixers") or {}).items():
        if not entry.get("trained"):
            said.append(
                f"{name} is {entry.get('label')}: its results say nothing about a trained fixer."
            )
        events = refused(summary, name)
        if events:
            kinds = ", ".join(
                f"{kind.removeprefix(GUARD)} {n}" for kind, n in sorted(events.items())
            )
            total = plural(sum(events.values()), "frame")
            said.append(
                f"{name}: the fixer failed on {total} of {entry.get('frames')} ({kinds}); the raw frames were passed on."
            )
    return said


def refused(summary: Mapping[str, Any], renderer: str) -> dict[str, int]:
    """Return how many frames of a renderer the fixer's guard replaced, by kind of event."""
    entry = (summary.get("censoring") or {}).get(renderer) or {}
    return {
        kind: int(n)
        for kind, n in (entry.get("frame_events") or {}).items()
        if kind.startswith(GUARD)
    }


def _cells(entry: Mapping[str, Any], events: Mapping[str, int]) -> tuple[Cell, ...]:
    speculative = entry.get("mode") == "speculative"
    none = missing("only where blocks are drafted")
    rate, blocks, frames = (finite(entry.get(key)) for key in ("hit_rate", "blocks", "frames"))
    off = finite((entry.get("shown_error") or {}).get("camera_m"))
    redrafts = finite(entry.get("redrafts"))
    per_block = redrafts / blocks if redrafts is not None and blocks else None
    return (
        Cell(str(entry.get("label"))),
        Cell(str(entry.get("mode"))),
        missing("not counted") if frames is None else Cell(fixed(frames, 0), sort=frames),
        Cell(f"{fixed(100 * rate, 1)}\u00a0%", sort=rate) if rate is not None else none,
        Cell(short(per_block), sort=per_block) if per_block is not None and speculative else none,
        Cell(short(off, "m"), sort=off) if off is not None else none,
        Cell(
            str(sum(events.values())),
            "; ".join(f"{kind}: {n}" for kind, n in events.items()),
            sort=sum(events.values()),
        ),
    )


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
    sums = {
        r: sum(_per_frame(s) or 0.0 for s in (e.get("stages") or {}).values())
        for r, e in entries.items()
    }
    longest = max(sums.values(), default=0.0)
    index = {name: i for i, name in enumerate(run.renderers)}
    rows = []
    for renderer, entry in entries.items():
        stages = entry.get("stages") or {}
        means = [_per_frame(stages.get(name) or {}) for name in names]
        bar = [
            Segment(i, name, short(ms, "ms"), round(100.0 * ms / longest, 2))
            for i, (name, ms) in enumerate(zip(names, means, strict=True))
            if longest and ms
        ]
        cells = []
        for key in ("ms_per_frame_mean", "ms_per_frame_p95", "frames_per_s", "first_frame_ms"):
            number = finite(entry.get(key))
            absent = missing("no finished rollout has a frame after its first")
            cells.append(absent if number is None else Cell(short(number), sort=number))
        of_stages = tuple(_stage(stages.get(name) or {}) for name in names)
        total = short(sums[renderer] or None, "ms")
        rows.append(
            SpeedRow(renderer, index.get(renderer, 0), tuple(cells), of_stages, tuple(bar), total)
        )
    pool = run.summary.get("pool") or {}
    said = []
    if pool.get("workers"):
        threads = plural(int(pool.get("threads_per_worker") or 1), "thread")
        said.append(f"{plural(int(pool['workers']), 'worker')} with {threads} each")
    frames, wall = finite(pool.get("frames_per_s_total")), finite(pool.get("wall_s"))
    said += [f"{short(frames)} camera frames/s in total"] if frames is not None else []
    said += [f"{duration(wall)} of wall time"] if wall is not None else []
    return Speed(tuple(rows), tuple(names), ", ".join(said))


def _stage(entry: Mapping[str, Any]) -> Cell:
    p50, p95, share = (finite(entry.get(key)) for key in ("p50_ms", "p95_ms", "share"))
    if p50 is None:
        return missing("this renderer has no such stage")
    said = [f"p95 {short(p95)}"] if p95 is not None else []
    said += [f"{fixed(100 * share, 0)}\u00a0%"] if share is not None else []
    return Cell(
        short(p50),
        "median; 95th percentile; share of the loop's time",
        " \u00b7 ".join(said),
        sort=p50,
    )


def _per_frame(stage: Mapping[str, Any]) -> float | None:
    """Return what a stage costs per frame: its mean where it is stated, since some stages run once
    for several frames.
    """
    mean = finite(stage.get("per_frame_ms"))
    return finite(stage.get("p50_ms")) if mean is None else mean
