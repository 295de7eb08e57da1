"""Quality of the policy's plans: how steady they are, what they would hit, and how near their samples come to the recording.

Plans are rig poses; they are moved to the box centre before use. All errors are in plan view. One row per policy answer, at its time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.geometry import interpolate, matrix_from_quat
from alpasim_plugin.types import F64, I64, LoggedPlan, MetricSeries, RolloutLog, Scene, Trajectory
from evaluators.base import register, series
from evaluators.footprint import ActorTable, ego_footprints_at, origin_of
from evaluators.metrics import MIN_ADE
from evaluators.presets import Preset
from evaluators.route import recorded_path

_CHUNK = 20_000  # plan poses looked up at once


@dataclass(frozen=True)
class PlanTable:
    """Box centres of many trajectories laid end to end."""

    t_us: I64  # (P,)
    xy: F64  # (P, 2) from the origin
    yaw: F64  # (P,)
    start: I64  # (N + 1,) first row of each trajectory, then the end

    def rows(self, i: int) -> slice:
        """Return the rows of trajectory ``i``."""
        return slice(int(self.start[i]), int(self.start[i + 1]))

    @property
    def owner(self) -> I64:
        """Trajectory of each row ``(P,)``."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))


def plan_table(trajectories: Sequence[Trajectory], T_rig_box: F64, origin: F64) -> PlanTable:
    """Move rig trajectories in the world to the box centre and lay them end to end."""
    sizes = [len(one) for one in trajectories]
    xyz = np.concatenate([np.zeros((0, 3)), *(one.xyz for one in trajectories)])
    quat = np.concatenate([np.zeros((0, 4)), *(one.quat for one in trajectories)])
    rotation = matrix_from_quat(quat)
    centre = xyz + rotation @ T_rig_box[:3, 3] - origin
    forward = rotation @ T_rig_box[:3, 0]  # box x in the world
    t_us = np.concatenate([np.zeros(0, dtype=np.int64), *(one.t_us for one in trajectories)])
    start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return PlanTable(t_us, centre[:, :2], np.arctan2(forward[:, 1], forward[:, 0]), start)


@register("plan", "steadiness, open-loop collisions and minADE of the plans")
def evaluate_plans(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give ``plan_deviation``, ``open_loop_collision`` and ``min_ade@...`` per policy answer; empty answers have no row."""
    plans = [plan for plan in rollout.plans if len(plan.trajectory)]
    origin = origin_of(rollout.ego_log)
    table = plan_table([plan.trajectory for plan in plans], rollout.T_rig_box, origin)
    now_us = np.array([plan.now_us for plan in plans], dtype=np.int64)
    out = [series("open_loop_collision", now_us, open_loop_collisions(rollout, table, now_us, preset, origin))]
    deviation = plan_deviation(table, preset.plan_decay)
    out.append(series("plan_deviation", now_us[1:], deviation, np.isfinite(deviation), "the plan and the one before it share no time"))
    if any(plan.samples for plan in plans):
        out.extend(min_ade(rollout, plans, preset, origin))
    return out


def plan_deviation(table: PlanTable, decay: float) -> F64:
    """Return the weighted mean distance ``(N - 1,)`` between consecutive plans, NaN where they share no time.

    The old plan is read at the new plan's times, its first pose (where the ego is) left out, up to the old plan's end; the k-th such time
    weighs ``exp(-decay k)``.
    """
    n = max(len(table.start) - 2, 0)
    out = np.full(n, np.nan)
    for i in range(n):
        old, new = table.rows(i), table.rows(i + 1)
        t_old, t_new, xy_new = table.t_us[old], table.t_us[new][1:], table.xy[new][1:]
        common = (t_new >= t_old[0]) & (t_new <= t_old[-1])
        t, xy = t_new[common], xy_new[common]
        if not len(t):
            continue
        since = (t - t_old[0]).astype(np.float64)
        grid = (t_old - t_old[0]).astype(np.float64)
        before = np.stack([np.interp(since, grid, table.xy[old][:, d]) for d in (0, 1)], axis=1)
        weight = np.exp(-decay * np.arange(len(t)))
        out[i] = float(np.sum(weight * np.hypot(*(xy - before).T)) / np.sum(weight))
    return out


def open_loop_collisions(rollout: RolloutLog, table: PlanTable, now_us: I64, preset: Preset, origin: F64) -> F64:
    """Return per answer ``(N,)`` 1 if a planned footprint within the horizon touches an actor where the log has it at that time, else 0."""
    out = np.zeros(len(now_us))
    actors = ActorTable(rollout, preset, origin)
    owner = table.owner
    ahead = table.t_us - now_us[owner]
    rows = np.flatnonzero((ahead > 0) & (ahead <= preset.open_loop_horizon_us))
    if not len(actors):
        return out
    for low in range(0, len(rows), _CHUNK):
        part = rows[low : low + _CHUNK]
        ego = ego_footprints_at(table.xy[part], table.yaw[part], rollout, preset)
        there = actors.at(table.t_us[part])
        near = there.centre_distance_m(ego.xy) <= ego.radius_m[None] + actors.radius_m[:, None] + 1e-6
        pose, actor = np.nonzero(near.T)
        touch = shapely.intersects(ego.shapes()[pose], there.footprints(actor, pose).shapes())
        out[owner[part[pose[touch]]]] = 1.0
    return out


def min_ade(rollout: RolloutLog, plans: Sequence[LoggedPlan], preset: Preset, origin: F64) -> list[MetricSeries]:
    """Return minADE per horizon, one row per answer that has samples.

    The error of a sample is the mean, over the log's times from the answer's query time to the first one at or after now + horizon, of its
    distance from the target path at the same time; the least over the samples counts. It is invalid where the log, the target or every
    sample ends before the horizon.
    """
    target = rollout.ego if preset.min_ade_target == "self" else recorded_path(rollout)
    line_us = rollout.ego.t_us
    usable = line_us[(line_us >= target.t_us[0]) & (line_us <= target.t_us[-1])]
    target_xy = interpolate(target, usable)[:, :2, 3] - origin[:2]
    asked = [plan for plan in plans if plan.samples]
    now_us = np.array([plan.now_us for plan in asked], dtype=np.int64)
    values = np.full((len(asked), len(preset.min_ade_horizons_s)), np.nan)
    for i, plan in enumerate(asked):
        samples = plan_table(plan.samples, rollout.T_rig_box, origin)
        first = int(np.searchsorted(usable, plan.query_us))
        for j, horizon_s in enumerate(preset.min_ade_horizons_s):
            last = int(np.searchsorted(usable, plan.now_us + round(horizon_s * 1e6)))
            if first <= last < len(usable):
                errors = [_mean_error(samples, k, usable[first : last + 1], target_xy[first : last + 1]) for k in range(len(plan.samples))]
                values[i, j] = np.nanmin(errors) if np.isfinite(errors).any() else np.nan
    reason = "the log, the target or every sample ends before the horizon"
    names = [MIN_ADE.format(horizon_s, preset.min_ade_target) for horizon_s in preset.min_ade_horizons_s]
    return [series(name, now_us, values[:, j], np.isfinite(values[:, j]), reason) for j, name in enumerate(names)]


def _mean_error(samples: PlanTable, k: int, t_us: I64, target_xy: F64) -> float:
    rows = samples.rows(k)
    t = samples.t_us[rows]
    if not len(t) or t_us[0] < t[0] or t_us[-1] > t[-1]:
        return float("nan")
    grid = (t - t[0]).astype(np.float64)
    at = np.stack([np.interp((t_us - t[0]).astype(np.float64), grid, samples.xy[rows][:, d]) for d in (0, 1)], axis=1)
    return float(np.mean(np.hypot(*(at - target_xy).T)))
