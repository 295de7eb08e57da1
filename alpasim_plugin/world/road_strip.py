"""What a procedural road is made of, and lanes side by side along one reference curve, with shared
edges and exact joints.

The cross-section and the elements follow one another along the ego's way. A taper is a strip in
which the rightmost forward lane ends or a new one opens.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, Lane, LaneMap, LaneMarkType, Marking
from alpasim_plugin.world.path import offset_line, smoothstep

Turn = Literal["left", "straight", "right"]


@dataclass(frozen=True)
class Profile:
    """Cross-section of the main road; driving is on the right. The reference line is the middle
    between the two directions.
    """

    forward: int = 1  # lanes in the ego's direction
    backward: int = 1  # oncoming lanes; 0 makes the road one-way
    lane_width_m: float = 3.5
    median_m: float = 0.0  # raised median between the directions; 0: lane markings only
    shoulder_m: float = 0.0  # paved strip outside the outer lanes
    parking_m: float = 0.0  # parking strip outside the outer lanes, instead of the shoulder
    speed_limit_mps: float | None = None
    centre_mark_type: LaneMarkType = "double_yellow"
    lane_mark_type: LaneMarkType = "dashed_white"
    edge_mark_type: LaneMarkType = "solid_white"

    @property
    def strip_m(self) -> float:
        """Width of the strip outside the outer lane."""
        return self.parking_m if self.parking_m > 0 else self.shoulder_m

    @property
    def strip_kind(self) -> str:
        """Lane kind of that strip."""
        return "parking" if self.parking_m > 0 else "shoulder"

    def right_extent_m(self) -> float:
        """Distance from the reference line to the right road edge."""
        return self.median_m / 2 + self.forward * self.lane_width_m + self.strip_m

    def left_extent_m(self) -> float:
        """Distance from the reference line to the left road edge; on a one-way road the strip lies
        left of the reference line.
        """
        return self.median_m / 2 + self.backward * self.lane_width_m + self.strip_m


@dataclass(frozen=True)
class Curve:
    """A stretch whose curvature is linear in arc length: straight, arc or clothoid. Left curvature
    is positive.
    """

    length_m: float
    start_curvature_per_m: float = 0.0
    end_curvature_per_m: float = 0.0


@dataclass(frozen=True)
class LaneTaper:
    """A straight stretch in which the rightmost forward lane ends (``merge``) or a new one opens
    (``split``).
    """

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

    ``forward_next[k]`` is the index that a car in forward lane k has in the next element, or None
    where that lane does not go on along the main road.
    """

    forward: tuple[str | None, ...]
    forward_next: tuple[int | None, ...]
    backward: tuple[str | None, ...]


Joint = dict[str, F64]  # line name -> its point (3,) at the end of a strip


@dataclass
class MapDraft:
    """A lane map while it is being built."""

    lanes: dict[str, Lane] = field(default_factory=dict)
    links: dict[str, list[str]] = field(default_factory=dict)  # lane -> its successors
    road_edges: list[F64] = field(default_factory=list)
    drivable_areas: list[F64] = field(default_factory=list)
    crosswalks: list[F64] = field(default_factory=list)
    stop_lines: list[F64] = field(default_factory=list)
    markings: list[Marking] = field(default_factory=list)

    def add(self, lane: Lane) -> str:
        """Add a lane and return its id."""
        self.lanes[lane.lane_id] = lane
        return lane.lane_id

    def link(self, before: str, after: str) -> None:
        """Make one lane the successor of another; both may be added later."""
        following = self.links.setdefault(before, [])
        if after not in following:
            following.append(after)

    def finish(self) -> LaneMap:
        """Freeze the map."""
        return LaneMap(
            {
                key: replace(lane, successors=tuple(self.links.get(key, ())))
                for key, lane in self.lanes.items()
            },
            tuple(self.road_edges),
            tuple(self.drivable_areas),
            tuple(self.crosswalks),
            tuple(self.stop_lines),
            tuple(self.markings),
            signals=(),
        )


@dataclass(frozen=True)
class Strip:
    """A built strip: lane ids from the centre outwards, and the named lines in reference order."""

    forward: tuple[str, ...]
    backward: tuple[str, ...]
    lines: dict[str, F64]

    def joint(self, at_end: bool = True) -> Joint:
        """Return the points of all lines at one end."""
        return {name: line[-1 if at_end else 0] for name, line in self.lines.items()}


def build_strip(
    draft: MapDraft, name: str, curve: F64, profile: Profile, joint: Joint | None = None
) -> Strip:
    """Add the lanes of one stretch of road to the draft.

    Line names: ``f0``.. boundaries of the forward lanes from the centre out, ``fc0``.. their
    centres, ``b0``/``bc0`` the same for the oncoming lanes, ``right`` and ``left`` the road edges.
    All lines run in reference order and have one point per station.

    Args:
        draft: Map that receives the lanes.
        name: Prefix of the lane ids.
        curve: ``(N, 4)`` x, y, heading, curvature of the reference line.
        profile: Cross-section.
        joint: End points of the strip before, copied into the first row so that consecutive lanes
            share their end points exactly.

    Raises:
        InputError: The curve is tighter than the road is wide.
    """
    tight = float(
        np.max(
            np.maximum(
                curve[:, 3] * profile.left_extent_m(), -curve[:, 3] * profile.right_extent_m()
            )
        )
    )
    if tight > 0.9:
        raise InputError(
            f"{name}: curvature {float(np.max(np.abs(curve[:, 3]))):.4f} per m on a road {profile.left_extent_m():.1f} m wide to the left and {profile.right_extent_m():.1f} m to the right: its inner edge would fold",
            "use a smaller curvature or fewer or narrower lanes",
        )
    lines = make_lines(curve, profile)
    for key, point in (joint or {}).items():
        if key in lines:
            lines[key][0] = point
    add_sides(draft, name, lines, profile)
    return _add_lanes(draft, name, lines, profile)


def _add_lanes(draft: MapDraft, name: str, lines: dict[str, F64], profile: Profile) -> Strip:
    """Add the lanes between named lines."""
    turned = {key: line[::-1].copy() for key, line in lines.items() if key.startswith("b")}
    forward = [_lane(name, "f", k, lines, profile) for k in range(profile.forward)]
    backward = [_lane(name, "b", k, turned, profile) for k in range(profile.backward)]
    return Strip(tuple(map(draft.add, forward)), tuple(map(draft.add, backward)), lines)


def make_lines(curve: F64, profile: Profile) -> dict[str, F64]:
    """Return all named lines of a strip."""
    w = profile.lane_width_m
    half = profile.median_m / 2
    lines = {f"f{j}": offset_line(curve, -half - j * w) for j in range(profile.forward + 1)}
    lines |= {f"fc{k}": offset_line(curve, -half - (k + 0.5) * w) for k in range(profile.forward)}
    # Without a median both directions share one array, so that neighbours cannot drift apart by
    # rounding.
    lines["b0"] = lines["f0"] if half == 0 else offset_line(curve, half)
    lines |= {f"b{j}": offset_line(curve, half + j * w) for j in range(1, profile.backward + 1)}
    lines |= {f"bc{k}": offset_line(curve, half + (k + 0.5) * w) for k in range(profile.backward)}
    strip = profile.strip_m > 0
    lines["right"] = (
        offset_line(curve, -profile.right_extent_m()) if strip else lines[f"f{profile.forward}"]
    )
    lines["left"] = (
        offset_line(curve, profile.left_extent_m()) if strip else lines[f"b{profile.backward}"]
    )
    return lines


def add_sides(draft: MapDraft, name: str, lines: dict[str, F64], profile: Profile) -> None:
    """Add the strips outside the outer lanes, the road edges and the drivable area."""
    outer_right = lines[f"f{profile.forward}"]
    outer_left = lines[f"b{profile.backward}"]
    if profile.strip_m > 0:
        # The strip beside oncoming lanes runs in their direction, its left edge next to the lane.
        left_strip = (
            (outer_left[::-1], lines["left"][::-1])
            if profile.backward > 0
            else (lines["left"], outer_left)
        )
        for side, (left, right) in (("r", (outer_right, lines["right"])), ("l", left_strip)):
            kind = profile.strip_kind
            limit = profile.speed_limit_mps
            lane_id = f"{name}_{kind}_{side}"
            centre = 0.5 * (left + right)
            draft.add(
                Lane(
                    lane_id,
                    centre,
                    left,
                    right,
                    kind,
                    left_mark_type="none",
                    right_mark_type="none",
                    speed_limit_mps=limit,
                )
            )
    draft.road_edges += [lines["left"], lines["right"]]
    if profile.median_m > 0 and profile.backward > 0:
        draft.road_edges += [lines["f0"], lines["b0"]]
        draft.drivable_areas += [
            _ring(lines["f0"], lines["right"]),
            _ring(lines["left"], lines["b0"]),
        ]
    else:
        draft.drivable_areas.append(_ring(lines["left"], lines["right"]))


def _ring(left: F64, right: F64) -> F64:
    return np.concatenate([left, right[::-1], left[:1]])


def _lane(
    name: str, side: Literal["f", "b"], k: int, lines: dict[str, F64], profile: Profile
) -> Lane:
    """Make the k-th lane from the centre of one direction; ``lines`` run in its driving
    direction.
    """
    outermost = k + 1 == (profile.forward if side == "f" else profile.backward)
    is_divided = profile.backward == 0 or profile.median_m > 0
    innermost_type = "solid_yellow" if is_divided else profile.centre_mark_type
    return Lane(
        f"{name}_{side}{k}",
        lines[f"{side}c{k}"],
        lines[f"{side}{k}"],
        lines[f"{side}{k + 1}"],
        left_neighbour=f"{name}_{side}{k - 1}" if k > 0 else None,
        right_neighbour=None if outermost else f"{name}_{side}{k + 1}",
        left_mark_type=innermost_type if k == 0 else profile.lane_mark_type,
        right_mark_type=profile.edge_mark_type if outermost else profile.lane_mark_type,
        speed_limit_mps=profile.speed_limit_mps,
    )


def _slanting_lane(name: str, centre: F64, left: F64, right: F64, profile: Profile) -> Lane:
    return Lane(
        name,
        centre,
        left,
        right,
        left_mark_type="none",
        right_mark_type=profile.edge_mark_type,
        speed_limit_mps=profile.speed_limit_mps,
    )


def build_taper(
    draft: MapDraft, name: str, curve: F64, profile: Profile, kind: str, joint: Joint
) -> tuple[Strip, str]:
    """Add a straight stretch with one slanting lane beside (and running into, or out of) the
    outermost straight one.

    The slanting lane keeps its full width and overlaps its neighbour, as merging lanes do in
    surveyed maps: its edges meet the neighbour's edges exactly at the narrow end.

    Args:
        draft: Map that receives the lanes.
        name: Prefix of the lane ids.
        curve: ``(N, 4)`` reference line, straight.
        profile: Cross-section at the narrow end.
        kind: ``merge`` (wide to narrow) or ``split`` (narrow to wide).
        joint: End points of the strip before.

    Returns:
        The strip with its lines at the far end, and the id of the slanting lane.
    """
    n = profile.forward
    w = profile.lane_width_m
    half = profile.median_m / 2
    s = np.hypot(curve[:, 0] - curve[0, 0], curve[:, 1] - curve[0, 1])
    share = smoothstep(s / s[-1])
    # 1 where the extra lane stands fully beside the others
    out = 1.0 - share if kind == "merge" else share
    left, centre, right = (
        offset_line(curve, -half - (n - 1 + shift + out) * w) for shift in (0.0, 0.5, 1.0)
    )
    edge = right
    if profile.strip_m > 0:
        edge = offset_line(curve, -half - (n + out) * w - profile.strip_m)
    lines = make_lines(curve, profile)
    extra = n if kind == "merge" else n - 1
    for key, point in joint.items():
        if key in lines and key != "right":
            lines[key][0] = point
    left[0] = joint[f"f{extra}"]
    centre[0] = joint[f"fc{extra}"]
    right[0] = joint[f"f{extra + 1}"]
    edge[0] = joint["right"]
    if kind == "merge":  # the narrow end: meet the neighbour exactly
        left[-1] = lines[f"f{n - 1}"][-1]
        centre[-1] = lines[f"fc{n - 1}"][-1]
        right[-1] = lines[f"f{n}"][-1]
    strip = _add_lanes(draft, name, lines, profile)
    outermost = draft.lanes[strip.forward[-1]]  # the slanting lane crosses its edge
    draft.lanes[outermost.lane_id] = replace(outermost, right_mark_type="dashed_white")
    slant = draft.add(_slanting_lane(f"{name}_{kind}", centre, left, right, profile))
    add_sides(draft, name, {**lines, f"f{n}": right, "right": edge}, profile)
    end_lines = {**lines, "right": edge}
    if kind == "split":
        end_lines |= {f"fc{n}": centre, f"f{n + 1}": right}
    return Strip(strip.forward, strip.backward, end_lines), slant
