"""Lines that ego and actors drive along on a built road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths
from alpasim_plugin.core.types import F64
from alpasim_plugin.world.path import Path, smooth_path, smoothstep
from alpasim_plugin.world.roads import Road


@dataclass(frozen=True)
class LaneChange:
    """A change of the ego's lane."""

    at_m: float
    to_lane: int
    length_m: float


@dataclass(frozen=True)
class LateralShift:
    """A lateral shift of the ego's line and back: full from ``begin_m`` to ``end_m``, ``ramp_m`` on either side."""

    begin_m: float
    end_m: float
    ramp_m: float
    shift_m: float


@dataclass(frozen=True)
class EgoPath:
    """The ego's line and where it runs."""

    path: Path
    lane_ids: tuple[str, ...]
    stretch_s: tuple[float, ...]  # arc length at which each stretch begins, one more at the end

    def stretch_at(self, s_m: float) -> int:
        """Return the number of the road's stretch at an arc length; the first or the last one beyond the ends."""
        i = np.searchsorted(self.stretch_s, s_m, side="right") - 1
        return int(np.clip(i, 0, len(self.stretch_s) - 2))


def make_ego_path(road: Road, lane: int, changes: Sequence[LaneChange] = (), shifts: Sequence[LateralShift] = ()) -> EgoPath:
    """Return the rear axle's line from forward lane ``lane`` at the road's beginning.

    Raises:
        InputError: A lane that does not exist, or that ends before the road or the lane change does.
    """
    chain = road.forward_chain(lane)
    if not chain:
        raise InputError("placing the ego", f"lane {lane}", "the road has no such forward lane", "choose a smaller lane number")
    parts = [road.lane_map.lanes[i].centre for i, _ in chain]
    for change in changes:
        parts, chain = _change(road, parts, chain, change)
    if len(chain) < len(road.stretches):
        found = f"that lane leaves the main road after {chain[-1][0]} (element {len(chain) - 1})"
        raise InputError("placing the ego", f"lane {lane}", found, "start in a lane that goes on, or change lanes before")
    line = np.concatenate([parts[0]] + [p[1:] for p in parts[1:]])
    s = arc_lengths(line)
    begins = np.cumsum([0] + [len(p) - 1 for p in parts])
    for shift in shifts:
        line = _shift(line, s, shift)
    return EgoPath(smooth_path(line), tuple(i for i, _ in chain), tuple(float(s[i]) for i in begins))


def _change(road: Road, parts: list[F64], chain: list[tuple[str, int]], change: LaneChange) -> tuple[list[F64], list[tuple[str, int]]]:
    lengths = np.array([arc_lengths(p)[-1] for p in parts])
    begin = np.concatenate([[0.0], np.cumsum(lengths)])
    first = int(np.searchsorted(begin, change.at_m, side="right")) - 1
    where = f"lane change at {change.at_m:.0f} m to lane {change.to_lane}"
    if first >= len(parts):
        raise InputError("placing the ego", where, f"the road ends at {begin[-1]:.0f} m", "change lanes earlier")
    stretch = road.stretches[first]
    if change.to_lane >= len(stretch.forward) or stretch.forward[change.to_lane] is None:
        raise InputError("placing the ego", where, f"element {first} has no such lane", "choose a lane that exists there")
    target = road.forward_chain(change.to_lane, first)
    out, new_chain = parts[:first], chain[:first]
    for n, (lane_id, k) in enumerate(target):
        i = first + n
        goal = road.lane_map.lanes[lane_id].centre
        if begin[min(i, len(begin) - 1)] < change.at_m + change.length_m:
            if i >= len(parts) or len(parts[i]) != len(goal):
                do_this = "change lanes earlier or within a shorter length"
                raise InputError("placing the ego", where, f"the lanes part at element {i}", do_this)
            share = smoothstep((begin[i] + arc_lengths(parts[i]) - change.at_m) / change.length_m)[:, None]
            goal = (1 - share) * parts[i] + share * goal
        out.append(goal)
        new_chain.append((lane_id, k))
    return out, new_chain


def _shift(line: F64, s: F64, shift: LateralShift) -> F64:
    share = smoothstep((s - shift.begin_m + shift.ramp_m) / shift.ramp_m) * smoothstep((shift.end_m + shift.ramp_m - s) / shift.ramp_m)
    d = np.gradient(line[:, :2], s, axis=0)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    out = line.copy()
    out[:, 0] -= shift.shift_m * share * d[:, 1]
    out[:, 1] += shift.shift_m * share * d[:, 0]
    return out


def lane_chain(road: Road, ego_path: EgoPath, lane: int | str, at_s_m: float) -> tuple[str, ...]:
    """Return the lanes that a car drives along, one after the other.

    They are those of a lane of the main road that is present where the ego's line is at ``at_s_m``, or of a lane given by its id.

    A forward lane (``>= 0``) is followed back to where it begins and on to where it ends; an oncoming lane (``< 0``, -1 is next to
    the centre line) runs in its own driving direction; a lane id is followed along its first successors.

    Raises:
        InputError: No such lane there.
    """
    if isinstance(lane, str):
        return tuple(_follow(road, lane))
    i = ego_path.stretch_at(at_s_m)
    stretch = road.stretches[i]
    ids: list[str] = []
    if lane >= 0 and lane < len(stretch.forward) and stretch.forward[lane] is not None:
        ids = [lane_id for lane_id, _ in _back(road, i, lane)] + [lane_id for lane_id, _ in road.forward_chain(lane, i)]
    elif lane < 0 and -lane - 1 < len(stretch.backward) and stretch.backward[-lane - 1] is not None:
        ids = road.backward_chain(-lane - 1)
    if not ids:
        n = sum(f is not None for f in stretch.forward), sum(b is not None for b in stretch.backward)
        found = f"{n[0]} forward and {n[1]} oncoming lanes at {at_s_m:.0f} m"
        raise InputError("placing an actor", f"lane {lane}", found, "choose one that exists")
    return tuple(ids)


def _back(road: Road, stretch: int, lane: int) -> list[tuple[str, int]]:
    out: list[tuple[str, int]] = []
    k = lane
    for part in reversed(road.stretches[:stretch]):
        before = [j for j, nxt in enumerate(part.forward_next) if nxt == k and part.forward[j] is not None]
        if not before:
            break
        k = before[0]
        out.append((str(part.forward[k]), k))
    return out[::-1]


def _follow(road: Road, lane_id: str) -> list[str]:
    lanes = road.lane_map.lanes
    if lane_id not in lanes:
        raise InputError("placing an actor", f"lane {lane_id!r}", f"the road's lanes are {', '.join(lanes)}", "choose one of them")
    out = [lane_id]
    while lanes[out[-1]].successors and len(out) < 100:
        following = lanes[out[-1]].successors[0]
        if following in out:
            break
        out.append(following)
    return out
