"""Lanes side by side along one reference curve, with shared edges and exact joints."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, Lane, LaneMap, Marking, Paint
from alpasim_plugin.world.curves import offset_line
from alpasim_plugin.world.road_elements import Profile

Joint = dict[str, F64]  # line name -> its point (3,) at the end of a strip


@dataclass
class MapDraft:
    """A lane map while it is being built."""

    lanes: dict[str, Lane] = field(default_factory=dict)
    road_edges: list[F64] = field(default_factory=list)
    drivable_areas: list[F64] = field(default_factory=list)
    crosswalks: list[F64] = field(default_factory=list)
    stop_lines: list[F64] = field(default_factory=list)
    markings: list[Marking] = field(default_factory=list)

    def add(self, lane: Lane) -> str:
        """Add a lane and return its id."""
        self.lanes[lane.lane_id] = lane
        return lane.lane_id

    def link(self, before: str | None, after: str | None) -> None:
        """Make one lane the successor of another."""
        if before is None or after is None:
            return
        lane = self.lanes[before]
        if after not in lane.successors:
            self.lanes[before] = replace(lane, successors=(*lane.successors, after))

    def finish(self) -> LaneMap:
        """Freeze the map."""
        return LaneMap(
            dict(self.lanes),
            tuple(self.road_edges),
            tuple(self.drivable_areas),
            tuple(self.crosswalks),
            tuple(self.stop_lines),
            tuple(self.markings),
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


def build_strip(draft: MapDraft, name: str, curve: F64, profile: Profile, joint: Joint | None = None) -> Strip:
    """Add the lanes of one stretch of road to the draft.

    Line names: ``f0``.. boundaries of the forward lanes from the centre out, ``fc0``.. their centres, ``b0``/``bc0`` the same for the
    oncoming lanes, ``right`` and ``left`` the road edges. All lines run in reference order and have one point per station.

    Args:
        draft: Map that receives the lanes.
        name: Prefix of the lane ids.
        curve: ``(N, 4)`` x, y, heading, curvature of the reference line.
        profile: Cross-section.
        joint: End points of the strip before, copied into the first row so that consecutive lanes share their end points exactly.

    Raises:
        InputError: The curve is tighter than the road is wide.
    """
    _check_width(name, curve, profile)
    lines = make_lines(curve, profile)
    if joint is not None:
        for key, line in lines.items():
            if key in joint:
                line[0] = joint[key]
    forward = tuple(draft.add(_lane(name, "f", k, lines, profile)) for k in range(profile.forward))
    turned = reverse(lines)
    backward = tuple(draft.add(_lane(name, "b", k, turned, profile)) for k in range(profile.backward))
    add_sides(draft, name, lines, profile)
    return Strip(forward, backward, lines)


def make_lines(curve: F64, profile: Profile) -> dict[str, F64]:
    """Return all named lines of a strip."""
    w, half = profile.lane_width_m, profile.median_m / 2
    lines = {f"f{j}": offset_line(curve, -half - j * w) for j in range(profile.forward + 1)}
    lines |= {f"fc{k}": offset_line(curve, -half - (k + 0.5) * w) for k in range(profile.forward)}
    # Without a median both directions share one array, so that neighbours cannot drift apart by rounding.
    lines["b0"] = lines["f0"] if half == 0 else offset_line(curve, half)
    lines |= {f"b{j}": offset_line(curve, half + j * w) for j in range(1, profile.backward + 1)}
    lines |= {f"bc{k}": offset_line(curve, half + (k + 0.5) * w) for k in range(profile.backward)}
    strip = profile.strip_m > 0
    lines["right"] = offset_line(curve, -profile.right_extent_m()) if strip else lines[f"f{profile.forward}"]
    lines["left"] = offset_line(curve, profile.left_extent_m()) if strip else lines[f"b{profile.backward}"]
    return lines


def reverse(lines: dict[str, F64]) -> dict[str, F64]:
    """Return the oncoming lanes' lines in their own driving direction; neighbours go on sharing one array."""
    return {key: line[::-1].copy() for key, line in lines.items() if key.startswith("b")}


def add_sides(draft: MapDraft, name: str, lines: dict[str, F64], profile: Profile) -> None:
    """Add the strips outside the outer lanes, the road edges and the drivable area."""
    outer_right, outer_left = lines[f"f{profile.forward}"], lines[f"b{profile.backward}"]
    if profile.strip_m > 0:
        for side, inner, outer, flip in (("r", outer_right, lines["right"], False), ("l", outer_left, lines["left"], profile.backward > 0)):
            left, right = (inner, outer) if side == "r" else ((inner, outer) if flip else (outer, inner))
            left, right = (left[::-1], right[::-1]) if flip else (left, right)
            draft.add(
                Lane(f"{name}_{profile.strip_kind}_{side}", 0.5 * (left + right), left, right, profile.strip_kind,
                     left_paint="none", right_paint="none", speed_limit_mps=profile.speed_limit_mps)
            )  # fmt: skip
    draft.road_edges += [lines["left"], lines["right"]]
    if profile.median_m > 0 and profile.backward > 0:
        draft.road_edges += [lines["f0"], lines["b0"]]
        draft.drivable_areas += [_ring(lines["f0"], lines["right"]), _ring(lines["left"], lines["b0"])]
    else:
        draft.drivable_areas.append(_ring(lines["left"], lines["right"]))


def _ring(left: F64, right: F64) -> F64:
    return np.concatenate([left, right[::-1], left[:1]])


def inner_paint(profile: Profile) -> Paint:
    """Return the paint left of the innermost lane."""
    return "solid_yellow" if profile.backward == 0 or profile.median_m > 0 else profile.centre_paint


def _lane(name: str, side: Literal["f", "b"], k: int, lines: dict[str, F64], profile: Profile) -> Lane:
    """Make the k-th lane from the centre of one direction; ``lines`` run in its driving direction."""
    outermost = k + 1 == (profile.forward if side == "f" else profile.backward)
    return Lane(
        f"{name}_{side}{k}",
        lines[f"{side}c{k}"],
        lines[f"{side}{k}"],
        lines[f"{side}{k + 1}"],
        left_neighbour=f"{name}_{side}{k - 1}" if k > 0 else None,
        right_neighbour=None if outermost else f"{name}_{side}{k + 1}",
        left_paint=inner_paint(profile) if k == 0 else profile.lane_paint,
        right_paint=profile.edge_paint if outermost else profile.lane_paint,
        speed_limit_mps=profile.speed_limit_mps,
    )


def _check_width(name: str, curve: F64, profile: Profile) -> None:
    tight = float(np.max(np.maximum(curve[:, 3] * profile.left_extent_m(), -curve[:, 3] * profile.right_extent_m())))
    if tight > 0.9:
        raise InputError(
            "building a road",
            name,
            f"curvature {float(np.max(np.abs(curve[:, 3]))):.4f} per m on a road {profile.left_extent_m():.1f} m wide to the left "
            f"and {profile.right_extent_m():.1f} m to the right: its inner edge would fold",
            "use a smaller curvature or fewer or narrower lanes",
        )
