"""The vector map of a scene; see `alpasim_plugin.core.types` for the conventions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
LEVEL_M = 3.0  # a stop line farther above or below belongs to another road
MOST_TURNED = (
    0.5  # cosine between a drive and the traffic that a light holds: who crosses is not held
)

LaneMarkType = Literal[
    "none",
    "solid_white",
    "dashed_white",
    "solid_yellow",
    "dashed_yellow",
    "double_yellow",
    "unknown",
]


@dataclass(frozen=True)
class Box:
    """Full sizes of a cuboid in its own frame (x length, y width, z height)."""

    length_m: float
    width_m: float
    height_m: float

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Return length, width and height."""
        return self.length_m, self.width_m, self.height_m


@dataclass(frozen=True)
class Lane:
    """One lane; edges are seen in driving direction."""

    lane_id: str
    centre: F64  # (N, 3) metres, world
    left: F64 | None  # (L, 3) or None where the map has no edge
    right: F64 | None  # (R, 3) or None
    kind: str = "vehicle"  # vehicle | bike | bus | shoulder | parking
    successors: tuple[str, ...] = ()
    left_neighbour: str | None = None
    right_neighbour: str | None = None
    left_mark_type: LaneMarkType = "unknown"
    right_mark_type: LaneMarkType = "unknown"
    is_intersection: bool = False
    speed_limit_mps: float | None = None
    is_motorway: bool = False  # the map says that its road is one


@dataclass(frozen=True)
class Marking:
    """A lane marking that the map gives as a line of its own, not as a lane's edge."""

    xyz: F64  # (N, 3) metres, world
    mark_type: LaneMarkType


@dataclass(frozen=True)
class Signal:
    """A traffic light that repeats one cycle, and the line at which one waits for it."""

    stop: F64  # (2, 3) metres, world: the ends of the line
    heading_rad: float  # of the traffic that it holds back
    phases: tuple[tuple[str, int], ...]  # colour and microseconds, one after the other
    offset_us: int = 0  # when a first phase begins
    name: str = ""
    lanes: tuple[str, ...] = ()  # that it holds back, or that people cross
    pedestrians: bool = False  # it holds back people who cross, and no vehicle
    head: F64 | None = None  # (3,) metres, world: the middle of its lamps; None: not known
    # of a line to give way at: lanes whose traffic goes first; empty: whoever comes
    yields_to: tuple[str, ...] = ()
    yields_to_waiting: tuple[str, ...] = ()  # those of them whose traffic goes first from rest too

    def colour_at(self, t_us: int) -> str:
        """Return the colour at a time.

        >>> Signal(np.zeros((2, 3)), 0.0, (("red", 30), ("green", 20)), offset_us=10).colour_at(5)
        'green'
        """
        left_us = (t_us - self.offset_us) % sum(lasts_us for _, lasts_us in self.phases)
        for colour, lasts_us in self.phases:
            if left_us < lasts_us:
                return colour
            left_us -= lasts_us
        raise AssertionError("a time of a cycle is in one of its phases")

    def crossings(self, line: F64, origin: F64) -> list[tuple[int, float]]:
        """Return where a line ``(N, 3)`` passes the stop line in the direction of its traffic, to
        `MOST_TURNED`: the vertex before, and the share of the way to the next one.

        Args:
            line: Metres, relative to ``origin``.
            origin: ``(3,)`` world point.
        """
        start = self.stop[0] - origin
        along = self.stop[1, :2] - self.stop[0, :2]
        normal = np.array([-along[1], along[0]])
        direction = np.array([np.cos(self.heading_rad), np.sin(self.heading_rad)])
        normal *= np.sign(normal @ direction)
        beyond = (line[:, :2] - start[:2]) @ normal
        crossings = []
        for k in np.flatnonzero((beyond[:-1] < 0.0) & (beyond[1:] >= 0.0)).tolist():
            share = float(beyond[k] / (beyond[k] - beyond[k + 1]))
            step = line[k + 1, :2] - line[k, :2]
            projection = (line[k, :2] + share * step - start[:2]) @ along
            runs_along = step @ direction >= MOST_TURNED * np.hypot(*step)
            on_level = abs(line[k, 2] - start[2]) <= LEVEL_M
            if 0.0 <= projection <= along @ along and runs_along and on_level:
                crossings.append((k, share))
        return crossings


@dataclass(frozen=True)
class LaneMap:
    """Vector map of one scene."""

    lanes: Mapping[str, Lane]
    road_edges: tuple[F64, ...] = ()  # each (N, 3): the border of the drivable surface
    drivable_areas: tuple[F64, ...] = ()  # each (N, 3) ring
    crosswalks: tuple[F64, ...] = ()  # each (N, 3) ring
    stop_lines: tuple[F64, ...] = ()  # each (N, 3)
    markings: tuple[Marking, ...] = ()
    poles: tuple[F64, ...] = ()  # each (N, 3) polyline
    signs: tuple[tuple[F64, Box], ...] = ()  # (T_world_sign (4, 4), size)
    # traffic lights with their states; None: not known, also where there is none
    signals: tuple[Signal, ...] | None = None
    give_way: tuple[Signal, ...] = ()  # lines without phases, at which one lets others pass


@dataclass(frozen=True)
class Route:
    """Where the ego should go: a polyline in the world, without time."""

    xyz: F64  # (N, 3) metres, world
    lane_ids: tuple[str, ...] = ()  # lanes that it follows, where the map has them


@dataclass(frozen=True)
class HeightField:
    """Ground height on a regular grid, bilinear in between, constant beyond its border."""

    x0_m: float
    y0_m: float
    cell_m: float
    z: F64  # (Ny, Nx) metres, world
