"""Compare what plans ask for with what the vehicle can do: finds plans in another unit, which are valid in every other respect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.plan_check import unit_guess
from alpasim_plugin.core.types import EgoState, Plan, Vehicle

REACH_S = 1.0
MOVING_MPS = 1.0  # below, a plan's speed says nothing about its unit
SLACK, SLACK_M = 2.0, 5.0  # a plan may ask for more than the vehicle gives: only what is far beyond counts
WARN_SHARE, MIN_PLANS = 0.2, 5


class PlanMotion:
    """Counts the plans of one rollout that reach much further, or much less far, than the vehicle can drive.

    A plan's reach is its straight-line advance ``d`` in the first second (or up to its end). At speed ``v`` the vehicle drives at most
    ``v t + a t^2 / 2`` with full throttle, and at least its braking distance. A plan is beyond the vehicle if ``d`` is more than twice the
    former and 5 m, and below it if ``d`` is less than a tenth of the latter.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._plans = self._beyond = self._below = 0
        self._ratios: list[float] = []

    def add(self, plan: Plan, ego: EgoState) -> None:
        """Count a plan that `alpasim_plugin.core.plan_check.plan_problem` has passed."""
        t_s = (plan.times_us - plan.times_us[0]) * 1e-6
        reach_s = min(REACH_S, float(t_s[-1]))
        if reach_s <= 0.0:
            return  # one pose: the ego is to stand
        self._plans += 1
        advance_m = float(np.hypot(*(np.interp(reach_s, t_s, plan.xy[:, axis]) - plan.xy[0, axis] for axis in (0, 1))))
        speed, accel, brake = abs(ego.speed_mps), self._vehicle.max_accel_mps2, self._vehicle.max_brake_mps2
        most_m = speed * reach_s + 0.5 * accel * reach_s**2
        braking_s = min(reach_s, speed / brake)
        least_m = speed * braking_s - 0.5 * brake * braking_s**2
        self._beyond += advance_m > SLACK * most_m + SLACK_M
        self._below += speed > MOVING_MPS and advance_m < 0.1 * least_m
        if speed > MOVING_MPS:
            self._ratios.append(advance_m / (speed * reach_s))

    def facts(self) -> dict[str, Any]:
        """Return ``plans``, ``beyond``, ``below``, and ``speed_ratio``: median of plan speed over the ego's (None if it never moved)."""
        ratio = round(float(np.median(self._ratios)), 4) if self._ratios else None
        return {"plans": self._plans, "beyond": self._beyond, "below": self._below, "speed_ratio": ratio}


def plan_table(manifests: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return for each renderer the counts of `PlanMotion` over rollouts, and ``warning``: a sentence where plans and vehicle do not fit.

    Args:
        manifests: Of finished rollouts of one policy; those of scored logs have no plans counted.
    """
    out: dict[str, Any] = {}
    for name in dict.fromkeys(m["renderer"] for m in manifests):
        facts = [m["plan_motion"] for m in manifests if m["renderer"] == name and m.get("plan_motion")]
        if not facts:
            continue
        ratios = [one["speed_ratio"] for one in facts if one["speed_ratio"] is not None]
        entry: dict[str, Any] = {key: sum(one[key] for one in facts) for key in ("plans", "beyond", "below")}
        entry["speed_ratio"] = round(float(np.median(ratios)), 4) if ratios else None
        out[name] = entry | {"warning": _warning(entry)}
    return out


def _warning(entry: Mapping[str, Any]) -> str:
    plans, beyond, below, ratio = (entry[key] for key in ("plans", "beyond", "below", "speed_ratio"))
    found = max(beyond, below)
    if plans < MIN_PLANS or found < WARN_SHARE * plans:
        return ""
    how = "further than the vehicle can drive in that time" if beyond >= below else "less far than its braking distance"
    said = f"{found} of {plans} plans reach {how}"
    if ratio is None:
        return said
    unit = unit_guess(ratio)
    return f"{said}; their speed is {ratio:.3g} times the ego's{f', as if in {unit}' if unit else ''}"
