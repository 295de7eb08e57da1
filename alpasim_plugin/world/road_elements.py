"""What a procedural road is made of: the cross-section and the elements that follow one another along the ego's way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from alpasim_plugin.core.types import Paint

Turn = Literal["left", "straight", "right"]


@dataclass(frozen=True)
class Profile:
    """Cross-section of the main road; driving is on the right. The reference line is the middle between the two directions."""

    forward: int = 1  # lanes in the ego's direction
    backward: int = 1  # oncoming lanes; 0 makes the road one-way
    lane_width_m: float = 3.5
    median_m: float = 0.0  # raised median between the directions; 0: paint only
    shoulder_m: float = 0.0  # paved strip outside the outer lanes
    parking_m: float = 0.0  # parking strip outside the outer lanes, instead of the shoulder
    speed_limit_mps: float | None = None
    centre_paint: Paint = "double_yellow"
    lane_paint: Paint = "dashed_white"
    edge_paint: Paint = "solid_white"

    @property
    def strip_m(self) -> float:
        """Width of the strip outside the outer lane."""
        return self.parking_m if self.parking_m > 0 else self.shoulder_m

    @property
    def strip_kind(self) -> str:
        """Lane kind of that strip."""
        return "parking" if self.parking_m > 0 else "shoulder"

    def right_extent_m(self, forward: int | None = None) -> float:
        """Distance from the reference line to the right road edge."""
        n = self.forward if forward is None else forward
        return self.median_m / 2 + n * self.lane_width_m + self.strip_m

    def left_extent_m(self) -> float:
        """Distance from the reference line to the left road edge; on a one-way road the strip lies left of the reference line."""
        return self.median_m / 2 + self.backward * self.lane_width_m + self.strip_m


@dataclass(frozen=True)
class Curve:
    """A stretch whose curvature is linear in arc length: straight, arc or clothoid. Left curvature is positive."""

    length_m: float
    start_curvature_per_m: float = 0.0
    end_curvature_per_m: float = 0.0


@dataclass(frozen=True)
class LaneTaper:
    """A straight stretch in which the rightmost forward lane ends (``merge``) or a new one opens (``split``)."""

    kind: Literal["merge", "split"]
    length_m: float


@dataclass(frozen=True)
class Intersection:
    """A junction at the end of the stretch before it; the main road leaves it by ``turn``."""

    turn: Turn = "straight"
    arms: tuple[Turn, ...] = ("left", "straight", "right")  # arms that exist, seen from the entry
    cross_lanes: int = 1  # lanes per direction on arms other than the entry and the exit
    arm_length_m: float = 40.0
    corner_radius_m: float = 8.0
    crosswalks: bool = True
    guide_lines: bool = True  # dashed lines through the junction along the main road


Element = Curve | LaneTaper | Intersection


@dataclass(frozen=True)
class Stretch:
    """The main road's lanes in one element; index 0 is next to the centre line.

    ``forward_next[k]`` is the index that a car in forward lane k has in the next element, or None where that lane does not go on along
    the main road.
    """

    forward: tuple[str | None, ...]
    forward_next: tuple[int | None, ...]
    backward: tuple[str | None, ...]
