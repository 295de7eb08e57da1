"""Procedural roads: a list of elements becomes a lane map and the order of lanes along the main
road.

Junctions have arms, turning lanes, kerbs, crosswalks and stop lines.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import direction_of, wrap_angle
from alpasim_plugin.core.types import F64, Lane, LaneMap, Marking
from alpasim_plugin.world.path import connect, offset_line, sample_clothoid
from alpasim_plugin.world.road_strip import (
    Curve,
    Element,
    Intersection,
    Joint,
    LaneTaper,
    MapDraft,
    Profile,
    Stretch,
    Strip,
    build_strip,
    build_taper,
    make_lines,
)

_ANGLE = {"left": np.pi / 2, "straight": 0.0, "right": -np.pi / 2}
CROSSWALK_M = (1.0, 4.0)  # from the junction's border, outwards


@dataclass(frozen=True)
class Arm:
    """One road at the junction, seen from its middle outwards: ``out`` lanes leave, ``into`` lanes
    arrive; index 0 at the centre line.
    """

    name: str  # entry | left | straight | right
    heading_rad: float  # outwards
    profile: Profile  # seen outwards: forward lanes leave the junction
    joint: Joint  # points on the junction's border, named as seen outwards
    out: tuple[str, ...]
    into: tuple[str, ...]


def _check_intersection(name: str, tip: _Tip, element: Intersection) -> None:
    """Refuse a junction behind a junction, and a turn into an arm that is not there."""
    if tip.after_junction:
        raise InputError(
            f"{name}: two intersections without a road between them",
            "put a straight between them",
        )
    if element.turn not in element.arms:
        raise InputError(
            f"{name}: turn: {element.turn}, but the arms are {', '.join(element.arms)}",
            "add that arm",
        )


def _connect(
    draft: MapDraft, name: str, arms: Sequence[Arm], turn: str
) -> tuple[dict[int, tuple[str, int]], dict[int, str]]:
    """Add the lanes inside a junction.

    Returns:
        Of the main road, which leaves by the arm ``turn``: for each lane that arrives the lane
        inside and the number of the lane that it leads to, and for each oncoming lane behind the
        junction the lane inside.
    """
    forward = {}
    backward = {}
    for a, b in itertools.product(arms, arms):
        for i, j in _movements(a, b):
            lane = draft.add(_connector(name, a, b, i, j))
            draft.link(a.into[i], lane)
            draft.link(lane, b.out[j])
            if (a.name, b.name) == ("entry", turn):
                forward[i] = lane, j
            if (a.name, b.name) == (turn, "entry"):
                backward[j] = lane
    return forward, backward


def _grow_intersection(
    draft: MapDraft, name: str, following: str, tip: _Tip, element: Intersection
) -> Stretch:
    """Add a junction at the end of the road; ``following`` is the name of the strip that will leave
    it.

    Raises:
        InputError: There is no road before it, or the main road leaves by an arm that is not there.
    """
    _check_intersection(name, tip, element)
    profile = tip.profile
    side = replace(
        profile,
        forward=element.cross_lanes,
        backward=element.cross_lanes,
        median_m=0.0,
        parking_m=0.0,
    )
    reach = (
        max(profile.right_extent_m(), profile.left_extent_m(), side.right_extent_m())
        + element.corner_radius_m
    )
    x, y, yaw = tip.pose
    centre = np.array([x, y]) + reach * direction_of(yaw)
    back = replace(profile, forward=profile.backward, backward=profile.forward)
    arriving = tip.forward[: profile.forward]
    arms = [Arm("entry", yaw + np.pi, back, _outward(tip.joint), tip.backward, arriving)]
    for turn in ("right", "straight", "left"):  # counter-clockwise after the entry
        if turn not in element.arms:
            continue
        heading = yaw + _ANGLE[turn]
        arm_start = centre + reach * direction_of(heading)
        start = (float(arm_start[0]), float(arm_start[1]), float(heading))
        if turn == element.turn:
            tip.pose = start
            stub = sample_clothoid(start, 1.0, 0.0, 0.0)
            tip.joint = {key: line[0] for key, line in make_lines(stub, profile).items()}
            out = tuple(f"{following}_f{k}" for k in range(profile.forward))
            into = tuple(f"{following}_b{k}" for k in range(profile.backward))
            arms.append(Arm(turn, heading, profile, tip.joint, out, into))
        else:
            curve = sample_clothoid(start, element.arm_length_m, 0.0, 0.0)
            strip = build_strip(draft, f"{name}_{turn}", curve, side)
            arms.append(
                Arm(turn, heading, side, strip.joint(at_end=False), strip.forward, strip.backward)
            )
    forward, backward = _connect(draft, name, arms, element.turn)
    _kerbs(draft, arms)
    _mark_type(draft, element, arms, [lane for lane, _ in forward.values()])
    tip.forward, tip.backward, tip.after_junction = (), (), True
    taken = [forward.get(i, (None, None)) for i in range(len(arriving))]
    return Stretch(
        tuple(lane for lane, _ in taken),
        tuple(j for _, j in taken),
        tuple(backward.get(j) for j in range(len(arms[0].out))),
    )


def _movements(a: Arm, b: Arm) -> list[tuple[int, int]]:
    """Return (incoming index at a, outgoing index at b): straight lane by lane, left from and to
    the inner, right the outer lane.
    """
    n_in = len(a.into)
    n_out = len(b.out)
    if a is b or n_in == 0 or n_out == 0:
        return []
    angle = float(wrap_angle(b.heading_rad - a.heading_rad - np.pi))
    if abs(angle) < 0.1:
        return [(i, i) for i in range(min(n_in, n_out))]
    return [(0, 0)] if angle > 0 else [(n_in - 1, n_out - 1)]


def _connector(name: str, a: Arm, b: Arm, i: int, j: int) -> Lane:
    yaw0 = a.heading_rad + np.pi
    yaw1 = b.heading_rad
    begin = a.joint[f"bc{i}"]
    end = b.joint[f"fc{j}"]
    centre = connect(begin, yaw0, end, yaw1)
    t = np.linspace(0.0, 1.0, len(centre))
    width = (1 - t) * a.profile.lane_width_m + t * b.profile.lane_width_m
    left = offset_line(centre, width / 2)
    mid = offset_line(centre, 0.0)
    right = offset_line(centre, -width / 2)
    # An arriving lane drives against the arm's outward direction: its left edge is the one nearer
    # to the centre line.
    left[0], mid[0], right[0] = a.joint[f"b{i}"], begin, a.joint[f"b{i + 1}"]
    left[-1], mid[-1], right[-1] = b.joint[f"f{j}"], end, b.joint[f"f{j + 1}"]
    return Lane(
        f"{name}_{a.name}{i}_{b.name}{j}",
        mid,
        left,
        right,
        is_intersection=True,
        left_mark_type="none",
        right_mark_type="none",
        speed_limit_mps=a.profile.speed_limit_mps,
    )


def _kerbs(draft: MapDraft, arms: list[Arm]) -> None:
    """Join each arm's left border to the right border of the next arm counter-clockwise, and close
    the drivable ring.
    """
    ring = []
    for a, b in zip(arms, arms[1:] + arms[:1], strict=True):
        curve = connect(a.joint["left"], a.heading_rad + np.pi, b.joint["right"], b.heading_rad)
        kerb = offset_line(curve, 0.0)
        kerb[0], kerb[-1] = a.joint["left"], b.joint["right"]
        draft.road_edges.append(kerb)
        ring.append(kerb)
    draft.drivable_areas.append(np.concatenate([*ring, ring[0][:1]]))


def _mark_type(draft: MapDraft, element: Intersection, arms: list[Arm], guided: list[str]) -> None:
    for arm in arms:
        outward = np.array([*direction_of(arm.heading_rad), 0.0])
        left = arm.joint["left"]
        right = arm.joint["right"]
        middle = arm.joint["b0"]
        stop_m = 1.0
        if element.crosswalks:
            near, far = CROSSWALK_M
            corners = (
                right + near * outward,
                right + far * outward,
                left + far * outward,
                left + near * outward,
            )
            draft.crosswalks.append(np.stack([*corners, corners[0]]))
            stop_m = far + 1.0
        if arm.into:
            edge = arm.joint[f"b{len(arm.into)}"]
            draft.stop_lines.append(np.stack([middle + stop_m * outward, edge + stop_m * outward]))
    if element.guide_lines:
        for lane_id in guided:
            lane = draft.lanes[lane_id]
            assert lane.left is not None
            assert lane.right is not None
            draft.markings += [
                Marking(lane.left, "dashed_white"),
                Marking(lane.right, "dashed_white"),
            ]


def _outward(joint: Joint) -> Joint:
    """Rename the lines of a strip's end as they are seen looking back along it."""
    swap = {"f": "b", "b": "f"}
    names = {"left": "right", "right": "left"}
    return {names.get(key) or swap[key[0]] + key[1:]: point for key, point in joint.items()}


@dataclass(frozen=True)
class Road:
    """A lane map and how its main road runs through it."""

    lane_map: LaneMap
    stretches: tuple[Stretch, ...]  # in the ego's direction

    def forward_chain(self, lane: int, stretch: int = 0) -> list[tuple[str, int]]:
        """Return (lane id, index) of every stretch from one on for a car in forward lane ``lane``
        that changes only where its lane ends.

        The chain stops where the lane does not go on.
        """
        out = []
        index: int | None = lane
        for part in self.stretches[stretch:]:
            if index is None or index >= len(part.forward) or part.forward[index] is None:
                break
            out.append((str(part.forward[index]), index))
            index = part.forward_next[index]
        return out

    def backward_chain(self, lane: int) -> list[str]:
        """Return the oncoming lane ids in *their* driving direction, from the far end of the main
        road.
        """
        out: list[str] = []
        for stretch in reversed(self.stretches):
            if lane >= len(stretch.backward) or stretch.backward[lane] is None:
                out.clear()  # the lane starts nearer than this
                continue
            out.append(str(stretch.backward[lane]))
        return out


@dataclass
class _Tip:
    """The open end of the main road while it grows."""

    pose: tuple[float, float, float]
    profile: Profile
    joint: Joint = field(default_factory=dict)
    after_junction: bool = False
    forward: tuple[str, ...] = ()  # lanes by index in the next element that will be linked to it
    backward: tuple[str, ...] = ()


def build_road(
    elements: Sequence[Element],
    profile: Profile,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Road:
    """Build a road from its elements.

    Args:
        elements: In driving order; an intersection or a change of lane count cannot come first.
        profile: Cross-section at the start.
        start: x, y (metres) and heading of the reference line.

    Raises:
        InputError: No element, an element where it cannot stand, or a curve tighter than the road
            is wide.
    """
    if not elements or not isinstance(elements[0], Curve):
        raise InputError(
            f"{len(elements)} elements: the first is not a straight, arc or clothoid",
            "start with one",
        )
    draft = MapDraft()
    tip = _Tip(start, profile)
    stretches = []
    for i, element in enumerate(elements):
        name = f"s{i}"
        if isinstance(element, Curve):
            curve = sample_clothoid(
                tip.pose,
                element.length_m,
                element.start_curvature_per_m,
                element.end_curvature_per_m,
            )
            strip = build_strip(draft, name, curve, tip.profile, tip.joint)
            _append(draft, tip, curve, strip, strip.forward)
            stretches.append(
                Stretch(strip.forward, tuple(range(len(strip.forward))), strip.backward)
            )
        elif isinstance(element, LaneTaper):
            stretches.append(_grow_taper(draft, name, tip, element))
        else:
            stretches.append(_grow_intersection(draft, name, f"s{i + 1}", tip, element))
    if tip.after_junction:
        raise InputError(
            f"element {len(elements) - 1}: an intersection ends the road",
            "add a straight after it",
        )
    return Road(draft.finish(), tuple(stretches))


def _grow_taper(draft: MapDraft, name: str, tip: _Tip, element: LaneTaper) -> Stretch:
    before = tip.profile.forward
    n = before - 1 if element.kind == "merge" else before
    if n < 1 or tip.after_junction:
        raise InputError(
            f"{name} ({element.kind}): {before} forward lanes before it, or an intersection",
            "a merge needs two forward lanes and a straight, arc or clothoid before it",
        )
    narrow = replace(tip.profile, forward=n)
    curve = sample_clothoid(tip.pose, element.length_m, 0.0, 0.0)
    strip, slant = build_taper(draft, name, curve, narrow, element.kind, tip.joint)
    wide = tip.forward[before - 1]  # the lane that ends, or beside which a new one opens
    forward = (*strip.forward, slant)
    _append(draft, tip, curve, strip, forward)
    draft.link(wide, slant)
    if element.kind == "merge":
        tip.profile = narrow
        return Stretch(forward, (*range(n), n - 1), strip.backward)
    tip.profile = replace(narrow, forward=n + 1)
    return Stretch(forward, tuple(range(n + 1)), strip.backward)


def _append(draft: MapDraft, tip: _Tip, curve: F64, strip: Strip, forward: tuple[str, ...]) -> None:
    """Connect a new strip to what stands before it, and move the road's end to its end."""
    for k, before in enumerate(tip.forward):
        if k < len(strip.forward):
            draft.link(before, strip.forward[k])
        elif before.endswith("_merge"):  # a lane that ends runs into the outermost one
            draft.link(before, strip.forward[-1])
    for before, after in zip(tip.backward, strip.backward, strict=False):
        draft.link(after, before)
    x, y, yaw, _ = curve[-1].tolist()
    tip.pose, tip.joint, tip.after_junction = (x, y, yaw), strip.joint(), False
    tip.forward = forward
    tip.backward = strip.backward


def polyline(lane_map: LaneMap, lane_ids: Sequence[str]) -> F64:
    """Join the centre lines of consecutive lanes; shared end points appear once."""
    parts = [lane_map.lanes[lane_ids[0]].centre]
    parts += [lane_map.lanes[i].centre[1:] for i in lane_ids[1:]]
    return np.concatenate(parts)
