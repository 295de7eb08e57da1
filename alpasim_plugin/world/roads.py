"""Procedural roads: a list of elements becomes a lane map and the order of lanes along the main road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, LaneMap
from alpasim_plugin.world.curves import sample_clothoid
from alpasim_plugin.world.road_elements import Curve, Element, Intersection, LaneTaper, Profile, Stretch
from alpasim_plugin.world.road_intersection import Junction, build_intersection
from alpasim_plugin.world.road_strip import Joint, MapDraft, Strip, build_strip
from alpasim_plugin.world.road_taper import build_taper


@dataclass(frozen=True)
class Road:
    """A lane map and how its main road runs through it."""

    lane_map: LaneMap
    stretches: tuple[Stretch, ...]  # in the ego's direction

    def forward_chain(self, lane: int) -> list[tuple[str, int]]:
        """Return (lane id, index) of every stretch for a car that starts in forward lane ``lane`` and changes only where its lane ends.

        The chain stops where the lane does not go on.
        """
        out: list[tuple[str, int]] = []
        at: int | None = lane
        for stretch in self.stretches:
            if at is None or at >= len(stretch.forward) or stretch.forward[at] is None:
                break
            out.append((str(stretch.forward[at]), at))
            at = stretch.forward_next[at]
        return out

    def backward_chain(self, lane: int) -> list[str]:
        """Return the oncoming lane ids in *their* driving direction, from the far end of the main road."""
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
    joint: Joint | None = None
    strip: Strip | None = None
    junction: Junction | None = None
    forward: tuple[str | None, ...] = ()  # lane ids by index in the next element that will be linked to it
    backward: tuple[str | None, ...] = ()


def build_road(
    elements: Sequence[Element], profile: Profile, start: tuple[float, float, float] = (0.0, 0.0, 0.0), step_m: float = 1.0
) -> Road:
    """Build a road from its elements.

    Args:
        elements: In driving order; an intersection or a change of lane count cannot come first.
        profile: Cross-section at the start.
        start: x, y (metres) and heading of the reference line.
        step_m: Distance between stations.

    Raises:
        InputError: No element, an element where it cannot stand, or a curve tighter than the road is wide.
    """
    if not elements or not isinstance(elements[0], Curve):
        raise InputError("building a road", f"{len(elements)} elements", "the first is not a straight, arc or clothoid", "start with one")
    draft, tip, stretches = MapDraft(), _Tip(start, profile), []
    for i, element in enumerate(elements):
        name = f"s{i}"
        if isinstance(element, Curve):
            stretches.append(_grow_curve(draft, name, tip, element, step_m))
        elif isinstance(element, LaneTaper):
            stretches.append(_grow_taper(draft, name, tip, element, step_m))
        else:
            stretches.append(_grow_intersection(draft, name, tip, element))
    if tip.junction is not None:
        raise InputError("building a road", f"element {len(elements) - 1}", "an intersection ends the road", "add a straight after it")
    return Road(draft.finish(), tuple(stretches))


def _grow_curve(draft: MapDraft, name: str, tip: _Tip, element: Curve, step_m: float) -> Stretch:
    curve = sample_clothoid(tip.pose, element.length_m, element.start_curvature_per_m, element.end_curvature_per_m, step_m)
    strip = build_strip(draft, name, curve, tip.profile, tip.joint)
    _link(draft, tip, strip)
    indices = tuple(range(len(strip.forward)))
    _move(tip, curve, strip, strip.forward, strip.backward)
    return Stretch(strip.forward, indices, strip.backward)


def _grow_taper(draft: MapDraft, name: str, tip: _Tip, element: LaneTaper, step_m: float) -> Stretch:
    before = tip.profile.forward
    narrow = replace(tip.profile, forward=before - 1 if element.kind == "merge" else before)
    if narrow.forward < 1 or tip.junction is not None:
        raise InputError(
            "building a road", f"{name} ({element.kind})", f"{before} forward lanes before it" if narrow.forward < 1 else "follows an "
            "intersection", "a merge needs two forward lanes and a straight, arc or clothoid before it",
        )  # fmt: skip
    curve = sample_clothoid(tip.pose, element.length_m, 0.0, 0.0, step_m)
    strip, slant = build_taper(draft, name, curve, narrow, element.kind, tip.joint)
    _link(draft, tip, strip)
    n = narrow.forward
    if element.kind == "merge":
        draft.link(tip.forward[n], slant)
        _move(tip, curve, strip, strip.forward, strip.backward)
        draft_next = (*strip.forward, slant)
        tip.forward = draft_next  # the slanting lane's successor is the last straight lane's
        tip.profile = narrow
        stretch = Stretch(draft_next, (*range(n), n - 1), strip.backward)
    else:
        draft.link(tip.forward[n - 1], slant)
        _move(tip, curve, strip, (*strip.forward, slant), strip.backward)
        tip.profile = replace(narrow, forward=n + 1)
        stretch = Stretch((*strip.forward, slant), tuple(range(n + 1)), strip.backward)
    return stretch


def _grow_intersection(draft: MapDraft, name: str, tip: _Tip, element: Intersection) -> Stretch:
    if tip.joint is None or tip.junction is not None or tip.strip is None:
        raise InputError("building a road", name, "two intersections without a road between them", "put a straight between them")
    n = tip.profile.forward
    forward = tuple(str(f) for f in tip.forward[:n])
    junction = build_intersection(draft, name, tip.pose, element, tip.profile, tip.joint, forward, tuple(str(b) for b in tip.backward))
    tip.pose, tip.joint, tip.junction, tip.strip = junction.pose, junction.joint, junction, None
    tip.forward, tip.backward = (), ()
    return Stretch(junction.forward, junction.forward_next, junction.backward)


def _link(draft: MapDraft, tip: _Tip, strip: Strip) -> None:
    """Connect a new strip to what stands before it."""
    if tip.junction is not None:
        for connector, k in tip.junction.exits:
            draft.link(connector, strip.forward[k])
        for k, connector in tip.junction.entries:
            draft.link(strip.backward[k], connector)
        tip.junction = None
        return
    for k, before in enumerate(tip.forward):
        draft.link(before, strip.forward[min(k, len(strip.forward) - 1)] if k < len(strip.forward) or _is_slant(before) else None)
    for before, after in zip(tip.backward, strip.backward, strict=False):
        draft.link(after, before)


def _is_slant(lane_id: str | None) -> bool:
    return lane_id is not None and lane_id.endswith("_merge")


def _move(tip: _Tip, curve: F64, strip: Strip, forward: tuple[str | None, ...], backward: tuple[str | None, ...]) -> None:
    end = curve[-1]
    tip.pose = (float(end[0]), float(end[1]), float(end[2]))
    tip.joint, tip.strip, tip.forward, tip.backward = strip.joint(), strip, forward, backward


def polyline(lane_map: LaneMap, lane_ids: Sequence[str]) -> F64:
    """Join the centre lines of consecutive lanes; shared end points appear once."""
    parts = [lane_map.lanes[lane_ids[0]].centre]
    parts += [lane_map.lanes[i].centre[1:] for i in lane_ids[1:]]
    return np.concatenate(parts)
