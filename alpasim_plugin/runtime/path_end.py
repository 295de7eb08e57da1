"""Where a rollout ends before its time is up: at the end of the recorded path."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, interpolate, project
from alpasim_plugin.core.types import F64, Trajectory

DIRECTION_M = 1.0
STANDS_MPS = 1.0
SPEED_SPAN_US = 500_000


class PathEnd:
    """Tells when the ego has passed the end of the recorded path.

    Beyond that end nothing is known: no recorded drive to compare with, often no map. If the recorded car stands there, what lies beyond
    is why it stopped (a queue, a red light), and running into it must be seen: such a path has no end here.

    Args:
        log: The recorded rig poses.
        stops: Whether a rollout ends there.

    Attributes:
        passed: Whether the ego has passed the end in this rollout.
    """

    def __init__(self, log: Trajectory, stops: bool = True) -> None:
        self._path = log.xyz[:, :2]
        self._length_m = float(arc_lengths(self._path)[-1])
        before_us = max(int(log.t_us[-1]) - SPEED_SPAN_US, int(log.t_us[0]))
        seconds = (int(log.t_us[-1]) - before_us) * 1e-6
        there = interpolate(log, np.array([before_us]))[0, :2, 3]
        goes = seconds > 0 and float(np.hypot(*(self._path[-1] - there))) / seconds > STANDS_MPS
        self._has_end = goes and self._length_m > DIRECTION_M
        s = arc_lengths(self._path)
        inside = [float(np.interp(self._length_m - DIRECTION_M, s, self._path[:, axis])) for axis in (0, 1)]
        self._ahead = self._path[-1] - np.array(inside)
        self._stops = stops
        self.passed = False

    def ends_rollout(self, at: F64) -> bool:
        """Note where the ego's rear axle is, ``(2,)``, metres, world; return whether the rollout ends here."""
        if self._has_end and not self.passed and (at - self._path[-1]) @ self._ahead > 0.0:
            self.passed = project(self._path, at)[0] >= self._length_m * (1 - 1e-12)
        return self.passed and self._stops
