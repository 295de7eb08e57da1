"""Seeing who will come into the expert's corridor: scripted tracks as they are written, reactive cars at their present speed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.geometry import yaw_from_quat
from alpasim_plugin.types import Box, Trajectory
from alpasim_plugin.world.idm import Bodies, spans
from alpasim_plugin.world.path import Path
from alpasim_plugin.world.state import NO_BODIES, bodies_from, concatenate

LOOKAHEAD_S = tuple(float(t) for t in np.arange(0.5, 4.01, 0.5))
HORIZON_M = 80.0
SIDE_M = 0.3
STANDING_M = 0.05  # a track that never moves farther than this stands


@dataclass(frozen=True)
class Script:
    """A track that reacts to nobody."""

    track: Trajectory
    box: Box


class ScriptTable:
    """Poses of all scripted tracks on a time grid; those that never move apart.

    Args:
        scripts: Tracks.
        end_us: Last time that will be asked for, before the look-ahead.
        step_us: Grid.
    """

    def __init__(self, scripts: Sequence[Script], end_us: int, step_us: int) -> None:
        self.step_us = step_us
        self.times = np.arange(0, end_us + int(LOOKAHEAD_S[-1] * 1e6) + step_us, step_us, dtype=np.int64)
        still = [s for s in scripts if np.ptp(s.track.xyz[:, :2], axis=0).max() < STANDING_M and s.track.t_us[-1] >= end_us]
        going = [s for s in scripts if not any(s is other for other in still)]
        self.standing = (
            bodies_from(
                np.array([s.track.xyz[0, :2] for s in still]),
                np.array([float(yaw_from_quat(s.track.quat[0])) for s in still]),
                [s.box for s in still],
                np.zeros((len(still), 2)),
            )
            if still
            else NO_BODIES
        )
        n = len(self.times)
        self.boxes = [s.box for s in going]
        self.xy, self.yaw = np.zeros((n, len(going), 2)), np.zeros((n, len(going)))
        self.velocity, self.present = np.zeros((n, len(going), 2)), np.zeros((n, len(going)), dtype=np.bool_)
        for j, script in enumerate(going):
            track = script.track
            t = np.clip(self.times, track.t_us[0], track.t_us[-1])
            for d in range(2):
                self.xy[:, j, d] = np.interp(t, track.t_us, track.xyz[:, d])
            self.yaw[:, j] = np.interp(t, track.t_us, np.unwrap(yaw_from_quat(track.quat)))
            self.velocity[:, j] = np.gradient(self.xy[:, j], step_us * 1e-6, axis=0)
            # A track that ends with the scene (and not by leaving the road) goes on standing in the look-ahead.
            self.present[:, j] = (self.times >= track.t_us[0]) & ((self.times <= track.t_us[-1]) | (track.t_us[-1] >= end_us))

    def moving(self, t_us: int) -> Bodies:
        """Return the moving bodies present at a time on the grid."""
        if not self.boxes:
            return NO_BODIES
        i = min(t_us // self.step_us, len(self.times) - 1)
        keep = np.flatnonzero(self.present[i])
        return bodies_from(self.xy[i, keep], self.yaw[i, keep], [self.boxes[k] for k in keep], self.velocity[i, keep])


def foresee(
    path: Path, front_s: float, speed_mps: float, box: Box, table: ScriptTable, reactive: Sequence[Callable[[float], Bodies]], t_us: int,
    min_gap_m: float,
) -> float:  # fmt: skip
    """Return the largest acceleration that keeps behind everyone who will come into the corridor; infinite without such a one.

    For a body that will be in the corridor after ``tau`` seconds with its rear at ``r``, the own front must then not be beyond
    ``r - gap``: with constant acceleration ``a <= 2 (r - gap - front - v tau) / tau^2``. Not counted are bodies that are in the
    corridor already (they are followed, or come from behind), bodies that the ego will have passed by then, and reactive cars that
    are behind the own front now (they are the ones to yield).

    Args:
        path: The ego's line.
        front_s: Arc length of the front bumper.
        speed_mps: Own speed.
        box: Ego body.
        table: Scripted tracks.
        reactive: For each reactive car, its foreseen bodies after a time in seconds.
        t_us: Now.
        min_gap_m: Gap to keep from a standing body; half a second is added for a moving one.
    """
    half = box.width_m / 2 + SIDE_M
    n_scripted = len(table.boxes)
    now = _corridor(path, front_s, table.moving(t_us), [car(0.0) for car in reactive], half)
    cap = np.inf
    for tau in LOOKAHEAD_S:
        scripted = table.moving(t_us + round(tau * 1e6))
        if n_scripted and len(scripted.xy) != len(table.moving(t_us).xy):
            continue  # someone enters or leaves the scene in between; its row numbers are not comparable
        then = _corridor(path, front_s, scripted, [car(tau) for car in reactive], half)
        for key, (rear, front, speed, inside) in then.items():
            if not inside or key not in now:
                continue
            rear_now, _, _, inside_now = now[key]
            is_reactive = key[0] == "r"
            passed = front < front_s + speed_mps * tau - box.length_m - 1.0
            if inside_now or passed or front < front_s or (is_reactive and rear_now < front_s + 0.5):
                continue
            gap = min_gap_m + 0.5 * speed
            cap = min(cap, 2.0 * (rear - gap - front_s - speed_mps * tau) / (tau * tau))
    return float(cap)


def _corridor(
    path: Path, front_s: float, scripted: Bodies, reactive: Sequence[Bodies], half_m: float
) -> dict[tuple[str, int], tuple[float, float, float, bool]]:
    """Return (rear, front, speed, inside) along the path by body; ("s", row) scripted, ("r", car) reactive."""
    keys = [("s", i) for i in range(len(scripted.xy))]
    for i, car in enumerate(reactive):
        keys += [("r", i)] * len(car.xy)
    span = spans(path, front_s, concatenate([scripted, *reactive]), HORIZON_M)
    if span is None:
        return {}
    inside = (span.low < half_m) & (span.high > -half_m)
    return {
        keys[int(row)]: (float(span.rear[n]), float(span.front[n]), float(span.speed[n]), bool(inside[n]))
        for n, row in enumerate(span.index)
    }
