"""The drive against the recorded one: distance from its path, from its position at the time, and
progress along it.

Behind the end of that path the lateral distance is measured from the lane that the scene goes on
along, and beyond that, as before the beginning, from a straight continuation: driving on is no
error. The distance from a recording that moves at its end is not known there. Where the recorded
car stands at an end, what its position does there is noise and no path. Progress moves along the
path with the ego: where the path comes back beside itself, the nearest point of the whole path may
be one that is still a long way ahead.

The point compared is the ego's box centre; the recorded path is the recorded rig trajectory moved
to the box centre with the log's rig-to-box pose. All distances are in plan view. The paper's route
distance is the mean over the scored steps of the distance to that path.
"""

from dataclasses import dataclass, replace

import numpy as np
import shapely

from alpasim_plugin.core.geometry import arc_lengths, cross, interpolate, offset_trajectory, unit
from alpasim_plugin.core.path_end import moves_at_end
from alpasim_plugin.core.types import F64, I64, Bool, MetricSeries, RolloutLog, Scene, Trajectory
from evaluators.metrics.footprint import ego_footprints, held, origin_of
from evaluators.metrics.presets import PRESETS, Preset
from evaluators.metrics.score import relevant, series, with_preset
from evaluators.metrics.table import LEFT_ROUTE_M

DIRECTION_M = 1.0
# what a recording does within this distance of its first or last position is standing there
STAND_M = 0.5
SAME_M = 1e-6  # distances that differ by no more are equal
BEHIND_END = "no recorded drive behind the end of the recording"
OUTSIDE = "the recording does not cover this time"
NO_LENGTH = "the recorded path has no length"
NO_DIRECTION = f"the recorded path is shorter than {DIRECTION_M:g} m: it has no direction"
FOUND_M = 2.0  # a path that was left is found again where it is this near


def recorded_path(rollout: RolloutLog, preset: Preset) -> Trajectory:
    """Return the recorded drive as poses of the box centre."""
    path = offset_trajectory(rollout.ego_log, rollout.T_rig_box)
    return replace(path, xyz=held(path.xyz, preset))


def way_beyond(rollout: RolloutLog, scene: Scene | None, preset: Preset) -> F64 | None:
    """Return the lane behind the recorded drive as positions ``(M, 2)`` of the box centre, relative
    to the origin; None where the scene has none.
    """
    if scene is None or len(scene.path_beyond) == 0:
        return None
    rig = np.concatenate([rollout.ego_log.xyz[-1:], scene.path_beyond])
    forward = unit(np.diff(rig[:, :2], axis=0))
    centres = rig[1:, :2] + rollout.T_rig_box[0, 3] * forward
    return held(centres, preset) - origin_of(rollout.ego_log, preset)[:2]


def to_path(path: F64, points: F64) -> tuple[F64, F64]:
    """Project points on a polyline.

    Args:
        path: ``(N, 2)`` vertices; one vertex is a point.
        points: ``(T, 2)``.

    Returns:
        Distances ``(T,)`` and arc lengths ``(T,)`` of the nearest point of the path; of several
        nearest ones the first.
    """
    line = shapely.linestrings(np.repeat(path, 2, axis=0) if len(path) == 1 else path)
    positions = shapely.points(points)
    return shapely.distance(line, positions), shapely.line_locate_point(line, positions)


def moving(path: F64) -> I64:
    """Return which vertices of a path ``(N, 2)`` remain when it stands at neither end: the ends,
    and those beyond `STAND_M` of them.
    """
    away = [np.hypot(*(path - end).T) > STAND_M for end in (path[0], path[-1])]
    if not (away[0].any() and away[1].any()):
        return np.zeros(1, dtype=np.int64)
    first = int(np.argmax(away[0]))
    last = len(path) - 1 - int(np.argmax(away[1][::-1]))
    return np.concatenate([[0], np.arange(first, last + 1), [len(path) - 1]])


def followed(path: F64, distance_m: F64, s: F64, points: F64, first_m: float) -> F64:
    """Return ``(T,)`` arc lengths on a path that move no farther from step to step than points that
    move beside it.

    Args:
        path: ``(N, 2)`` vertices.
        distance_m, s: ``(T,)`` distance and arc length of the nearest point of the whole path.
        points: ``(T, 2)``.
        first_m: Arc length about which the first one is sought.

    Each is the nearest point of the path within 2 m, and twice what the point has moved, of the one
    before; of equally near ones it is the one ahead, so that a path that turns back on itself is
    followed back. A point that has left the path there by `LEFT_ROUTE_M` finds it again wherever it comes
    within `FOUND_M` of it and moves its way: it has skipped what lies between.
    """
    lengths = arc_lengths(path)
    moved = np.diff(points, axis=0, prepend=points[:1])
    out = np.array(s)
    reach_m = 2.0 + 2.0 * np.hypot(*moved.T)
    reach_m[0] += 2.0 * float(np.hypot(*(points[0] - _at(path, lengths, first_m))))
    step_m = np.diff(s, prepend=first_m)
    leaps = np.flatnonzero((step_m > reach_m) | (step_m < -SAME_M))
    for k in range(int(leaps[0]), len(s)) if len(leaps) else ():
        before = float(out[k - 1]) if k else first_m
        low = max(before - reach_m[k], 0.0)
        high = min(before + reach_m[k], float(lengths[-1]))
        candidates = []
        for start in (low, min(before, high)):
            inner = path[np.searchsorted(lengths, start, "right") : np.searchsorted(lengths, high)]
            ends = _at(path, lengths, start)[None], _at(path, lengths, high)[None]
            away_m, within_m = to_path(np.concatenate([ends[0], inner, ends[1]]), points[[k]])
            candidates.append((float(away_m[0]), start + float(within_m[0])))
        nearest, ahead = candidates
        out[k] = (ahead if ahead[0] <= nearest[0] + SAME_M else nearest)[1]
        if nearest[0] >= LEFT_ROUTE_M and distance_m[k] <= FOUND_M:
            along = _at(path, lengths, s[k] + FOUND_M) - _at(path, lengths, s[k] - FOUND_M)
            out[k] = s[k] if along @ moved[k] > 0.0 else out[k]
    return out


def _at(path: F64, along: F64, s: float) -> F64:
    """Return the point ``(2,)`` of a path at an arc length."""
    return np.array([np.interp(s, along, path[:, axis]) for axis in (0, 1)])


def left_of(path: F64, s: F64, points: F64) -> F64:
    """Return ``(T,)`` +1 where a point lies left of the path, -1 right of it, 0 on it, NaN where
    the path has no length.

    Args:
        path: ``(N, 2)`` vertices.
        s: ``(T,)`` arc length of the nearest point of the path.
        points: ``(T, 2)``.

    At a corner the direction is that of the segment which the nearest point ends.
    """
    lengths = arc_lengths(path)
    steps = np.diff(path, axis=0)
    long = np.flatnonzero(np.diff(lengths) > 0)
    if not len(long):
        return np.full(len(points), np.nan)
    segment = long[np.clip(np.searchsorted(lengths[long + 1], s), 0, len(long) - 1)]
    offset = points - path[segment]
    along = steps[segment]
    return np.sign(cross(along, offset))


def beside(path: F64, s: F64, points: F64, distance_m: F64) -> F64:
    """Return ``(T,)`` the distance of points from a path that goes straight on at both ends, NaN
    where the path has no direction.

    Args:
        path: ``(N, 2)`` vertices.
        s: ``(T,)`` arc length of the nearest point of the path.
        points: ``(T, 2)``.
        distance_m: ``(T,)`` distance from the path itself.

    The direction at an end is that of the path's last `DIRECTION_M` metres. A path that stands at
    an end is cut by `moving` first.
    """
    lengths = arc_lengths(path)
    length_m = float(lengths[-1])
    if length_m < DIRECTION_M:
        return np.full(len(points), np.nan)
    out = np.array(distance_m)
    inner = _at(path, lengths, DIRECTION_M)
    outer = _at(path, lengths, length_m - DIRECTION_M)
    for end, inside, is_there in (
        (path[0], inner, s <= 0.0),
        (path[-1], outer, s >= length_m * (1 - 1e-12)),
    ):
        away = end - inside
        away = away / np.hypot(*away)
        offset = points - end
        beyond = is_there & (offset @ away > 0.0)
        out[beyond] = np.abs(away[0] * offset[beyond, 1] - away[1] * offset[beyond, 0])
    return out


def from_corridor(path: F64, s: F64, points: F64, distance_m: F64) -> F64:
    """Return ``(T,)`` the distance of points from a path that goes straight on at its far end only,
    along its last segment.

    AlpaSim's later rule; `beside` is ours. Arguments as there.
    """
    out = np.array(distance_m)
    length_m = float(arc_lengths(path)[-1])
    along = path[-1] - path[-2] if len(path) > 1 else np.zeros(2)
    if length_m > 0 and np.hypot(*along) > 0:
        beyond = s >= length_m - 1e-9
        offset = points[beyond] - path[-1]
        out[beyond] = np.abs(offset[:, 0] * along[1] - offset[:, 1] * along[0]) / np.hypot(*along)
    return out


def progress_so_far(path: F64, points: F64) -> F64:
    """Return ``(T,)`` how far point k has come along the first k + 1 vertices of a path, as a share
    of their length.

    Args:
        path: ``(T, 2)`` where the recording is at each step.
        points: ``(T, 2)`` where the ego is.

    1 where that part of the path has no length: the recording has not moved, so there is nothing to
    be behind of.
    """
    driven_m = arc_lengths(path)
    out = np.ones(len(path))
    for k in np.flatnonzero(driven_m > 0):
        out[k] = to_path(path[: k + 1], points[[k]])[1][0] / driven_m[k]
    return out


@dataclass(frozen=True)
class OnRoute:
    """Where points are against the recorded drive, which stands at neither end.

    Attributes:
        length_m: Length of the path.
        along_m: ``(T,)`` how far along it, continuous from step to step.
        lateral_m: ``(T,)`` how far beside it, NaN where it has no direction; it goes straight on at
            both ends.
        side: ``(T,)`` as `left_of`.
        is_beyond: ``(T,)`` whether a point is behind the far end of the path.
    """

    length_m: float
    along_m: F64
    lateral_m: F64
    side: F64
    is_beyond: Bool


def on_route(
    path: F64,
    recorded_us: I64,
    t_us: I64,
    points: F64,
    more: F64 | None = None,
    first_m: float | None = None,
) -> OnRoute:
    """Set points ``(T, 2)`` at times ``(T,)`` beside a recorded path ``(N, 2)`` with times
    ``(N,)``, and beside what it goes on along, ``(M, 2)``. The first one is sought about the arc length
    ``first_m``; None: where the recording is at its time.
    """
    keep = moving(path)
    recorded = path[keep]
    along = arc_lengths(recorded)
    length_m = float(along[-1])
    line = recorded
    if more is not None and len(more):
        line = np.concatenate([recorded, more])
    distance_m, s = to_path(line, points)
    if first_m is None:
        first_m = float(np.interp(t_us[0], recorded_us[keep], along))
    followed_m = followed(line, distance_m, s, points, first_m)
    at_end = followed_m >= length_m * (1 - 1e-12)
    over_m = (points - recorded[-1]) @ (recorded[-1] - _at(recorded, along, length_m - DIRECTION_M))
    is_beyond = (followed_m > length_m + STAND_M) | (at_end & (over_m > STAND_M * DIRECTION_M))
    return OnRoute(
        length_m,
        np.minimum(followed_m, length_m),
        beside(line, s, points, distance_m),
        left_of(line, s, points),
        is_beyond,
    )


@dataclass(frozen=True)
class BesideRecording:
    """The ego's box centres and the recorded drive's, in plan view, relative to the origin.

    Attributes:
        path_us: ``(N,)`` times of the recorded drive.
        path: ``(N, 2)`` its positions.
        t_us: ``(T,)`` times of the ego.
        ego: ``(T, 2)`` where the ego is.
        recorded: ``(T, 2)`` where the recording is at these times; it waits at its ends.
        is_covered: ``(T,)`` whether the recording covers the time.
    """

    path_us: I64
    path: F64
    t_us: I64
    ego: F64
    recorded: F64
    is_covered: Bool


@dataclass(frozen=True)
class RouteColumns:
    """What is measured against the recorded drive at each step, ``(T,)`` each.

    Attributes:
        distance_m: From its path.
        away_m: From where the recording is at the time.
        share: Of its path that lies behind the ego; NaN where the path has no length.
        so_far: As `progress_so_far`.
        traveled_m: How far the ego has driven.
        corridor_m: As `from_corridor`; None where the preset has none.
    """

    distance_m: F64
    away_m: F64
    share: F64
    so_far: F64
    traveled_m: F64
    corridor_m: F64 | None


def evaluate_route(rollout: RolloutLog, scene: Scene | None, preset: Preset) -> list[MetricSeries]:
    """Give the recording-based metrics and ``eval_relevant`` per step."""
    drive = _beside_recording(rollout, preset)
    length_m = float(arc_lengths(drive.path)[-1])
    route = None
    if not preset.aliases:
        more = way_beyond(rollout, scene, preset)
        route = on_route(drive.path, drive.path_us, drive.t_us, drive.ego, more, rollout.along_m)
    columns = _columns(rollout, preset, drive, route)
    if preset.invented_starts:
        own_path = rollout.ego.xyz[:, :2] - origin_of(rollout.ego_log, preset)[:2]
        columns = _with_invented_starts(columns, to_path(own_path, drive.ego)[1])
    # A recording that stands at its end tells where to stop; one that goes on tells nothing more.
    is_measured = np.ones(len(drive.t_us), dtype=np.bool_)
    if route is not None and moves_at_end(rollout.ego_log):
        is_measured = ~route.is_beyond
    has_length = (length_m if route is None else route.length_m) > 0

    def column(
        name: str, value: F64 | Bool, valid: Bool | bool = True, reason: str = ""
    ) -> MetricSeries:
        return series(name, drive.t_us, value, valid, reason)

    out = [
        column("dist_to_gt_trajectory", columns.distance_m, is_measured, BEHIND_END),
        column("dist_to_gt_location", columns.away_m, drive.is_covered, OUTSIDE),
        column("progress", columns.share, has_length, NO_LENGTH),
        column("progress_rel", columns.so_far, drive.is_covered, OUTSIDE),
        column("dist_traveled_m", columns.traveled_m),
        column("gt_dist_traveled_m", np.full(len(drive.t_us), length_m)),
        column("eval_relevant", relevant(rollout)),
    ]
    if route is None:
        return [*out, *_alpasim_series(drive, columns, length_m, preset)]
    has_side = np.isfinite(route.lateral_m)
    return [
        *out,
        column("lateral_distance_m", route.lateral_m, has_side, NO_DIRECTION),
        column("route_distance_m", columns.distance_m, is_measured, BEHIND_END),
        column("lateral_bias_m", route.side * route.lateral_m, has_side, NO_DIRECTION),
    ]


def _beside_recording(rollout: RolloutLog, preset: Preset) -> BesideRecording:
    """Return where the ego and the recording are at the ego's times."""
    t_us = rollout.ego.t_us
    origin = origin_of(rollout.ego_log, preset)
    recorded = recorded_path(rollout, preset)
    first_us = recorded.t_us[0]
    last_us = recorded.t_us[-1]
    poses = interpolate(recorded, np.clip(t_us, first_us, last_us))
    return BesideRecording(
        path_us=recorded.t_us,
        path=recorded.xyz[:, :2] - origin[:2],
        t_us=t_us,
        ego=ego_footprints(rollout, preset, origin).centres(),
        recorded=held(poses[:, :3, 3], preset)[:, :2] - origin[:2],
        is_covered=(t_us >= first_us) & (t_us <= last_us),
    )


def _columns(
    rollout: RolloutLog, preset: Preset, drive: BesideRecording, route: OnRoute | None
) -> RouteColumns:
    """Measure the ego against the recorded drive; along its path as ``route`` says, without it by
    the nearest point of the whole path.
    """
    distance_m, along_m = to_path(drive.path, drive.ego)
    corridor_m = None
    if preset.corridor:
        corridor_m = from_corridor(drive.path, along_m, drive.ego, distance_m)
    length_m = float(arc_lengths(drive.path)[-1])
    if route is not None:
        along_m = route.along_m
        length_m = route.length_m
    driven_m = arc_lengths(drive.ego)
    first = int(np.argmax(relevant(rollout))) if preset.distance_from == "handover" else 0
    return RouteColumns(
        distance_m=distance_m,
        away_m=np.hypot(*(drive.ego - drive.recorded).T),
        share=along_m / length_m if length_m > 0 else np.full(len(along_m), np.nan),
        so_far=progress_so_far(drive.recorded, drive.ego),
        traveled_m=np.maximum(driven_m - driven_m[first], 0.0),
        corridor_m=corridor_m,
    )


def _with_invented_starts(columns: RouteColumns, along_own_path_m: F64) -> RouteColumns:
    """Return the columns with their first two rows as AlpaSim fills them in by hand.

    Args:
        columns: As they were measured.
        along_own_path_m: ``(T,)`` the ego's centres projected on the path of its rig, which AlpaSim
            takes instead of adding up the ego's steps.
    """

    def begun_with(column: F64, first: float, second: float) -> F64:
        out = np.array(column)
        out[:2] = np.array([first, second])[: len(out)]
        return out

    share = columns.share
    corridor_m = columns.corridor_m
    return RouteColumns(
        distance_m=begun_with(columns.distance_m, 0.0, 0.0),
        away_m=begun_with(columns.away_m, 0.0, 0.0),
        share=begun_with(share, 0.0, share[2] / 2 if len(share) > 2 else 0.0),
        so_far=begun_with(columns.so_far, 1.0, 1.0),
        traveled_m=begun_with(along_own_path_m, 0.0, 0.0),
        corridor_m=None if corridor_m is None else begun_with(corridor_m, 0.0, 0.0),
    )


def _alpasim_series(
    drive: BesideRecording, columns: RouteColumns, length_m: float, preset: Preset
) -> list[MetricSeries]:
    """Give the metrics that only AlpaSim's presets have."""
    out = []
    if columns.corridor_m is not None and preset.stop_beyond_gt_m is not None:
        has_left = columns.corridor_m >= preset.stop_beyond_gt_m
        out = [
            series("lateral_dist_to_gt_trajectory", drive.t_us, columns.corridor_m),
            series("left_corridor_laterally", drive.t_us, has_left),
        ]
    share = columns.share
    if preset.progress_of == "reachable" and length_m > 0:
        reached_m = float(to_path(drive.path, drive.recorded[-1:])[1][0])
        share = share * (length_m / reached_m if reached_m > 0 else 1.0)
    return [*out, series("progress_rel_to_total", drive.t_us, share, length_m > 0, NO_LENGTH)]


def lateral_bias(rollout: RolloutLog) -> MetricSeries:
    """Return ``lateral_bias_m`` of a rollout, for tables of presets whose metrics do not have it,
    such as ``alpasim``.
    """
    # The map plays no part in it.
    return next(
        metric_series
        for metric_series in evaluate_route(rollout, None, PRESETS["paper"])
        if metric_series.name == "lateral_bias_m"
    )


FACTORY = with_preset(evaluate_route)
