"""AlpaSim's means over scenes, and their spread over repeated sweeps.

Rollouts of different scenes are paired by rank: the first in the order of their names of every scene make one sweep, the second ones the
next. A metric is averaged over the scenes of a sweep, then mean and sample standard deviation are taken over sweeps. That spread is
neither a scene-to-scene spread nor a confidence interval; `evaluators.aggregate` gives those.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64
from evaluators.alpasim.reduction import ReducedRollout

INCIDENTS = {
    "avg_dist_between_incidents": "offroad_or_collision",
    "avg_dist_between_incidents_at_fault": "offroad_or_collision_at_fault",
}  # km


def over_sweeps(rollouts: Sequence[ReducedRollout]) -> dict[str, float | int | None]:
    """Return one row: every metric, ``n_clips`` and the distances between incidents in km, each with ``_std``, and ``n_rollouts``.

    ``n_clips`` is the mean number of scenes of a sweep: a fraction where rollouts were dropped. A distance is inf in a sweep without
    incident. None where no sweep has a value, or a spread has fewer than two.

    Raises:
        InputError: Two rollouts of a scene have the same name.
    """
    ranks = _ranks(rollouts)
    kept = [(rank, one.values) for rank, one in zip(ranks, rollouts, strict=True) if not one.dropped]
    if not kept:
        return {}
    sweeps = [[values for rank, values in kept if rank == r] for r in sorted({rank for rank, _ in kept})]
    rows = [_sweep(sweep) for sweep in sweeps]
    out: dict[str, float | int | None] = {}
    spread: dict[str, float | int | None] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        found = np.array([row[name] for row in rows if row.get(name) is not None], dtype=np.float64)
        with np.errstate(invalid="ignore"):  # the spread of inf is NaN, as in AlpaSim's table
            out[name] = float(np.mean(found)) if len(found) else None
            spread[f"{name}_std"] = float(np.std(found, ddof=1)) if len(found) > 1 else None
    return {**out, **spread, "n_rollouts": len(rows)}


def _ranks(rollouts: Sequence[ReducedRollout]) -> list[int]:
    """Return each rollout's rank among the names of its scene, dropped ones included."""
    names: dict[str, list[str]] = {}
    for one in rollouts:
        names.setdefault(one.of.scene, []).append(one.of.rollout)
    for scene, own in names.items():
        twice = next((name for name in own if own.count(name) > 1), None)
        if twice is not None:
            raise InputError(
                "aggregating as AlpaSim does", f"scene {scene!r}", f"two rollouts named {twice!r}",
                "score the runs apart, or rename the folder of one log",
            )  # fmt: skip
        own.sort()
    return [names[one.of.scene].index(one.of.rollout) for one in rollouts]


def _sweep(rows: Sequence[dict[str, float | None]]) -> dict[str, float | None]:
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: np.array([row[name] for row in rows if row.get(name) is not None], dtype=np.float64) for name in names}
    out: dict[str, float | None] = {name: float(np.mean(column)) if len(column) else None for name, column in columns.items()}
    out["n_clips"] = float(len(rows))
    for name, event in INCIDENTS.items():
        out[name] = _km_between(columns["dist_traveled_m"], columns[event])
    return out


def _km_between(driven_m: F64, events: F64) -> float:
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.sum(driven_m) / np.sum(events) / 1000)
