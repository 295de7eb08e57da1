"""The scores of other benchmarks over one rollout: their parts, what is missing of them, and the
range in which the score then lies.

A part that a log cannot give is not measured, never 0. The score is then known only if the others
decide it; its least and its greatest possible value are always given. What each benchmark publishes
and how far our logs go is in docs/metrics.md.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from alpasim_plugin.core.types import (
    F64,
    I64,
    LoggedPlan,
    MetricSeries,
    RolloutLog,
    Scene,
    Trajectory,
)
from evaluators.metrics import nuplan
from evaluators.metrics.footprint import origin_of
from evaluators.metrics.presets import Preset
from evaluators.metrics.route import on_route, recorded_path
from evaluators.metrics.score import relevant, series, with_preset
from evaluators.metrics.score_table import PARTS
from evaluators.metrics.scored import Part, ScoredRollout
from evaluators.metrics.states import derivative, ego_states, smooth
from evaluators.metrics.surface import MARGIN_M

Values = Mapping[str, float]
Rule = Callable[[Values], float]

NO_PAIRS = "two plans 0.5 s apart that reach 4 s in steps of 0.1 s"
NO_PATH = "a recorded path with a length"
NOT_DRIVEN = "a step that the policy drove"

LEAST_PROGRESS_M = 5.0
PDMS = {"ep": 5.0, "ttc": 5.0, "hc": 2.0}
EPDMS = {"ep": 5.0, "ttc": 5.0, "lk": 2.0, "hc": 2.0, "ec": 2.0}
# Extended comfort: root mean squares, in m/s2, m/s3, rad/s and rad/s2.
EXTENDED_COMFORT = {"accel": 0.7, "jerk": 0.5, "yaw_rate": 0.1, "yaw_accel": 0.1}
APART_US = 500_000
REACH_US = 4_000_000
PLAN_STEP_US = 100_000


def _progress(
    rollout: RolloutLog, preset: Preset, centre: Trajectory, ratio: Callable[[float, float], float]
) -> Part:
    """Return the ratio of the metres along the recorded path that the ego and that the recording
    made in the same time.
    """
    origin = origin_of(rollout.ego_log, preset)[:2]
    recorded = recorded_path(rollout, preset)
    path = recorded.xyz[:, :2] - origin
    expert_xy = [np.interp(centre.t_us, recorded.t_us, path[:, axis]) for axis in (0, 1)]
    ego = on_route(path, recorded.t_us, centre.t_us, centre.xyz[:, :2] - origin)
    expert = on_route(path, recorded.t_us, centre.t_us, np.stack(expert_xy, axis=1))
    ego_m, expert_m = (float(track.along_m[-1] - track.along_m[0]) for track in (ego, expert))
    return ratio(ego_m, expert_m) if ego.length_m > 0 else NO_PATH


def ego_progress(ego_m: float, reference_m: float) -> float:
    """Return NAVSIM's ego progress: the share of the greater of both, and 1 where neither makes
    more than `LEAST_PROGRESS_M`.

    NAVSIM's reference is a drive of PDM-Closed in the same scene; here it is the recorded drive.

    >>> ego_progress(30.0, 40.0), ego_progress(50.0, 40.0), ego_progress(1.0, 5.0), ego_progress(-3.0, 40.0)
    (0.75, 1.0, 1.0, 0.0)
    """
    most = max(ego_m, reference_m)
    return max(ego_m, 0.0) / most if most > LEAST_PROGRESS_M else 1.0


def _nuplan(
    rollout: RolloutLog, scene: Scene, preset: Preset, centre: Trajectory
) -> dict[str, Part]:
    ego = ScoredRollout(rollout, scene, preset, centre)
    progress = _progress(rollout, preset, centre, nuplan.progress_ratio)
    is_made: Part = progress
    if not isinstance(progress, str):
        is_made = float(progress >= nuplan.PROGRESS_SHARE)
    return {
        "no_at_fault_collision": nuplan.collision_score(ego.hits),
        "drivable_area": ego.drivable(nuplan.OFF_AREA_M),
        "making_progress": is_made,
        "driving_direction": ego.direction(),
        "progress": progress,
        "time_to_collision": ego.time_to_collision(),
        "speed_limit": ego.speed_limit(),
        "comfort": ego.comfort("centre"),
    }


def _navsim(
    rollout: RolloutLog, scene: Scene, preset: Preset, centre: Trajectory
) -> dict[str, Part]:
    ego = ScoredRollout(rollout, scene, preset, centre)
    return {
        "nc": nuplan.collision_score(ego.hits),
        "dac": ego.drivable(MARGIN_M),
        "ddc": ego.direction(),
        "tlc": ego.traffic_lights(),
        "ep": _progress(rollout, preset, centre, ego_progress),
        "ttc": ego.time_to_collision(),
        "lk": ego.lane_keeping(),
        "hc": ego.comfort("rear_axle"),
        "ec": _extended_comfort(rollout, preset, centre),
    }


def _extended_comfort(rollout: RolloutLog, preset: Preset, centre: Trajectory) -> Part:
    """Return the share of plans that move as the one 0.5 s before meant to, over the 3.5 s that
    both reach.
    """
    plans = [plan for plan in rollout.plans if _reaches(plan)]
    now_us = np.array([plan.now_us for plan in plans], dtype=np.int64)
    origin = origin_of(rollout.ego_log, preset)
    alike = []
    for plan in plans:
        k = int(np.searchsorted(now_us, plan.now_us - APART_US, "right")) - 1
        t_us = plan.now_us + np.arange(0, REACH_US - APART_US + 1, PLAN_STEP_US)
        if plan.now_us < centre.t_us[0] or k < 0 or plans[k].trajectory.t_us[-1] < t_us[-1]:
            continue
        before = _planned_motion(rollout, preset, plans[k].trajectory, t_us, origin)
        after = _planned_motion(rollout, preset, plan.trajectory, t_us, origin)
        errors = {name: np.sqrt(np.mean((before[name] - after[name]) ** 2)) for name in before}
        alike.append(all(errors[name] <= most for name, most in EXTENDED_COMFORT.items()))
    return float(np.mean(alike)) if alike else NO_PAIRS


def _reaches(plan: LoggedPlan) -> bool:
    """Tell whether a plan reaches far enough, in steps that are short enough for accelerations."""
    t_us = plan.trajectory.t_us
    if len(t_us) < 2 or t_us[-1] < plan.now_us + REACH_US:
        return False
    return int(np.diff(t_us).max()) <= PLAN_STEP_US


def _planned_motion(
    rollout: RolloutLog, preset: Preset, rig: Trajectory, t_us: I64, origin: F64
) -> dict[str, F64]:
    """Return acceleration, jerk, yaw rate and yaw acceleration ``(T,)`` of a plan at some of its
    times.
    """
    states = ego_states(rollout, preset, rig, origin)
    times = rig.t_us.astype(np.float64)
    accel = smooth(np.interp(t_us, times, np.hypot(*states.accel.T)))
    yaw = np.interp(t_us, times, states.yaw)
    return {
        "accel": accel,
        "jerk": derivative(accel, t_us, window=15),
        "yaw_rate": derivative(yaw, t_us),
        "yaw_accel": derivative(yaw, t_us, times=2),
    }


def _weighted(values: Values, weights: Values) -> float:
    return sum(weight * values[name] for name, weight in weights.items()) / sum(weights.values())


def _pdms(parts: Values) -> float:
    return parts["nc"] * parts["dac"] * _weighted(parts, PDMS)


def _epdms(parts: Values) -> float:
    multipliers = parts["nc"] * parts["dac"] * parts["ddc"] * parts["tlc"]
    return multipliers * _weighted(parts, EPDMS)


# Benchmark -> what gives the parts of the scored part of a rollout (the ego's box centres), which
# `evaluators.metrics.score_table` names; and score -> its rule, never lower for a higher part.
MEASURES = {"nuplan": _nuplan, "navsim": _navsim}
RULES: dict[str, dict[str, Rule]] = {
    "nuplan": {"score": nuplan.closed_loop_score},
    "navsim": {"pdms": _pdms, "epdms": _epdms},
}


def evaluate_protocol(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give the parts and scores of the preset's benchmark, the same at every step; nothing by
    presets that are none's.
    """
    benchmark = preset.protocol
    if benchmark is None:
        return []
    ego = rollout.ego
    rows = relevant(rollout)
    parts: dict[str, Part] = dict.fromkeys(PARTS[benchmark], NOT_DRIVEN)
    if rows.any():
        scored = replace(ego, t_us=ego.t_us[rows], xyz=ego.xyz[rows], quat=ego.quat[rows])
        parts = MEASURES[benchmark](rollout, scene, preset, scored)
    values: dict[str, Part] = {}
    for name, rule in RULES[benchmark].items():
        # Without a value, it is the parts that would decide the score.
        numbers = {part: value for part, value in parts.items() if not isinstance(value, str)}
        missing = {part: reason for part, reason in parts.items() if isinstance(reason, str)}
        full_marks = numbers | dict.fromkeys(missing, 1.0)
        least = rule(numbers | dict.fromkeys(missing, 0.0))
        most = rule(full_marks)
        reasons = [
            reason for part, reason in missing.items() if rule(full_marks | {part: 0.0}) < most
        ]
        score: Part = least if least == most else "; ".join(dict.fromkeys(reasons))
        values |= {name: score, f"{name}_least": least, f"{name}_most": most}
    out = []
    for name, value in (values | parts).items():
        is_measured = not isinstance(value, str)
        number = value if is_measured else np.nan
        reason = f"not measured: {value}"
        out.append(series(f"{benchmark}_{name}", ego.t_us, number, is_measured, reason))
    return out


FACTORY = with_preset(evaluate_protocol)
