"""Faults of plans, each found by one function that returns a readable sentence, or an empty one."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.plan_check import sensors_problem, shape_problem, unit_guess
from alpasim_plugin.core.types import F64, Plan

MIN_HORIZON_S, MAX_STEP_S = 2.0, 0.5
FIRST_POSE_M = 0.5

Fault = Callable[[Sequence[Plan], Sequence[int], F64], str]


def sensors_fault(sensors: Any, known: Collection[str]) -> str:
    """Check that a policy's sensors are a sequence of `SensorSpec` and name cameras that exist."""
    found = sensors_problem(sensors)
    if found:
        return found
    unknown = [sensor.camera for sensor in sensors if sensor.camera not in known]
    return f"the policy asks for cameras {unknown}; the scenario has {sorted(known)}" if unknown else ""


def shape_fault(plans: Sequence[Plan], asked_us: Sequence[int], T_world_first: F64) -> str:
    """Check shapes and finite values of plans and samples."""
    return next((found for plan in plans if (found := shape_problem(plan, min_rows=2))), "")


def time_fault(plans: Sequence[Plan], asked_us: Sequence[int], T_world_first: F64) -> str:
    """Check that times are integer microseconds, begin at the observation, increase, and reach far enough in fine enough steps."""
    for step, (plan, now) in enumerate(zip(plans, asked_us, strict=True)):
        times = plan.times_us
        if not np.issubdtype(times.dtype, np.integer):
            return f"times_us is {times.dtype}, not integer microseconds"
        if int(times[0]) != now:
            return f"times_us begins at {int(times[0])}, the observation is at {now} us: {_time_guess(int(times[0]), now, asked_us[:step])}"
        steps = np.diff(times)
        if (steps <= 0).any():
            return f"times_us does not increase strictly after row {int(np.argmax(steps <= 0))}"
        horizon_s, widest_s = int(times[-1] - times[0]) * 1e-6, int(steps.max()) * 1e-6
        if horizon_s < MIN_HORIZON_S:
            guess = "; the steps look like milliseconds" if horizon_s * 1000 >= MIN_HORIZON_S and horizon_s < 0.02 else ""
            return f"the plan ends {horizon_s:.3f} s ahead; the controller needs {MIN_HORIZON_S:.0f} s{guess}"
        if widest_s > MAX_STEP_S:
            return f"poses of the plan are up to {widest_s:.2f} s apart; {MAX_STEP_S} s is the most"
    return ""


def _time_guess(first: int, now: int, earlier: Sequence[int]) -> str:
    if first in earlier:
        return "it is stale, an earlier observation's plan"
    if abs(first - now // 1000) < 1000:
        return "it looks like milliseconds"
    if abs(first - now // 1_000_000) < 10:
        return "it looks like seconds"
    return "it looks like times relative to now" if first == 0 else "a plan begins at its observation"


def frame_fault(plans: Sequence[Plan], asked_us: Sequence[int], T_world_first: F64) -> str:
    """Check that plans begin at the rig's origin, that yaw is in radians, and that it follows the motion."""
    for plan in plans:
        away = float(np.hypot(*plan.xy[0]))
        if away > FIRST_POSE_M:
            near_world = float(np.hypot(*(plan.xy[0] - T_world_first[:2, 3]))) < 100.0
            guess = "it looks like world coordinates" if near_world else "a plan begins at the ego, in its rig frame"
            return f"the first pose lies {away:.1f} m from the rig's origin: {guess}"
        widest = float(np.abs(plan.yaw).max())
        if widest > 2 * np.pi:
            return f"yaw reaches {widest:.1f}: it looks like degrees, needed are radians"
        step = np.diff(plan.xy, axis=0)
        length = np.hypot(step[:, 0], step[:, 1])
        middle = 0.5 * (plan.yaw[1:] + plan.yaw[:-1])
        along = np.abs(step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle))
        if ((length > 0.3) & (along < 0.8 * length)).any():
            return "the plan moves sideways: yaw and the direction of motion differ by more than 37 degrees"
    return ""


def unit_fault(plan: Plan) -> str:
    """Check the advance in the first second of a plan made at 10 m/s on a free straight."""
    t_s = (plan.times_us - plan.times_us[0]) * 1e-6
    x, y = (float(np.interp(1.0, t_s, plan.xy[:, d])) for d in (0, 1))
    distance = float(np.hypot(x, y))
    if 4.0 <= distance <= 14.0 and x > abs(y):
        return ""
    unit = unit_guess(distance / 10.0)
    guess = f"it looks like {unit}" if unit else "a car does between 4 and 14 m, forwards"
    if 4.0 <= distance <= 14.0:
        guess = "it runs backwards, x is forward" if -x > abs(y) else "it runs sideways, x is forward and y is left"
    return f"at 10 m/s on a free straight the plan advances {distance:.2f} in the first second: {guess}"


def side_fault(left: Plan, right: Plan) -> str:
    """Check that a left-hand road leads further left than a right-hand one."""
    y_left, y_right = float(left.xy[-1, 1]), float(right.xy[-1, 1])
    if y_left >= y_right - 0.5:
        return ""
    return f"a left-hand road leads to y = {y_left:.1f} m and a right-hand one to y = {y_right:.1f} m: y is mirrored, it points left"


def difference(a: Sequence[Plan], b: Sequence[Plan]) -> float:
    """Return the largest difference of two drives' plans in metres or radians; infinite where times or shapes differ."""
    if len(a) != len(b) or any(p.xy.shape != q.xy.shape or not np.array_equal(p.times_us, q.times_us) for p, q in zip(a, b, strict=True)):
        return float("inf")
    return max(max(float(np.abs(p.xy - q.xy).max()), float(np.abs(p.yaw - q.yaw).max())) for p, q in zip(a, b, strict=True))


def remarks(plans: Mapping[str, Sequence[Plan]]) -> list[str]:
    """List legal but unusual properties."""
    out = []
    if {"left", "right"} <= plans.keys() and difference(plans["left"], plans["right"]) == 0:
        out.append("the plan depends neither on the route nor on the frames: left and right give the same")
    if "standing" in plans:
        last = plans["standing"][-1]
        out.append(f"from standstill on a free road it moves {float(np.hypot(*(last.xy[-1] - last.xy[0]))):.1f} m within its horizon")
    if not any(plan.samples for drive in plans.values() for plan in drive):
        out.append("it carries no sampled alternatives, so plan metrics see one trajectory")
    return out
