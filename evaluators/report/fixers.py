"""Fixers of a run: label, mode, hit rate of drafts, and frames that the guard rejected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from evaluators.report.numbers import Cell, finite, fixed, missing, plural, short

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
    ("redrafts", "blocks that were made again on the way, per block"),
    ("shown off by", "largest distance between the camera pose of a frame handed to the policy and the true one"),
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
    return [
        FixerRow(name, bool(entry.get("trained")), _cells(entry, refused(summary, name)))
        for name, entry in (summary.get("fixers") or {}).items()
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
            said.append(f"{name} is {entry.get('label')}: its results say nothing about a trained fixer.")
        events = refused(summary, name)
        if events:
            kinds = ", ".join(f"{kind.removeprefix(GUARD)} {n}" for kind, n in sorted(events.items()))
            total = plural(sum(events.values()), "frame")
            said.append(f"{name}: the fixer failed on {total} of {entry.get('frames')} ({kinds}); the raw frames were passed on.")
    return said


def refused(summary: Mapping[str, Any], renderer: str) -> dict[str, int]:
    """Return how many frames of a renderer the fixer's guard replaced, by kind of event."""
    entry = (summary.get("censoring") or {}).get(renderer) or {}
    return {kind: int(n) for kind, n in (entry.get("frame_events") or {}).items() if kind.startswith(GUARD)}


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
        Cell(str(sum(events.values())), "; ".join(f"{kind}: {n}" for kind, n in events.items()), sort=sum(events.values())),
    )
