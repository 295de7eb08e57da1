"""From clips to a table: means with t intervals over clips, paired differences, quality by frame
index, speed.

A row is one clip under one variant: ``arm``, ``clip``, ``seed``, ``values`` (metric -> number),
``series`` (metric -> per frame), ``ms_per_frame`` (of later blocks; absent where no fixer ran),
``identical``, ``events``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.lab.video_metrics.facts import FACTS, KNOWN, MS, SOMETIMES, WARP
from alpasim_plugin.log.run_folder.sides import by_renderer
from evaluators.statistics.intervals import t_interval
from evaluators.statistics.paired import compare

Row = Mapping[str, Any]
# the variant of the ground-truth frames: only metrics without a reference are measured on it
TRUTH = "truth"
BINS = 20  # windows of frames
LEAST_BIN = 5  # frames


def summarise(rows: Sequence[Row], baseline: str) -> dict[str, Any]:
    """Summarise clips.

    Args:
        rows: As above; every variant should have every clip.
        baseline: Variant that the others are compared with, clip by clip.

    Returns:
        ``arms``: VARIANT -> METRIC -> ``mean``, ``ci95`` ([low, high], t over clips, or None with
            ``reason``), ``n``, ``unit`` and
        ``direction``; ``paired``: VARIANT -> METRIC -> what `evaluators.statistics.paired.compare`
        gives; ``by_frame``: VARIANT -> METRIC -> ``first`` and ``last`` frame of each window,
        ``mean``, ``low``, ``high`` over clips; ``identical``, ``events``, ``frames``, ``clips``: by
        variant.

    Raises:
        EvaluatorError: No row, or none of the baseline.
    """
    names = list(dict.fromkeys(str(row["arm"]) for row in rows))
    if baseline not in names:
        raise EvaluatorError(
            f"baseline {baseline!r}: variants {', '.join(names) or 'none'}",
            "name one of the variants as the baseline",
        )
    by_variant = {name: [row for row in rows if row["arm"] == name] for name in names}
    return {
        "baseline": baseline,
        "arms": {
            name: {m: _mean(mine, m) for m in metrics_of(mine)} for name, mine in by_variant.items()
        },
        "paired": _paired(rows, baseline),
        "by_frame": {
            name: {m: _windows(mine, m) for m in mine[0]["series"]}
            for name, mine in by_variant.items()
        },
        "clips": {name: len(mine) for name, mine in by_variant.items()},
        "frames": {
            name: sorted({int(row["frames"]) for row in mine}) for name, mine in by_variant.items()
        },
        "identical": {
            name: sum(int(row["identical"]) for row in mine) for name, mine in by_variant.items()
        },
        "events": {name: _events(mine) for name, mine in by_variant.items()},
    }


def metrics_of(rows: Sequence[Row]) -> list[str]:
    """Return the metrics that every row carries, and those that may be undefined and any row
    carries, in the order of the tables.
    """
    return [name for name in FACTS if _carried(rows, name)]


def _carried(rows: Sequence[Row], metric: str) -> bool:
    found = [value_of(row, metric) is not None for row in rows]
    return any(found) if metric in SOMETIMES else all(found)


def value_of(row: Row, metric: str) -> float | None:
    """Return a clip's value; the time is the median over blocks."""
    if metric == MS:
        return None if not row.get(MS) else float(np.median(row[MS]))
    value = row["values"].get(metric)
    return None if value is None else float(value)


def _mean(rows: Sequence[Row], metric: str) -> dict[str, Any]:
    values = [value_of(row, metric) for row in rows]
    known = [v for v in values if v is not None]
    found = t_interval(known, "clips")
    entry: dict[str, Any] = {"mean": found.centre, "ci95": found.bounds, "n": len(known)}
    entry |= {"excluded": len(values) - len(known)} if len(known) < len(values) else {}
    entry |= {"unit": FACTS[metric].unit, "direction": FACTS[metric].direction}
    return (
        entry
        | ({"reason": found.reason} if found.reason else {})
        | ({"note": found.note} if found.note else {})
    )


def _paired(rows: Sequence[Row], baseline: str) -> dict[str, dict[str, Any]]:
    flat = [
        {
            "renderer": row["arm"],
            "policy": "open-loop",
            "scene": row["clip"],
            "seed": row["seed"],
            "status": "ok",
        }
        | {m: v for m in FACTS if (v := value_of(row, m)) is not None}
        for row in rows
        if row["arm"] != TRUTH
    ]
    split = by_renderer(flat)
    out: dict[str, dict[str, Any]] = {}
    for name, side in split.items():
        shared = [
            m
            for m in FACTS
            if all(any(m in row for row in s.rows) for s in (side, split[baseline]))
        ]
        if name != baseline:
            out[name] = {m: compare(side, split[baseline], KNOWN[m], baseline, 0.0) for m in shared}
    return out


def _windows(rows: Sequence[Row], metric: str) -> dict[str, list[Any]]:
    """Average each window of frames per clip, then over clips; up to the length of the shortest
    clip.
    """
    offset = 1 if metric == WARP else 0  # the first pair ends at frame 1
    length = min(len(row["series"][metric]) for row in rows)
    bins = max(1, min(BINS, length // LEAST_BIN))
    edges = np.linspace(0, length, bins + 1).round().astype(int)
    out: dict[str, list[Any]] = {"first": [], "last": [], "mean": [], "low": [], "high": []}
    for low, high in pairwise(edges):
        found = t_interval(
            [float(np.mean(row["series"][metric][low:high])) for row in rows], "clips"
        )
        for key, value in zip(
            out,
            (int(low) + offset, int(high) - 1 + offset, found.centre, found.low, found.high),
            strict=True,
        ):
            out[key].append(value)
    return out


def _events(rows: Sequence[Row]) -> dict[str, int]:
    out: dict[str, int] = {}
    for row in rows:
        for name, count in row.get("events", {}).items():
            out[name] = out.get(name, 0) + int(count)
    return out
