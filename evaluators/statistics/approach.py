"""The seconds before a failure, measured in a log against the recorded drive at the same place, the
posted speed limit there and the road users around.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.core.geometry import (
    arc_lengths,
    cross,
    heading_of,
    interpolate,
    rectangle_corners,
    resample,
    speeds,
    wrap_angle,
)
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.core.types import F64, I64, Actor, RolloutLog
from evaluators.metrics.presets import PRESETS
from evaluators.metrics.route import moving, on_route, recorded_path

BEFORE_US = 6_000_000  # of the failure, that are measured
BEND_M = 15.0  # of the recorded path, over which a bend is measured: behind a place and ahead of it
LEAST_BEND_RAD = 0.12  # within twice that length: a radius of 250 m
LANE_M = 3.0  # a lane farther from a place posts no limit for it
SAME_WAY_RAD = 0.8
STOPS_US = 8_000_000  # in which a braking ego has come to its least gap
AHEAD_M = 60.0  # how far ahead a road user counts


@dataclass(frozen=True)
class Neighbour:
    """The nearest road user ahead of the ego at an instant.

    Attributes:
        actor: The road user.
        gap_m: Between the two boxes.
        ahead_m, left_m: Its box centre from the ego's, in the ego's axes.
        towards: Whether it drives against the ego's heading.
        is_in_way: Whether it lies on the ego's way: less than half a width and a metre beside the
            straight line ahead.
    """

    actor: Actor
    gap_m: float
    ahead_m: float
    left_m: float
    towards: bool
    is_in_way: bool


@dataclass(frozen=True)
class Approach:
    """The ego's box centre over time, up to a failure.

    Attributes:
        t_us: ``(T,)`` steps of the log, at most `BEFORE_US` before the failure.
        speed_mps: ``(T,)``.
        recorded_mps: ``(T,)`` speed of the recording where it passed the ego's place; NaN behind its
            end.
        along_m: ``(T,)`` place along the recorded path.
        lateral_m: ``(T,)`` beside the recorded path, left positive; NaN where it has no direction.
        bend_rad: ``(T,)`` by how much the recorded path turns around that place, left positive.
        limit_mps: Posted speed limit at the last place; None where none is known.
    """

    t_us: I64
    speed_mps: F64
    recorded_mps: F64
    along_m: F64
    lateral_m: F64
    bend_rad: F64
    limit_mps: float | None

    def index(self, before_s: float) -> int:
        """Return the step that lies so many seconds before the failure, or the first one."""
        at_us = self.t_us[-1] - round(before_s * 1e6)
        return int(np.searchsorted(self.t_us, at_us, side="left"))

    @property
    def bend(self) -> str:
        """Name the bend around the last place: ``left``, ``right``, or empty on a straight."""
        turn = float(self.bend_rad[-1])
        if not abs(turn) >= LEAST_BEND_RAD:
            return ""
        return "left" if turn > 0.0 else "right"


def approach_of(log: RolloutLog, failed_us: int, content: JsonView) -> Approach | None:
    """Measure the seconds before a failure.

    Args:
        log: The log, up to the failure at least.
        failed_us: When it failed.
        content: ``scenes/SCENE.json``.

    Returns:
        The measurements; None where the recorded drive has no length or the log fewer than two steps.
    """
    ego = log.ego
    preset = PRESETS["strict"]
    path = recorded_path(log, preset)
    line = path.xyz[:, :2]
    keep = moving(line)
    if len(keep) < 2 or len(ego) < 2:
        return None
    on = on_route(line, path.t_us, ego.t_us, ego.xyz[:, :2])
    steps = np.flatnonzero((ego.t_us >= failed_us - BEFORE_US) & (ego.t_us <= failed_us))
    if len(steps) < 2:
        return None
    kept = line[keep]
    along = arc_lengths(kept)
    recorded_mps = np.interp(on.along_m, along, speeds(path)[keep])
    recorded_mps[on.is_beyond] = np.nan
    place = resample(kept, on.along_m[steps[-1]], along)
    return Approach(
        t_us=ego.t_us[steps],
        speed_mps=speeds(ego)[steps],
        recorded_mps=recorded_mps[steps],
        along_m=on.along_m[steps],
        lateral_m=(on.side * on.lateral_m)[steps],
        bend_rad=turn_around(kept, on.along_m[steps]),
        limit_mps=posted_mps(content, place, heading_at(kept, float(on.along_m[steps[-1]]))),
    )


def heading_at(line: F64, along_m: float) -> float:
    """Return the heading in radians of a line ``(N, 2)`` at an arc length."""
    ends = resample(line, np.array([along_m - 1.0, along_m + 1.0]))
    return float(heading_of(ends[1] - ends[0]))


def turn_around(line: F64, along_m: F64) -> F64:
    """Return by how many radians ``(T,)`` a line ``(N, 2)`` turns from `BEND_M` behind to `BEND_M`
    ahead of arc lengths, left positive.
    """
    length_m = float(arc_lengths(line)[-1])
    s = np.clip(along_m, 1.0, max(length_m - 1.0, 1.0))[:, None]
    stations = s + np.array([-BEND_M, 2.0 - BEND_M, BEND_M - 2.0, BEND_M])
    stations = np.clip(stations, 0.0, length_m)
    points = resample(line, stations)
    begin = points[:, 1] - points[:, 0]
    end = points[:, 3] - points[:, 2]
    # Near an end of the line a chord has no length: the middle's direction stands for it.
    middle = points[:, 2] - points[:, 1]
    begin = np.where(np.hypot(*begin.T)[:, None] > 0.1, begin, middle)
    end = np.where(np.hypot(*end.T)[:, None] > 0.1, end, middle)
    return np.asarray(wrap_angle(heading_of(end) - heading_of(begin)))


def posted_mps(content: JsonView, place: F64, heading_rad: float) -> float | None:
    """Return the speed limit in m/s of the lane at a place of the recorded path, of those that lead
    the same way; None where the map states none.

    Args:
        content: ``scenes/SCENE.json``.
        place: ``(2,)`` metres, world.
        heading_rad: Of the recorded path there.
    """
    nearest: tuple[float, float | None] = (LANE_M, None)
    for lane in content.get("lanes", ()):
        centre = np.asarray(lane["centre"], dtype=np.float64).reshape(-1, 2)
        if lane.get("kind") != "vehicle" or len(centre) < 2:
            continue
        shape = shapely.linestrings(centre)
        point = shapely.points(place)
        distance_m = float(shapely.distance(shape, point))
        if distance_m >= nearest[0]:
            continue
        heading = heading_at(centre, float(shapely.line_locate_point(shape, point)))
        if abs(float(wrap_angle(heading - heading_rad))) < SAME_WAY_RAD:
            nearest = distance_m, lane.get("limit_mps")
    return nearest[1]


def neighbour_at(log: RolloutLog, t_us: int, ids: Sequence[str] = ()) -> Neighbour | None:
    """Return the nearest road user ahead of the ego at an instant; None where there is none within
    `AHEAD_M`.

    Args:
        log: The log.
        t_us: When.
        ids: Of the road users that count; all where empty.
    """
    pose = interpolate(log.ego, t_us)
    yaw = float(heading_of(pose[:2, 0]))
    ego_shape = _shape(pose[:2, 3], yaw, (log.ego_box.length_m, log.ego_box.width_m))
    nearest: Neighbour | None = None
    for actor_id, actor in log.actors.items():
        track = actor.track
        if (ids and actor_id not in ids) or not track.t_us[0] <= t_us <= track.t_us[-1]:
            continue
        other = interpolate(track, t_us)
        offset = other[:2, 3] - pose[:2, 3]
        ahead_m = float(offset @ pose[:2, 0])
        left_m = float(cross(pose[:2, 0], offset))
        if not 0.0 < ahead_m < AHEAD_M:
            continue
        other_yaw = float(heading_of(other[:2, 0]))
        shape = _shape(other[:2, 3], other_yaw, (actor.box.length_m, actor.box.width_m))
        gap_m = float(shapely.distance(ego_shape, shape))
        beside_m = (log.ego_box.width_m + actor.box.width_m) / 2 + 0.5
        towards = abs(float(wrap_angle(other_yaw - yaw))) > np.pi / 2
        if nearest is None or gap_m < nearest.gap_m:
            nearest = Neighbour(actor, gap_m, ahead_m, left_m, towards, abs(left_m) < beside_m)
    return nearest


def _shape(xy: F64, yaw: float, size_m: tuple[float, float]) -> shapely.Polygon:
    """Return a box in plan view."""
    corners = rectangle_corners(xy[None], np.array([yaw]), np.array([size_m]))
    polygon: shapely.Polygon = shapely.polygons(corners[0])
    return polygon


def gap_series(log: RolloutLog, t_us: I64, actor_id: str) -> F64:
    """Return the gap in metres ``(T,)`` between the ego's box and a road user's; NaN where that one
    is not there.
    """
    gaps = np.full(len(t_us), np.nan)
    actor = log.actors[actor_id]
    is_present = (t_us >= actor.track.t_us[0]) & (t_us <= actor.track.t_us[-1])
    if not is_present.any():
        return gaps
    ego = interpolate(log.ego, t_us[is_present])
    other = interpolate(actor.track, t_us[is_present])
    shapes = []
    for poses, box in ((ego, log.ego_box), (other, actor.box)):
        size = np.broadcast_to([box.length_m, box.width_m], (len(poses), 2))
        corners = rectangle_corners(poses[:, :2, 3], heading_of(poses[:, :2, 0]), size)
        shapes.append(shapely.polygons(corners))
    gaps[is_present] = shapely.distance(*shapes)
    return gaps


def needed_mps2(log: RolloutLog, from_us: int, actor: Actor) -> float | None:
    """Return the constant braking in m/s2, from an instant on, with which the ego would not have
    touched a road user ahead of it, on its heading then; None where more than 9 m/s2 are needed.

    Args:
        log: The log.
        from_us: Since when it brakes.
        actor: The road user, who moves as in the log, and behind its end as fast as last.
    """
    pose = interpolate(log.ego, from_us)
    speed_mps = float(np.interp(from_us, log.ego.t_us, speeds(log.ego)))
    first_us, last_us = int(actor.track.t_us[0]), int(actor.track.t_us[-1])
    t_us = np.arange(max(from_us, first_us), from_us + STOPS_US, 50_000)
    if not len(t_us) or last_us <= first_us:
        return None
    poses = interpolate(actor.track, np.minimum(t_us, last_us))
    ahead_m = (poses[:, :2, 3] - pose[:2, 3]) @ pose[:2, 0]
    before, last = interpolate(actor.track, np.array([max(last_us - 100_000, first_us), last_us]))
    last_mps = max(float((last[:2, 3] - before[:2, 3]) @ pose[:2, 0]) / 0.1, 0.0)
    ahead_m = ahead_m + last_mps * np.maximum(t_us - last_us, 0) * 1e-6
    room_m = ahead_m - (log.ego_box.length_m + actor.box.length_m) / 2
    t_s = (t_us - from_us) * 1e-6
    for brake_mps2 in np.arange(0.5, 9.01, 0.1):
        braking_s = np.minimum(t_s, speed_mps / brake_mps2)
        driven_m = speed_mps * braking_s - brake_mps2 * braking_s**2 / 2
        if (driven_m < room_m).all():
            return float(brake_mps2)
    return None


def turns_of(lateral_m: F64, least_m: float) -> list[float]:
    """Return the turning points of an offset over time, one of each swing: those that lie at least
    ``least_m`` on alternating sides of its mean.

    Example:
        >>> turns_of(np.array([0.0, 0.6, 0.1, -0.7, 0.0, 0.9]), 0.3)
        [0.6, -0.7, 0.9]
    """
    peaks: list[float] = []
    for value in lateral_m[np.isfinite(lateral_m)].tolist():
        if abs(value) < least_m:
            continue
        if peaks and np.sign(peaks[-1]) == np.sign(value):
            peaks[-1] = max(peaks[-1], value, key=abs)
        else:
            peaks.append(value)
    return peaks


def environment_words(environment: Mapping[str, object]) -> dict[str, str]:
    """Name weather and time of day of a scene: ``weather`` and ``time``, each as it ends a
    sentence's "in" or "at".

    Example:
        >>> environment_words({"time": "night", "rain": 3.0})
        {'weather': 'in rain', 'time': 'at night'}
    """
    weather = [
        f"in {name}"
        for name, key in (("fog", "fog_visibility_m"), ("rain", "rain"), ("snow", "snow"))
        if environment.get(key)
    ]
    times = {"day": "by day", "night": "at night", "low_sun": "in low sun"}
    time = times[str(environment.get("time") or "day")]
    if time == "by day" and environment.get("sky") == "dusk":
        time = "at dusk"
    return {"weather": " and ".join(weather) or "in dry weather", "time": time}
