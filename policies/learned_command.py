"""Navigation command of the learned policy: one of five, computed from the shape of the route ahead."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from alpasim_plugin.core.geometry import wrap_angle
from alpasim_plugin.core.types import F64

Command = Literal["keep", "left-ahead", "left-now", "right-ahead", "right-now"]
COMMANDS: tuple[Command, ...] = get_args(Command)

TURN_RADIUS_M = 28.0  # tighter curves are turns and are announced; wider ones belong to the road
AHEAD_M, NOW_M = 40.0, 6.0


def route_command(route_rig: F64, late_m: float = 0.0) -> Command:
    """Return the command for a route ahead ``(20, 3)`` in the rig frame, NaN where it ends.

    A turn is a stretch of two route segments on which the route bends tighter than `TURN_RADIUS_M`. The nearest one within `AHEAD_M` is
    announced, with "now" from `NOW_M` before it. The command does not depend on the route's lateral position in the lane.

    Args:
        route_rig: As in `Observation`.
        late_m: Delay of the announcement, metres; negative: early.
    """
    points = route_rig[np.isfinite(route_rig).all(axis=1), :2]
    if len(points) < 4:
        return "keep"
    step = np.diff(points, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    length = np.hypot(step[:, 0], step[:, 1])
    bend = wrap_angle(heading[2:] - heading[:-2]) / np.maximum(0.5 * (length[2:] + length[:-2]) + length[1:-1], 1e-6)
    begins_m = np.cumsum(length)[:-2] + late_m
    turns = np.flatnonzero((np.abs(bend) > 1.0 / TURN_RADIUS_M) & (begins_m < AHEAD_M))
    if len(turns) == 0:
        return "keep"
    first = int(turns[0])
    now = begins_m[first] < NOW_M
    if bend[first] > 0:
        return "left-now" if now else "left-ahead"
    return "right-now" if now else "right-ahead"
