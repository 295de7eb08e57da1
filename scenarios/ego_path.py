"""Lines that ego and actors drive along on a built road, and the tracks of scripted road users,
made once when a scene is loaded.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths, heading_of, quat_from_yaw, unit
from alpasim_plugin.core.types import F64, I64, Box, Trajectory
from alpasim_plugin.world.path import Path, smooth_path, smoothstep
from alpasim_plugin.world.roads import Road
from scenarios.schema import EgoSpec, LaneChangeSpec
from scenarios.schema_parts import NarrowGapSegment, Part

STEP_US = 50_000  # a 20 Hz track: linear interpolation errs by less than 3 mm at 7 m/s^2


@dataclass(frozen=True)
class EgoPath:
    """The ego's line and where it runs."""

    path: Path
    lane_ids: tuple[str, ...]
    stretch_s: tuple[float, ...]  # arc length at which each stretch begins, one more at the end

    def stretch_at(self, s_m: float) -> int:
        """Return the number of the road's stretch at an arc length; the first or the last one
        beyond the ends.
        """
        i = np.searchsorted(self.stretch_s, s_m, side="right") - 1
        return int(np.clip(i, 0, len(self.stretch_s) - 2))


def make_ego_path(road: Road, ego: EgoSpec, segments: Sequence[Part]) -> EgoPath:
    """Return the rear axle's line from the ego's lane at the road's beginning, moved aside in narrow
    gaps.

    Raises:
        InputError: A lane that does not exist, or that ends before the road or the lane change
            does.
    """
    chain = road.forward_chain(ego.lane)
    if not chain:
        raise InputError(
            f"lane {ego.lane}: the road has no such forward lane",
            "choose a smaller lane number",
        )
    parts = [road.lane_map.lanes[i].centre for i, _ in chain]
    for change in ego.lane_changes:
        parts, chain = _change(road, parts, chain, change, ego.start_m + change.at_m)
    if len(chain) < len(road.stretches):
        raise InputError(
            f"lane {ego.lane}: that lane leaves the main road after {chain[-1][0]} (element {len(chain) - 1})",
            "start in a lane that goes on, or change lanes before",
        )
    line = np.concatenate([parts[0]] + [part[1:] for part in parts[1:]])
    s = arc_lengths(line)
    begins = s[np.cumsum([0] + [len(part) - 1 for part in parts])]
    for segment, begin, end in zip(segments, begins, begins[1:], strict=False):
        if isinstance(segment, NarrowGapSegment) and segment.shift_m:
            quarter = (end - begin) / 4
            ramp_m = max(2 * quarter, 12.0)
            share = smoothstep((s - (begin + quarter) + ramp_m) / ramp_m) * smoothstep(
                (end - quarter + ramp_m - s) / ramp_m
            )
            d = np.gradient(line[:, :2], s, axis=0)
            d = unit(d)
            out = line.copy()
            out[:, 0] -= segment.shift_m * share * d[:, 1]
            out[:, 1] += segment.shift_m * share * d[:, 0]
            line = out
    return EgoPath(smooth_path(line), tuple(i for i, _ in chain), tuple(begins.tolist()))


def _change(
    road: Road,
    parts: list[F64],
    chain: list[tuple[str, int]],
    change: LaneChangeSpec,
    at_m: float,
) -> tuple[list[F64], list[tuple[str, int]]]:
    lengths = np.array([arc_lengths(part)[-1] for part in parts])
    begin = np.concatenate([[0.0], np.cumsum(lengths)])
    first = int(np.searchsorted(begin, at_m, side="right")) - 1
    location = f"lane change at {at_m:.0f} m to lane {change.to_lane}"
    if first >= len(parts):
        raise InputError(f"{location}: the road ends at {begin[-1]:.0f} m", "change lanes earlier")
    stretch = road.stretches[first]
    if change.to_lane >= len(stretch.forward) or stretch.forward[change.to_lane] is None:
        raise InputError(
            f"{location}: element {first} has no such lane",
            "choose a lane that exists there",
        )
    target = road.forward_chain(change.to_lane, first)
    out = parts[:first]
    new_chain = chain[:first]
    for n, (lane_id, k) in enumerate(target):
        i = first + n
        goal = road.lane_map.lanes[lane_id].centre
        if begin[min(i, len(begin) - 1)] < at_m + change.length_m:
            if i >= len(parts) or len(parts[i]) != len(goal):
                raise InputError(
                    f"{location}: the lanes part at element {i}",
                    "change lanes earlier or within a shorter length",
                )
            share = smoothstep((begin[i] + arc_lengths(parts[i]) - at_m) / change.length_m)[:, None]
            goal = (1 - share) * parts[i] + share * goal
        out.append(goal)
        new_chain.append((lane_id, k))
    return out, new_chain


def lane_chain(road: Road, ego_path: EgoPath, lane: int | str, at_s_m: float) -> tuple[str, ...]:
    """Return the lanes that a car drives along, one after the other.

    They are those of a lane of the main road that is present where the ego's line is at ``at_s_m``,
    or of a lane given by its id.

    A forward lane (``>= 0``) is followed back to where it begins and on to where it ends; an
    oncoming lane (``< 0``, -1 is next to the centre line) runs in its own driving direction; a lane
    id is followed along its first successors.

    Raises:
        InputError: No such lane there.
    """
    if isinstance(lane, str):
        return _first_successors(road, lane)
    i = ego_path.stretch_at(at_s_m)
    stretch = road.stretches[i]
    ids = []
    if lane >= 0 and lane < len(stretch.forward) and stretch.forward[lane] is not None:
        ids = [lane_id for lane_id, _ in _back(road, i, lane)] + [
            lane_id for lane_id, _ in road.forward_chain(lane, i)
        ]
    elif lane < 0 and -lane - 1 < len(stretch.backward) and stretch.backward[-lane - 1] is not None:
        ids = road.backward_chain(-lane - 1)
    if not ids:
        n = (
            sum(f is not None for f in stretch.forward),
            sum(backward is not None for backward in stretch.backward),
        )
        raise InputError(
            f"lane {lane}: {n[0]} forward and {n[1]} oncoming lanes at {at_s_m:.0f} m",
            "choose one that exists",
        )
    return tuple(ids)


def _first_successors(road: Road, lane_id: str) -> tuple[str, ...]:
    """Return a lane and the lanes behind it, each time the first successor, until one comes again."""
    lanes = road.lane_map.lanes
    if lane_id not in lanes:
        raise InputError(
            f"lane {lane_id!r}: the road's lanes are {', '.join(sorted(lanes))}",
            "choose one of them",
        )
    chain = [lane_id]
    while lanes[chain[-1]].successors and len(chain) < 100:
        following = lanes[chain[-1]].successors[0]
        if following in chain:
            break
        chain.append(following)
    return tuple(chain)


def _back(road: Road, stretch: int, lane: int) -> list[tuple[str, int]]:
    out = []
    k = lane
    for part in reversed(road.stretches[:stretch]):
        before = [
            j for j, nxt in enumerate(part.forward_next) if nxt == k and part.forward[j] is not None
        ]
        if not before:
            break
        k = before[0]
        out.append((str(part.forward[k]), k))
    return out[::-1]


def grid(end_us: int) -> I64:
    """Return times from 0 in steps; the last one is the end itself."""
    return np.append(np.arange(0, end_us, STEP_US), np.int64(end_us))


def driven_m(t_us: I64, rows: Sequence[tuple[float, float]], s0_m: float) -> F64:
    """Return arc lengths ``(T,)`` of a body whose speed is given by rows (time in seconds after
    ``t_us[0]``, m/s), linear in between, constant outside.
    """
    times, values = np.array(rows).T
    speed = np.interp((t_us - t_us[0]) * 1e-6, times, values)
    dt = np.diff(t_us) * 1e-6
    return np.concatenate([[s0_m], s0_m + np.cumsum(dt * 0.5 * (speed[1:] + speed[:-1]))])


def track_on_path(
    path: Path, t_us: I64, s_m: F64, box: Box, offset_m: npt.ArrayLike = 0.0
) -> Trajectory:
    """Return the box-centre track of a body at arc lengths ``(T,)`` of a path, cut where the path
    ends (the body leaves the scene).

    A lateral offset that changes turns the body by the slope of its motion.
    """
    offset = np.broadcast_to(offset_m, s_m.shape)
    keep = (s_m >= 0) & (s_m <= path.length_m)
    if not keep.all():
        keep = np.arange(len(s_m)) < (int(np.argmin(keep)) or 0)
    xyz, yaw = path.at(s_m, offset)
    if len(s_m) > 1 and np.ptp(offset) > 0:
        ds = np.gradient(s_m)
        dd = np.gradient(offset)
        yaw = yaw + np.arctan2(dd, np.maximum(ds, 1e-6))
    xyz = xyz + np.array([0.0, 0.0, box.height_m / 2])
    return Trajectory(t_us[keep], xyz[keep], quat_from_yaw(yaw[keep]))


def walk_track(
    start: F64, end: F64, t_us: I64, begin_us: int, speed_mps: float, box: Box
) -> Trajectory:
    """Return the track of someone who stands at ``start``, walks to ``end`` from ``begin_us`` on,
    and stands there.

    Speed rises and falls within 0.4 s at the ends; the mean crossing is at ``speed_mps``.
    """
    distance = float(np.hypot(*(end - start)[:2]))
    t_s = (t_us - begin_us) * 1e-6
    ramp_s = min(0.4, distance / speed_mps / 2)
    total_s = distance / speed_mps + ramp_s
    t = np.clip(t_s, 0.0, total_s)
    up = np.minimum(t, ramp_s)
    down = np.maximum(t - (total_s - ramp_s), 0.0)
    s = speed_mps * (
        up * up / (2 * ramp_s) + np.maximum(t - ramp_s, 0.0) - down * down / (2 * ramp_s)
    )
    share = np.clip(s / distance, 0.0, 1.0)[:, None]
    xyz = start + share * (end - start)
    xyz = xyz + np.array([0.0, 0.0, box.height_m / 2])
    yaw = heading_of(end - start)
    return Trajectory(t_us, xyz, quat_from_yaw(np.full(len(t_us), yaw)))


def standing_track(xyz: F64, yaw_rad: float, t_us: I64, box: Box) -> Trajectory:
    """Return the track of a body that never moves: two poses, at the first and the last time."""
    middle = xyz + np.array([0.0, 0.0, box.height_m / 2])
    return Trajectory(t_us[[0, -1]], np.tile(middle, (2, 1)), quat_from_yaw(np.full(2, yaw_rad)))
