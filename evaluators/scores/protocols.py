"""The scores of other benchmarks over one rollout: their parts, what is missing of them, and the
range in which the score then lies.

A part that a log cannot give is not measured, never 0. The score is then known only if the others
decide it; its least and its greatest possible value are always given. What each benchmark publishes
and how far our logs go is in docs/presets.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.geometry import offset_trajectory
from alpasim_plugin.core.types import (
    F64,
    I64,
    LoggedPlan,
    MetricSeries,
    RolloutLog,
    Scene,
    Trajectory,
)
from evaluators.metrics.collision import NOT_LOOKED_FOR, contact_events
from evaluators.metrics.footprint import origin_of
from evaluators.metrics.presets import Preset
from evaluators.metrics.route import OnRoute, on_route, recorded_path
from evaluators.metrics.score import relevant, series, with_preset
from evaluators.metrics.surface import MARGIN_M
from evaluators.scores import nuplan
from evaluators.scores.judged import Judged, Part
from evaluators.scores.states import derivative, ego_states, smooth, states_of
from evaluators.scores.table import MOST, PARTS

Values = Mapping[str, float]
NO_PAIRS = "two plans 0.5 s apart that reach 4 s in steps of 0.1 s"
NO_PATH = "a recorded path with a length"
NO_PLANS = "a plan of more than three poses"
NOT_DRIVEN = "a step that the policy drove"


@dataclass(frozen=True)
class Protocol:
    """The score of one benchmark.

    Attributes:
        measure: Gives the parts of the scored part of a rollout, the ego's box centres;
            `evaluators.scores.table` says what they are.
        scores: Score -> its rule over the parts, never lower for a higher part.
    """

    measure: Callable[[RolloutLog, Scene, Preset, Trajectory], Mapping[str, Part]]
    scores: Mapping[str, Callable[[Values], float]]


def _route(rollout: RolloutLog, preset: Preset, centre: Trajectory) -> tuple[OnRoute, OnRoute]:
    """Return where the scored ego is on the recorded path, and where the recording is at the same
    times.
    """
    origin, recorded = origin_of(rollout.ego_log, preset), recorded_path(rollout, preset)
    path = recorded.xyz[:, :2] - origin[:2]
    ends = np.stack(
        [np.interp(centre.t_us, recorded.t_us, path[:, axis]) for axis in (0, 1)], axis=1
    )
    return on_route(path, recorded.t_us, centre.t_us, centre.xyz[:, :2] - origin[:2]), on_route(
        path, recorded.t_us, centre.t_us, ends
    )


def _progress(
    rollout: RolloutLog, preset: Preset, centre: Trajectory, ratio: Callable[[float, float], float]
) -> Part:
    """Return the ratio of the metres along the recorded path that the ego and that the recording
    made in the same time.
    """
    ego, expert = _route(rollout, preset, centre)
    made = [float(track.along_m[-1] - track.along_m[0]) for track in (ego, expert)]
    return ratio(made[0], made[1]) if ego.length_m > 0 else NO_PATH


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
) -> Mapping[str, Part]:
    drive, made = (
        Judged(rollout, scene, preset, centre),
        _progress(rollout, preset, centre, nuplan.progress_ratio),
    )
    return {
        "no_at_fault_collision": drive.contact(),
        "drivable_area": drive.drivable(nuplan.OFF_AREA_M),
        "making_progress": made if isinstance(made, str) else float(made >= nuplan.PROGRESS_SHARE),
        "driving_direction": drive.direction(),
        "progress": made,
        "time_to_collision": drive.time_to_collision(),
        "speed_limit": drive.speed_limit(),
        "comfort": drive.comfort(),
    }


def _navsim(
    rollout: RolloutLog, scene: Scene, preset: Preset, centre: Trajectory
) -> Mapping[str, Part]:
    drive = Judged(rollout, scene, preset, centre)
    return {
        "nc": drive.contact(),
        "dac": drive.drivable(MARGIN_M),
        "ddc": drive.direction(),
        "tlc": drive.traffic_lights(),
        "ep": _progress(rollout, preset, centre, ego_progress),
        "ttc": drive.time_to_collision(),
        "lk": drive.lane_keeping(),
        "hc": drive.comfort(),
        "ec": _extended_comfort(rollout, preset, centre),
    }


def _extended_comfort(rollout: RolloutLog, preset: Preset, centre: Trajectory) -> Part:
    """Return the share of plans that move as the one 0.5 s before meant to, over the 3.5 s that
    both reach.
    """
    plans = [one for one in rollout.plans if _reaches(one)]
    now_us, origin = (
        np.array([one.now_us for one in plans], dtype=np.int64),
        origin_of(rollout.ego_log, preset),
    )
    alike = []
    for plan in plans:
        k = int(np.searchsorted(now_us, plan.now_us - APART_US, "right")) - 1
        t_us = plan.now_us + np.arange(0, REACH_US - APART_US + 1, PLAN_STEP_US)
        if plan.now_us < centre.t_us[0] or k < 0 or plans[k].trajectory.t_us[-1] < t_us[-1]:
            continue
        first, second = (
            _planned_motion(rollout, preset, one.trajectory, t_us, origin)
            for one in (plans[k], plan)
        )
        alike.append(
            all(
                np.sqrt(np.mean((first[name] - second[name]) ** 2)) <= most
                for name, most in EXTENDED_COMFORT.items()
            )
        )
    return float(np.mean(alike)) if alike else NO_PAIRS


def _reaches(plan: LoggedPlan) -> bool:
    """Tell whether a plan reaches far enough, in steps that are short enough for accelerations."""
    t_us = plan.trajectory.t_us
    return (
        len(t_us) > 1
        and t_us[-1] >= plan.now_us + REACH_US
        and int(np.diff(t_us).max()) <= PLAN_STEP_US
    )


def _planned_motion(
    rollout: RolloutLog, preset: Preset, rig: Trajectory, t_us: I64, origin: F64
) -> Mapping[str, F64]:
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


LEAST_PROGRESS_M = 5.0
PDMS = {"ep": 5.0, "ttc": 5.0, "hc": 2.0}
EXTENDED_COMFORT = {
    "accel": 0.7,
    "jerk": 0.5,
    "yaw_rate": 0.1,
    "yaw_accel": 0.1,
}  # root mean squares: m/s2, m/s3, rad/s, rad/s2
APART_US = 500_000
REACH_US = 4_000_000
PLAN_STEP_US = 100_000
EPDMS = {"ep": 5.0, "ttc": 5.0, "lk": 2.0, "hc": 2.0, "ec": 2.0}


def _hugsim(
    rollout: RolloutLog, scene: Scene, preset: Preset, centre: Trajectory
) -> Mapping[str, Part]:
    """Judge every plan by where the others really are at its times; each part is a mean over plans,
    ``hd`` that of their product.
    """
    rows: list[dict[str, Part]] = []
    for plan in rollout.plans:
        inside = plan.trajectory.t_us <= rollout.ego.t_us[-1]
        if plan.now_us < centre.t_us[0] or np.sum(inside) <= nuplan.LEAST_INSTANTS:
            continue
        rig = plan.trajectory
        way = offset_trajectory(
            replace(rig, t_us=rig.t_us[inside], xyz=rig.xyz[inside], quat=rig.quat[inside]),
            rollout.T_rig_box,
        )
        drive = Judged(rollout, scene, preset, way)
        nc = float(not drive.hits)
        rows.append(
            {
                "nc": nc if nc == 0 or scene.standing != "unknown" else NOT_LOOKED_FOR,
                "dac": drive.drivable(MARGIN_M),
                "ttc": drive.time_to_collision(),
                "com": drive.comfort(),
            }
        )
    ego, _ = _route(rollout, preset, centre)
    completed: Part = float(ego.along_m[-1]) / ego.length_m if ego.length_m > 0 else NO_PATH
    out: dict[str, Part] = {"rc": completed}
    for name in ("nc", "dac", "ttc", "com"):
        values = [row[name] for row in rows]
        out[name] = next(
            (one for one in values if isinstance(one, str)),
            NO_PLANS if not values else float(np.mean([float(x) for x in values])),
        )
    product = [
        _bounds(
            row, lambda one: one["nc"] * one["dac"] * _weighted(one, {"ttc": 5.0, "com": 2.0}), 1.0
        )
        for row in rows
    ]
    why = next((one for row in rows for one in row.values() if isinstance(one, str)), NO_PLANS)
    out["hd"] = (
        float(np.mean([low for low, _ in product]))
        if product and all(low == high for low, high in product)
        else why
    )
    return out


def _ncap(
    rollout: RolloutLog, scene: Scene, preset: Preset, centre: Trajectory
) -> Mapping[str, Part]:
    """Compare the speed of the impact with that of a drive that goes on as it was at the
    handover.
    """
    impact = _impact_mps(rollout, preset, centre)
    first = states_of(rollout, preset, rollout.ego, origin_of(rollout.ego, preset))[0]
    k = int(np.searchsorted(rollout.ego.t_us, centre.t_us[0]))
    after_s = (centre.t_us - centre.t_us[0]) * 1e-6
    v = first.velocity[k, 0] * first.heading[k]
    xyz = centre.xyz[0] + np.concatenate(
        [after_s[:, None] * v, np.zeros((len(after_s), 1))], axis=1
    )
    still = replace(centre, xyz=xyz, quat=np.repeat(centre.quat[:1], len(after_s), axis=0))
    passive = _impact_mps(rollout, preset, still)
    if impact is None:
        score: Part = 5.0 if scene.standing != "unknown" else NOT_LOOKED_FOR
    else:
        score = (
            "an impact of a drive that does nothing"
            if not passive
            else 4.0 * max(0.0, 1.0 - impact / passive)
        )
    none = "an impact"
    return {
        "points": score,
        "impact_mps": none if impact is None else impact,
        "passive_impact_mps": none if passive is None else passive,
    }


def _impact_mps(rollout: RolloutLog, preset: Preset, centre: Trajectory) -> float | None:
    """Return the relative speed at the first contact at or between the times of a trajectory; None
    without one.
    """
    events = contact_events(
        replace(rollout, ego=centre, render_start_us=int(centre.t_us[0]), force_gt_us=0), preset
    )
    if not events:
        return None
    ego, tracks = states_of(rollout, preset, centre, origin_of(rollout.ego, preset))
    k = max(
        int(np.searchsorted(ego.t_us - ego.t_us[0], round(events[0].t_s * 1e6))) - 1, 0
    )  # before it, when nothing is shoved yet
    a = tracks.ids.index(events[0].actor_id)
    k = k if tracks.there[a, k] else int(np.argmax(tracks.there[a]))
    return float(np.hypot(*(ego.velocity[k, 0] * ego.heading[k] - tracks.velocity[a, k])))


PROTOCOLS = {
    "nuplan": Protocol(_nuplan, {"score": nuplan.closed_loop_score}),
    "navsim": Protocol(
        _navsim,
        {
            "pdms": lambda one: one["nc"] * one["dac"] * _weighted(one, PDMS),
            "epdms": lambda one: (
                one["nc"] * one["dac"] * one["ddc"] * one["tlc"] * _weighted(one, EPDMS)
            ),
        },
    ),
    "hugsim": Protocol(_hugsim, {"hd_score": lambda one: one["hd"] * one["rc"]}),
    "ncap": Protocol(_ncap, {"score": lambda one: one["points"]}),
}


def _bounds(
    parts: Mapping[str, Part], rule: Callable[[Values], float], most: float
) -> tuple[float, float]:
    """Return the least and the greatest value of a rule over parts of which some are not
    measured.
    """
    low, high = (
        {name: end if isinstance(part, str) else part for name, part in parts.items()}
        for end in (0.0, most)
    )
    return rule(low), rule(high)


def _matters(
    parts: Mapping[str, Part], name: str, rule: Callable[[Values], float], most: float
) -> bool:
    """Tell whether a score reads a part: it is lower without it where all that is missing has full
    marks.
    """
    return _bounds(dict(parts) | {name: 0.0}, rule, most)[1] < _bounds(parts, rule, most)[1]


def evaluate_protocol(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give the parts and scores of the preset's benchmark, the same at every step; nothing by
    presets that are none's.
    """
    if preset.protocol is None:
        return []
    protocol, rows = PROTOCOLS[preset.protocol], relevant(rollout)
    if rows.any():
        ego = rollout.ego
        parts = protocol.measure(
            rollout,
            scene,
            preset,
            replace(ego, t_us=ego.t_us[rows], xyz=ego.xyz[rows], quat=ego.quat[rows]),
        )
    else:
        parts = dict.fromkeys(PARTS[preset.protocol], NOT_DRIVEN)
    out: dict[str, Part] = {}
    for score, rule in protocol.scores.items():
        most = MOST.get(preset.protocol, 1.0)
        low, high = _bounds(parts, rule, most)
        missing = "; ".join(
            dict.fromkeys(
                part
                for name, part in parts.items()
                if isinstance(part, str) and _matters(parts, name, rule, most)
            )
        )
        out |= {
            score: low if low == high else missing,
            f"{score}_least": low,
            f"{score}_most": high,
        }
    t_us = rollout.ego.t_us
    return [
        series(
            f"{preset.protocol}_{name}",
            t_us,
            np.nan if isinstance(one, str) else one,
            not isinstance(one, str),
            f"not measured: {one}",
        )
        for name, one in (out | dict(parts)).items()
    ]


FACTORY = with_preset(evaluate_protocol)
