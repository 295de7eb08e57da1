"""What the plans of a failed rollout had to do with its failure, measured in its log: facts, each a
sentence, that name no cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely

from alpasim_plugin.core.geometry import interpolate, inverse, rectangle_corners
from alpasim_plugin.core.types import F64, I64, Actor, Box, LoggedPlan, RolloutLog, Trajectory
from evaluators.metrics.footprint import Geometries
from evaluators.metrics.outcomes import speeds

BEFORE_US = 6_000_000  # of the failure
AHEAD_US = 2_000_000  # of a query: where a plan is measured
STEP_US = 100_000
AWAY_M = 1.0  # from the route that the policy received
STANDS_M = 0.5
JUMP_M = 1.0
BRAKES = 0.9  # share of the ego's speed below which a plan brakes


def plan_facts(log: RolloutLog, failed_us: int, outcomes: frozenset[str], met: str) -> list[str]:
    """Return what the plans before a failure were, the most telling first.

    Args:
        log: The log, up to the failure at least.
        failed_us: When it failed.
        outcomes: Names of its outcomes.
        met: The road user of a collision; empty where there is none.
    """
    plans = [
        plan
        for plan in log.plans
        if failed_us - BEFORE_US <= plan.now_us <= failed_us and len(plan.trajectory) > 1
    ]
    if not plans:
        return []
    facts = []
    if met in log.actors:
        facts += _towards(log, plans, log.actors[met], failed_us)
    elif outcomes & {"stalled", "braked_without_cause"}:
        facts += _standing(log, plans)
    else:
        facts += _beside_route(plans, failed_us)
    return facts + _jumps(plans)


def _towards(
    log: RolloutLog, plans: Sequence[LoggedPlan], actor: Actor, failed_us: int
) -> list[str]:
    """Say which plans lead into a road user, and when the first one brakes."""
    leads = [_leads_into(log, plan.trajectory, actor) for plan in plans]
    seconds = (log.ego.t_us - log.ego.t_us[0]) * 1e-6
    v = speeds(seconds, log.ego.xyz[:, :2])
    speeds_mps = np.interp([plan.now_us for plan in plans], log.ego.t_us, v)
    asked_mps = [_planned_speed(plan.trajectory) for plan in plans]
    free = [number for number, into in enumerate(leads) if not into]
    since = plans[free[-1] + 1 if free and free[-1] + 1 < len(plans) else 0]
    facts = []
    if leads[-1]:
        facts.append(
            f"Every plan of the last {(failed_us - since.now_us) * 1e-6:.1f} s before the contact "
            f"leads into {actor.actor_id}."
        )
    brakes = [
        number
        for number, (asked, speed) in enumerate(zip(asked_mps, speeds_mps, strict=True))
        if asked < BRAKES * speed
    ]
    if not brakes:
        facts.append(
            f"No plan brakes: the last one asks for {asked_mps[-1]:.1f} m/s one second ahead, "
            f"at {speeds_mps[-1]:.1f} m/s."
        )
        return facts
    first = brakes[0]
    before_s = (failed_us - plans[first].now_us) * 1e-6
    facts.append(
        f"The first plan that brakes comes {before_s:.1f} s before the contact, at "
        f"{speeds_mps[first]:.1f} m/s and {_gap_m(log, plans[first].now_us, actor):.1f} m away."
    )
    return facts


def _leads_into(log: RolloutLog, plan: Trajectory, actor: Actor) -> bool:
    """Tell whether the ego's box on a plan meets the box of a road user where it really went."""
    last_us = min(plan.t_us[-1], actor.track.t_us[-1])
    t_us = np.arange(max(plan.t_us[0], actor.track.t_us[0]), last_us + 1, STEP_US)
    if not len(t_us):
        return False
    ego = interpolate(plan, t_us) @ log.T_rig_box
    return bool(shapely.intersects(_boxes(ego, log.ego_box), _at(actor, t_us)).any())


def _gap_m(log: RolloutLog, t_us: int, actor: Actor) -> float:
    held_us = np.clip([t_us], actor.track.t_us[0], actor.track.t_us[-1])
    ego = _boxes(interpolate(log.ego, np.array([t_us])), log.ego_box)
    return float(shapely.distance(ego, _at(actor, held_us))[0])


def _at(actor: Actor, t_us: I64) -> Geometries:
    return _boxes(interpolate(actor.track, t_us), actor.box)


def _boxes(poses: F64, box: Box) -> Geometries:
    """Return the boxes at poses ``(N, 4, 4)`` of their centres as polygons ``(N,)``."""
    size = np.broadcast_to([box.length_m, box.width_m], (len(poses), 2))
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return np.asarray(shapely.polygons(rectangle_corners(poses[:, :2, 3], yaw, size)))


def _planned_speed(plan: Trajectory) -> float:
    """Return the speed of a plan one second ahead, or at its end, m/s."""
    end_us = min(plan.t_us[-1], plan.t_us[0] + AHEAD_US // 2)
    xy = interpolate(plan, np.array([max(plan.t_us[0], end_us - STEP_US), end_us]))[:, :2, 3]
    return float(np.hypot(*(xy[1] - xy[0]))) / (STEP_US * 1e-6)


def _ahead(plan: LoggedPlan) -> F64:
    """Return where a plan leads within two seconds, ``(2,)`` metres, rig frame at the query."""
    end_us = min(plan.trajectory.t_us[-1], plan.now_us + AHEAD_US)
    now, then = interpolate(plan.trajectory, np.array([plan.trajectory.t_us[0], end_us]))
    return np.asarray((inverse(now) @ then)[:2, 3])


def _beside_route(plans: Sequence[LoggedPlan], failed_us: int) -> list[str]:
    """Say from when on plans lead away from the route that the policy received."""
    offsets = []
    for plan in plans:
        route = plan.route[np.isfinite(plan.route).all(axis=1)]
        if len(route) > 1:
            offsets.append((plan.now_us, _left_of(route, _ahead(plan))))
    if not offsets:
        return []
    near = [number for number, (_, left_m) in enumerate(offsets) if abs(left_m) < AWAY_M]
    since = near[-1] + 1 if near else 0
    if since == len(offsets):
        left_m = offsets[-1][1]
        return [
            f"The last plan leads back to the route, to {abs(left_m):.1f} m of it in two seconds."
        ]
    t_us = offsets[since][0]
    left_m = max((left for _, left in offsets[since:]), key=abs)
    side = "left" if left_m > 0 else "right"
    return [
        f"From {(failed_us - t_us) * 1e-6:.1f} s before the failure, plans lead away from the route: "
        f"up to {abs(left_m):.1f} m to its {side} in two seconds."
    ]


def _left_of(route: F64, point: F64) -> float:
    """Return how far a point ``(2,)`` lies to the left of a line ``(N, 2)``."""
    line = shapely.linestrings(route)
    point_on = shapely.points(point)
    along = shapely.line_locate_point(line, point_on)
    a, b = (
        shapely.get_coordinates(shapely.line_interpolate_point(line, along + step))[0]
        for step in (-0.5, 0.5)
    )
    way, away = b - a, point - a
    sign = np.sign(way[0] * away[1] - way[1] * away[0])
    return float(sign * shapely.distance(line, point_on))


def _standing(log: RolloutLog, plans: Sequence[LoggedPlan]) -> list[str]:
    """Say how far the plans lead."""
    reach_m = [float(np.hypot(*_ahead(plan))) for plan in plans]
    going = [number for number, reach in enumerate(reach_m) if reach > STANDS_M]
    since = going[-1] + 1 if going else 0
    if since == len(plans):
        return [f"The last plan leads {reach_m[-1]:.1f} m on in two seconds."]
    at_s = (plans[since].now_us - log.render_start_us) * 1e-6
    return [f"From {at_s:.1f} s on, every plan stands: less than {STANDS_M} m in two seconds."]


def _jumps(plans: Sequence[LoggedPlan]) -> list[str]:
    """Say how much plans differ from one query to the next, where that is much."""
    moved = []
    for one, other in pairwise(plans):
        at_us = one.now_us + AHEAD_US // 2
        if other.now_us <= at_us <= min(one.trajectory.t_us[-1], other.trajectory.t_us[-1]):
            first, then = (interpolate(plan.trajectory, at_us) for plan in (one, other))
            moved.append(float(np.hypot(*(then - first)[:2, 3])))
    median_m = float(np.median(moved)) if moved else 0.0
    if median_m < JUMP_M:
        return []
    return [f"From query to query, plans move by {median_m:.1f} m one second ahead (median)."]
