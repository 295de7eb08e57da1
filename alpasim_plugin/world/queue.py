"""Leaders of all drivers on one line at once: every body is placed on the line a single time, not once for every driver.

`alpasim_plugin.world.idm.find_leader` is the plain version for one driver; where a line passes the same body twice (a loop, a crossing
with itself) it decides, since there the place of a body depends on who asks.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.world.idm import NO_LEADER, Bodies, Leader, Spans, find_leader, spans
from alpasim_plugin.world.path import Path

COARSE_M = 4.0  # the line is looked at this often to find which bodies are near it


def find_leaders(
    path: Path, front_s_m: F64, half_width_m: F64, bodies: Bodies, own_row: I64, horizon_m: float = 120.0, margin_m: float = 0.2
) -> list[Leader]:
    """Return for each of ``(K,)`` drivers on a path what `find_leader` returns for it.

    Args:
        path: Their line.
        front_s_m: ``(K,)`` arc length of the front bumpers.
        half_width_m: ``(K,)``.
        bodies: Everybody.
        own_row: ``(K,)`` each driver's own row in ``bodies``, -1 where it has none.
        horizon_m: How far they look.
        margin_m: Beside their bodies.
    """
    touching, twice = near_line(path, bodies, float(half_width_m.max()) + margin_m, horizon_m)
    if twice:
        drivers = zip(front_s_m.tolist(), half_width_m.tolist(), own_row.tolist(), strict=True)
        return [find_leader(path, front, half, bodies, horizon_m, margin_m, row) for front, half, row in drivers]
    placed = spans(path, path.length_m / 2, _rows(bodies, touching), np.inf, window=False) if len(touching) else None
    if placed is None:
        return [NO_LEADER] * len(front_s_m)
    index, reach = touching[placed.index], (half_width_m + margin_m)[:, None]
    ahead = (placed.low < reach) & (placed.high > -reach) & (index != own_row[:, None])  # (K, m)
    ahead &= (placed.rear > front_s_m[:, None] - 2.0) & (placed.rear < front_s_m[:, None] + horizon_m)
    first = np.argmin(np.where(ahead, placed.rear, np.inf), axis=1)
    return [_leader(placed, index, int(k), front) if any_ahead else NO_LEADER
            for k, front, any_ahead in zip(first, front_s_m.tolist(), ahead.any(axis=1).tolist(), strict=True)]  # fmt: skip


def near_line(path: Path, bodies: Bodies, reach_m: float, horizon_m: float) -> tuple[I64, bool]:
    """Return the rows of bodies that may reach into a corridor along a path, and whether the path passes one of them twice.

    A body that touches the corridor has its centre within its half diagonal and the corridor's reach of the line; the tangents at the
    line's ends belong to it.
    """
    s = np.arange(-horizon_m, path.length_m + horizon_m + COARSE_M, COARSE_M)
    xyz, yaw = path.at(s)
    beyond = s - np.clip(s, 0.0, path.length_m)
    x, y = xyz[:, 0] + beyond * np.cos(yaw), xyz[:, 1] + beyond * np.sin(yaw)
    within = 2.0 * np.hypot(bodies.half_length_m, bodies.half_width_m) + reach_m + 0.5 * COARSE_M + 1.0
    touches: Bool = (bodies.xy[:, 0, None] - x) ** 2 + (bodies.xy[:, 1, None] - y) ** 2 <= within[:, None] ** 2  # (M, S)
    runs = touches[:, 0].astype(np.int64) + np.count_nonzero(touches[:, 1:] & ~touches[:, :-1], axis=1)
    return np.flatnonzero(runs), bool((runs > 1).any())


def _rows(bodies: Bodies, rows: Sequence[int] | I64) -> Bodies:
    some = np.asarray(rows)
    return Bodies(bodies.xy[some], bodies.yaw[some], bodies.half_length_m[some], bodies.half_width_m[some], bodies.velocity[some])


def _leader(placed: Spans, index: I64, k: int, front_s_m: float) -> Leader:
    return Leader(float(placed.rear[k] - front_s_m), float(placed.speed[k]), int(index[k]))
