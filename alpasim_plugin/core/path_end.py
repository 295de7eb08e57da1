"""Where the path of a scene ends: the recorded drive, and the lane that goes on behind it.

A rollout ends there and not where the recorded drive does, because a driver that is faster than the
recording must still meet whatever the recording stopped for.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, cross, interpolate, project
from alpasim_plugin.core.types import F64, PathEndKind, Trajectory

DIRECTION_M = 1.0  # the path's direction at its end is that of its last metre
ASIDE_M = 10.0  # farther aside the ego has left the path, and does not pass its end
STANDS_MPS = 1.0
SPEED_SPAN_US = 500_000
REACH_M = 2.0  # beside twice what the ego has moved: how far along the path it may have come
LEFT_M = 4.0  # from the path: it is found again anywhere
FOUND_M = 2.0  # where it is this near
LOST_M = (
    30.0  # farther from the path nobody comes back to it; CARLA's leaderboard ends a route there
)


class PathOfScene(Protocol):
    """What a scenario, or the part of it that evaluators see, says of its path."""

    @property
    def ego_log(self) -> Trajectory:
        """Give the recorded rig poses, world."""

    @property
    def path_beyond(self) -> F64:
        """Give the lane behind the recorded drive, ``(N, 3)`` metres, world."""

    @property
    def path_end(self) -> PathEndKind:
        """Give what the end of both is."""


class PathTracker:
    """Follows a point along a polyline that may cross or repeat itself.

    Args:
        line: ``(N, 2+)`` metres, N >= 2.
    """

    def __init__(self, line: F64) -> None:
        self._line = line[:, :2]
        self._along_m = arc_lengths(self._line)
        self._last: tuple[float, F64] | None = None

    def follow(self, xy: F64) -> float:
        """Return the arc length of the place nearest to ``(2,)`` among those that the point can
        have reached since the last call; of the whole line at the first one, and where the line was
        left and is met again.
        """
        if self._last is None:
            s_m = project(self._line, xy)[0]
        else:
            before_m, before_xy = self._last
            reach_m = REACH_M + 2.0 * float(np.hypot(*(xy - before_xy)))
            s_m, away_m = self._within(before_m - reach_m, before_m + reach_m, xy)
            if away_m > LEFT_M:
                elsewhere_m, distance_m = project(self._line, xy)
                if abs(distance_m) <= FOUND_M:
                    s_m = elsewhere_m
        self._last = s_m, np.array(xy)
        return s_m

    def _within(self, low_m: float, high_m: float, xy: F64) -> tuple[float, float]:
        """Return the arc length of the nearest place between two arc lengths, and its distance."""
        first = max(int(np.searchsorted(self._along_m, low_m, side="right")) - 1, 0)
        last = int(np.searchsorted(self._along_m, high_m)) + 1
        first = min(first, len(self._line) - 2)
        piece = self._line[first : max(last, first + 2)]
        s_m, distance_m = project(piece, xy)
        return float(self._along_m[first]) + s_m, abs(distance_m)


def remaining(path: F64, driven: F64) -> F64:
    """Return what is left of a path behind a drive along it.

    Args:
        path: ``(N, 3)`` metres, N >= 2.
        driven: ``(T, 2+)`` positions, in order.

    Returns:
        ``(K, 3)`` the vertices behind the last position.
    """
    tracker = PathTracker(path)
    s_m = 0.0
    for xy in driven[:, :2]:
        s_m = tracker.follow(xy)
    return path[arc_lengths(path) > s_m + 1e-6]


class PathEnd:
    """Tells when the ego has passed the end of its path.

    A path that goes on along the lane ends at a goal, or where the road ends. One that does not go
    on ends where the recorded images and the recorded map end. If the recorded car stands there,
    what lies beyond is why it stopped (a queue, a red light), and running into it must be seen: such
    a path has no end.

    Args:
        scene: The recorded drive and the lane behind it.
        stops: Whether a rollout ends there.

    Attributes:
        kind: What the end is.
        passed: Whether the ego has passed the end in this rollout.
    """

    def __init__(self, scene: PathOfScene, stops: bool = True) -> None:
        log = scene.ego_log
        line = np.concatenate([log.xyz[:, :2], scene.path_beyond[:, :2]])
        along_m = arc_lengths(line)
        self.kind = scene.path_end
        self.passed = False
        self._stops = stops
        self._length_m = float(along_m[-1])
        goes_on = len(scene.path_beyond) > 0 or scene.path_end != "record" or moves_at_end(log)
        self._has_end = goes_on and self._length_m > DIRECTION_M
        self._end = line[-1]
        self._line = line
        if self._has_end:
            inside_m = self._length_m - DIRECTION_M
            inside = [float(np.interp(inside_m, along_m, line[:, axis])) for axis in (0, 1)]
            ahead = self._end - np.array(inside)
            self._ahead = ahead / np.hypot(*ahead)
            self._tracker = PathTracker(line)

    def ends_rollout(self, axle_xy: F64) -> bool:
        """Note where the ego's rear axle is, ``(2,)``, metres, world; return whether the rollout
        ends here.
        """
        if self._has_end and not self.passed:
            s_m = self._tracker.follow(axle_xy)
            offset = axle_xy - self._end
            aside_m = abs(float(cross(self._ahead, offset)))
            is_beyond = s_m >= self._length_m * (1 - 1e-12) and offset @ self._ahead > 0.0
            self.passed = bool(is_beyond and aside_m <= ASIDE_M)
        return self.passed and self._stops

    def is_lost(self, axle_xy: F64) -> bool:
        """Tell whether the ego's rear axle ``(2,)`` is far from the whole path."""
        return abs(project(self._line, axle_xy)[1]) > LOST_M


def moves_at_end(log: Trajectory) -> bool:
    """Tell whether the recorded car moves in the last half second of its recording."""
    before_us = max(int(log.t_us[-1]) - SPEED_SPAN_US, int(log.t_us[0]))
    seconds = (int(log.t_us[-1]) - before_us) * 1e-6
    before = interpolate(log, np.array([before_us]))[0, :2, 3]
    moved_m = float(np.hypot(*(log.xyz[-1, :2] - before)))
    return seconds > 0 and moved_m / seconds > STANDS_MPS


def ends_with_path(rig_xy: F64, scene: PathOfScene) -> bool:
    """Tell whether the last of ``(T, 2)`` positions of the rear axle, and none before, has passed
    the end of the path: a rollout ends there.
    """
    end = PathEnd(scene)
    passed = [end.ends_rollout(xy) for xy in rig_xy]
    return bool(passed) and passed[-1] and not any(passed[:-1])
