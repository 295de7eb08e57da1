"""Quality of the policy's plans: consistency, open-loop collisions, minADE of their samples;
and where the plans of two rollouts part.

Plans are rig poses; for the metrics they are moved to the box centre. All errors are in plan view.
One row per policy query, at its time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.core.geometry import heading_of, interpolate, matrix_from_quat
from alpasim_plugin.core.types import (
    F64,
    I64,
    LoggedPlan,
    MetricSeries,
    RolloutLog,
    Scene,
    Trajectory,
)
from evaluators.metrics.footprint import ActorTable, ego_footprints_at, held, origin_of
from evaluators.metrics.presets import Preset
from evaluators.metrics.route import recorded_path
from evaluators.metrics.score import series, with_preset
from evaluators.metrics.table import MIN_ADE

_CHUNK = 20_000  # plan poses looked up at once


@dataclass(frozen=True)
class TrajectoryTable:
    """Box centres of many trajectories laid end to end."""

    t_us: I64  # (P,)
    xyz: F64  # (P, 3) from the origin
    yaw: F64  # (P,)
    start: I64  # (N + 1,) first row of each trajectory, then the end

    def rows(self, i: int) -> slice:
        """Return the rows of trajectory ``i``."""
        return slice(int(self.start[i]), int(self.start[i + 1]))

    def position(self, i: int, t_us: I64) -> F64:
        """Return the centre ``(M, 3)`` of trajectory ``i`` at times inside it, linear between its
        poses.
        """
        t = self.t_us[self.rows(i)]
        xyz = self.xyz[self.rows(i)]
        grid = (t - t[0]).astype(np.float64)
        query = (t_us - t[0]).astype(np.float64)
        return np.stack([np.interp(query, grid, xyz[:, axis]) for axis in range(3)], axis=1)

    @property
    def owner(self) -> I64:
        """Trajectory of each row ``(P,)``."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))


def trajectory_table(
    trajectories: Sequence[Trajectory], T_rig_box: F64, origin: F64, preset: Preset
) -> TrajectoryTable:
    """Move rig trajectories in the world to the box centre and lay them end to end."""
    sizes = [len(trajectory) for trajectory in trajectories]
    xyz = np.concatenate([np.zeros((0, 3)), *(trajectory.xyz for trajectory in trajectories)])
    quat = np.concatenate([np.zeros((0, 4)), *(trajectory.quat for trajectory in trajectories)])
    rotation = matrix_from_quat(quat)
    centre = held(xyz + rotation @ T_rig_box[:3, 3], preset) - origin
    forward = rotation @ T_rig_box[:3, 0]  # box x in the world
    t_us = np.concatenate(
        [np.zeros(0, dtype=np.int64), *(trajectory.t_us for trajectory in trajectories)]
    )
    start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return TrajectoryTable(t_us, centre, heading_of(forward), start)


def evaluate_plans(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give ``plan_deviation``, ``open_loop_collision`` and ``min_ade@...`` per policy query; empty
    plans have no row.
    """
    plans = [plan for plan in rollout.plans if len(plan.trajectory)]
    origin = origin_of(rollout.ego_log, preset)
    table = trajectory_table([plan.trajectory for plan in plans], rollout.T_rig_box, origin, preset)
    now_us = np.array([plan.now_us for plan in plans], dtype=np.int64)
    out = [
        series(
            "open_loop_collision",
            now_us,
            open_loop_collisions(rollout, table, now_us, preset, origin),
        )
    ]
    deviation = plan_deviation(table, preset)
    out.append(
        series(
            "plan_deviation",
            now_us[1:],
            deviation,
            np.isfinite(deviation),
            "the plan and the one before it share no time",
        )
    )
    if any(plan.samples for plan in plans):
        out.extend(min_ade(rollout, plans, preset, origin))
    if preset.aliases:
        # AlpaSim reads this flag out of pickled bytes of the driver. Those are never unpickled
        # here; without them it says "not triggered".
        out.append(series("safety_monitor_triggered", now_us, np.zeros(len(now_us))))
    return out


def plan_deviation(table: TrajectoryTable, preset: Preset) -> F64:
    """Return the weighted mean distance ``(N - 1,)`` between consecutive plans, NaN where they
    share no time.

    The old plan is read at the new plan's times, its first pose (where the ego is) left out, up to
    the old plan's end; the k-th such time weighs ``exp(-plan_decay k)``.
    """
    n = max(len(table.start) - 2, 0)
    out = np.full(n, np.nan)
    for i in range(n):
        old = table.rows(i)
        new = table.rows(i + 1)
        t_old = table.t_us[old]
        t_new = table.t_us[new][1:]
        common = (t_new >= t_old[0]) & (t_new <= t_old[-1])
        if not common.any():
            continue
        off = held(table.xyz[new][1:][common], preset) - held(
            table.position(i, t_new[common]), preset
        )
        weight = np.exp(-preset.plan_decay * np.arange(len(off)))
        out[i] = float(
            np.sum(weight * np.linalg.norm(off[:, : 3 if preset.plan_with_z else 2], axis=1))
            / np.sum(weight)
        )
    return out


def open_loop_collisions(
    rollout: RolloutLog, table: TrajectoryTable, now_us: I64, preset: Preset, origin: F64
) -> F64:
    """Return per plan ``(N,)`` 1 if a planned footprint within the horizon touches an actor where
    the log has it at that time, else 0.
    """
    out = np.zeros(len(now_us))
    actors = ActorTable(rollout, preset, origin)
    owner = table.owner
    ahead = table.t_us - now_us[owner]
    rows = np.flatnonzero((ahead > 0) & (ahead <= preset.open_loop_horizon_us))
    if not len(actors):
        return out
    for low in range(0, len(rows), _CHUNK):
        part = rows[low : low + _CHUNK]
        ego = ego_footprints_at(table.xyz[part, :2], table.yaw[part], rollout, preset)
        actors_at = actors.at(table.t_us[part])
        near = (
            actors_at.centre_distance_m(ego.xy)
            <= ego.radius_m[None] + actors.radius_m[:, None] + 1e-6
        )
        pose, actor = np.nonzero(near.T)
        touch = shapely.intersects(ego.shapes()[pose], actors_at.footprints(actor, pose).shapes())
        out[owner[part[pose[touch]]]] = 1.0
    return out


def min_ade(
    rollout: RolloutLog, plans: Sequence[LoggedPlan], preset: Preset, origin: F64
) -> list[MetricSeries]:
    """Return minADE per horizon, one row per plan that has samples.

    The error of a sample is the mean, over the log's times from the plan's query time to the first
    one at or after now + horizon, of its distance from the target path at the same time; the least
    over the samples counts. It is invalid where the log, the target or every sample ends before the
    horizon.
    """
    target = rollout.ego if preset.min_ade_target == "self" else recorded_path(rollout, preset)
    line_us = rollout.ego.t_us
    usable = line_us[(line_us >= target.t_us[0]) & (line_us <= target.t_us[-1])]
    target_xyz = held(interpolate(target, usable)[:, :3, 3], preset) - origin
    sampled_plans = [plan for plan in plans if plan.samples]
    now_us = np.array([plan.now_us for plan in sampled_plans], dtype=np.int64)
    if preset.min_ade_rule == "by_index":
        return _min_ade_by_index(rollout, sampled_plans, usable, target_xyz, preset, origin)
    values = np.full((len(sampled_plans), len(preset.min_ade_horizons_s)), np.nan)
    for i, plan in enumerate(sampled_plans):
        samples = trajectory_table(plan.samples, rollout.T_rig_box, origin, preset)
        first = int(np.searchsorted(usable, plan.query_us))
        for j, horizon_s in enumerate(preset.min_ade_horizons_s):
            last = int(np.searchsorted(usable, plan.now_us + round(horizon_s * 1e6)))
            if first <= last < len(usable):
                span = slice(first, last + 1)
                errors = _errors(samples, usable[span], target_xyz[span], preset)
                values[i, j] = min(
                    (error.mean() for error in errors if error is not None), default=np.nan
                )
    reason = "the log, the target or every sample ends before the horizon"
    return [
        series(name, now_us, column, np.isfinite(column), reason)
        for name, column in zip(_min_ade_names(preset), values.T, strict=True)
    ]


def _min_ade_names(preset: Preset) -> list[str]:
    return [MIN_ADE.format(float(s), preset.min_ade_target) for s in preset.min_ade_horizons_s]


def _min_ade_by_index(
    rollout: RolloutLog,
    plans: Sequence[LoggedPlan],
    line_us: I64,
    target_xyz: F64,
    preset: Preset,
    origin: F64,
) -> list[MetricSeries]:
    """Give minADE as AlpaSim counts it.

    The running mean starts at the query time, but is read at an index counted from the first log
    time after now; where logged times are finer than the control step, this reads later than the
    horizon. Horizons beyond the log have no row. One sample that is too short removes all minADE
    metrics of the rollout.
    """
    rows: list[list[tuple[int, float]]] = [[] for _ in preset.min_ade_horizons_s]
    longest_us = max(preset.min_ade_horizons_s) * 1e6
    for plan in plans:
        samples = trajectory_table(plan.samples, rollout.T_rig_box, origin, preset)
        until = min(plan.now_us + longest_us, float(line_us[-1]))
        span = np.flatnonzero((line_us >= plan.query_us) & (line_us <= until))
        sample_errors = _errors(samples, line_us[span], target_xyz[span], preset)
        covering = [error for error in sample_errors if error is not None]
        if len(covering) < len(sample_errors):
            return []
        errors = np.stack(covering)
        running = np.cumsum(errors, axis=1) / np.arange(1, len(span) + 1)
        best = running.min(axis=0)
        after_now = int(np.searchsorted(line_us, plan.now_us)) + 1
        reads = [
            int(np.searchsorted(line_us, plan.now_us + horizon_s * 1e6)) - after_now
            for horizon_s in preset.min_ade_horizons_s
        ]
        for j, read in enumerate([read for read in reads if read < len(span)]):
            rows[j].append((plan.now_us, float(best[read])))
    return [
        series(name, np.array([t for t, _ in row], dtype=np.int64), np.array([v for _, v in row]))
        for name, row in zip(_min_ade_names(preset), rows, strict=True)
        if row
    ]


def _errors(
    samples: TrajectoryTable, t_us: I64, target_xyz: F64, preset: Preset
) -> list[F64 | None]:
    """Return the distances ``(M,)`` of each sample from a target ``(M, 3)`` at times ``(M,)``; None
    of one that does not cover them.
    """
    out: list[F64 | None] = []
    for k in range(len(samples.start) - 1):
        t = samples.t_us[samples.rows(k)]
        if not len(t) or (len(t_us) and (t[0] > t_us[0] or t_us[-1] > t[-1])):
            out.append(None)
            continue
        off = held(samples.position(k, t_us), preset) - target_xyz
        out.append(np.linalg.norm(off[:, : 3 if preset.min_ade_with_z else 2], axis=1))
    return out


FACTORY = with_preset(evaluate_plans)


HORIZON_US = 3_000_000
DIVERGED_M = 0.5  # a 1.88 m car has 0.8 m to either side in a 3.5 m lane


@dataclass(frozen=True)
class Divergence:
    """The first query at which the plans of two policies, or of one policy behind two renderers,
    differ.

    Attributes:
        t_us: Time of the query.
        gap_m: Distance between the plans at the horizon, or at the end of the shorter plan where
            that comes first.
        ahead_us: How far ahead of the query that is.
    """

    t_us: int
    gap_m: float
    ahead_us: int


def first_divergence(
    plans: Sequence[LoggedPlan], others: Sequence[LoggedPlan]
) -> Divergence | None:
    """Return the first query common to both at which their plans lie more than `DIVERGED_M` apart
    at `HORIZON_US`; None if there is none.

    Plans that end before the horizon are compared at the end of the shorter one.
    """
    partners = {plan.now_us: plan.trajectory for plan in others if len(plan.trajectory)}
    for plan in plans:
        if plan.now_us not in partners or not len(plan.trajectory):
            continue
        pair = (plan.trajectory, partners[plan.now_us])
        begin_us = max(int(trajectory.t_us[0]) for trajectory in pair)
        t_us = min(plan.now_us + HORIZON_US, *(int(trajectory.t_us[-1]) for trajectory in pair))
        if t_us < begin_us:
            continue
        xy = [interpolate(trajectory, np.array([t_us]))[0, :2, 3] for trajectory in pair]
        gap_m = float(np.linalg.norm(xy[1] - xy[0]))
        if gap_m > DIVERGED_M:
            return Divergence(plan.now_us, gap_m, t_us - plan.now_us)
    return None
