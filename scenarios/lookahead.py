"""Predict who will enter the expert's corridor: scripted tracks as written, reactive cars at constant speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import yaw_from_quat
from alpasim_plugin.core.types import F64, I64, Bool, Box, Trajectory
from alpasim_plugin.world.idm import Bodies, spans
from alpasim_plugin.world.path import Path
from alpasim_plugin.world.state import NO_BODIES, bodies_from

LOOKAHEAD_S = tuple(float(t) for t in np.arange(0.5, 4.01, 0.5))
TIMES_S = np.array([0.0, *LOOKAHEAD_S])
HORIZON_M = 80.0
SIDE_M = 0.3
STANDING_M = 0.05  # a track that never moves farther than this stands


@dataclass(frozen=True)
class ScriptedTrack:
    """A track that does not react to others."""

    track: Trajectory
    box: Box


class ScriptedTracks:
    """Poses of all scripted tracks on a time grid; those that never move apart.

    Args:
        scripts: Tracks.
        end_us: Last queried time, before the look-ahead.
        step_us: Grid.
    """

    def __init__(self, scripts: Sequence[ScriptedTrack], end_us: int, step_us: int) -> None:
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

    def rows(self, t_us: int) -> I64:
        """Return the grid rows of now and of the look-ahead."""
        rows = (t_us + np.round(TIMES_S * 1e6).astype(np.int64)) // self.step_us
        return np.minimum(rows, len(self.times) - 1)


@dataclass(frozen=True)
class PredictedBodies:
    """Road users now (first row) and after each time of `LOOKAHEAD_S`."""

    xy: F64  # (1 + n, K, 2)
    yaw: F64  # (1 + n, K)
    velocity: F64  # (1 + n, K, 2)
    present: Bool  # (1 + n, K)
    boxes: tuple[Box, ...]
    yields: Bool  # (K,) reactive: it lets the ego go first when it is behind


def yielding_acceleration(path: Path, front_s: float, speed_mps: float, box: Box, ahead: PredictedBodies, min_gap_m: float) -> float:
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
        ahead: Everyone who moves.
        min_gap_m: Gap to keep from a standing body; half a second is added for a moving one.
    """
    n, k = ahead.yaw.shape
    if k == 0:
        return float("inf")
    flat = bodies_from(ahead.xy.reshape(-1, 2), ahead.yaw.reshape(-1), ahead.boxes * n, ahead.velocity.reshape(-1, 2))
    span = spans(path, front_s, flat, HORIZON_M)
    if span is None:
        return float("inf")
    half = box.width_m / 2 + SIDE_M
    rear, front, speed = np.full(n * k, np.inf), np.full(n * k, -np.inf), np.zeros(n * k)
    inside = np.zeros(n * k, dtype=np.bool_)
    rear[span.index], front[span.index], speed[span.index] = span.rear, span.front, span.speed
    inside[span.index] = (span.low < half) & (span.high > -half)
    rear, front, speed, inside = (a.reshape(n, k) for a in (rear, front, speed, inside & ahead.present.reshape(-1)))
    tau = TIMES_S[:, None]
    passed = front < front_s + speed_mps * tau - box.length_m - 1.0
    behind = ahead.yields & (rear[0] < front_s + 0.5)
    counts = inside & ~passed & (front >= front_s) & ~inside[0] & ~behind & ahead.present[0]
    counts[0] = False
    if not counts.any():
        return float("inf")
    allowed = rear - (min_gap_m + 0.5 * speed) - front_s - speed_mps * tau
    return float(np.min(2.0 * allowed[counts] / np.broadcast_to(tau, counts.shape)[counts] ** 2))
