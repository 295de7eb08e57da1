"""Roads above one another, made by hand."""

from dataclasses import replace

import numpy as np

from alpasim_plugin.core.geometry import left_of, unit
from alpasim_plugin.core.types import Lane
from tests.world import small_maps
from tests.world.small_maps import arc, make

HALF_M = 1.75


def lane_along(name, line):
    """A lane 3.5 m wide about a line ``(N, 3)``."""
    line = np.asarray(line, dtype=float)
    across = HALF_M * left_of(unit(np.gradient(line[:, :2], axis=0)))
    left = line.copy()
    right = line.copy()
    left[:, :2] += across
    right[:, :2] -= across
    return Lane(name, line, left, right)


def straight(name, start, end, count=51):
    return lane_along(name, np.linspace(start, end, count))


def lanes_of(*lanes):
    return {lane.lane_id: lane for lane in lanes}


def raised(name, heights, y=0.0, **more):
    """A lane along x from 0 to 100 m with heights at equal steps."""
    lane = small_maps.straight(name, 0.0, 100.0, y, **more)
    s = np.linspace(0.0, 1.0, 2 * len(heights) + 1)
    z = np.interp(s, np.linspace(0.0, 1.0, len(heights)), heights)

    def lifted(line):
        xy = line[:1, :2] + s[:, None] * (line[-1, :2] - line[:1, :2])
        return np.column_stack([xy, z])

    return replace(
        lane, centre=lifted(lane.centre), left=lifted(lane.left), right=lifted(lane.right)
    )


# The upper road bends away to the left where the lower one goes straight on.
UPPER = arc("upper bend", 30.0, 80.0, start=(100.0, 0.0))
STACKED = make(
    raised("upper", [3.0, 3.0], successors=("upper bend",)),
    replace(
        UPPER,
        **{
            side: getattr(UPPER, side) + np.array([0.0, 0.0, 3.0])
            for side in ("centre", "left", "right")
        },
    ),
    small_maps.straight("lower", 0, 100, successors=("lower ahead",)),
    small_maps.straight("lower ahead", 100, 300),
)
