"""What the plans of a failed rollout had to do with its failure, measured in its log: facts, each a
sentence, that name no cause.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import shapely

from alpasim_plugin.core.geometry import heading_of, interpolate, inverse, rectangle_corners, speeds
from alpasim_plugin.core.types import (
    F64,
    STANDING_ID,
    Actor,
    Box,
    LoggedPlan,
    RolloutLog,
    Trajectory,
)
from alpasim_plugin.log.run_folder.records import Contact, DriveEvent
from evaluators.metrics.footprint import Geometries
from evaluators.metrics.outcomes import outcome_of
from evaluators.metrics.score import handover_us
from evaluators.metrics.states import KINDS

CONTACT_OUTCOMES = ("collision_any", "collision_at_fault")
BEFORE_US = 6_000_000  # of the failure
STEP_US = 100_000
AWAY_M = 1.0  # from the route that the policy received
STANDS_M = 0.5
BRAKES = 0.9  # share of the ego's speed below which a plan brakes


def contact_of_failure(
    log: RolloutLog, failure: DriveEvent, contacts: Iterable[Contact]
) -> Contact | None:
    """Return the contact that a rollout failed with: the first that began after the policy took
    over and within the step of the failure; None where it failed with something else.

    Args:
        log: The log, up to the failure at least.
        failure: The event with which it failed.
        contacts: Beginnings of contacts of the whole log.
    """
    if outcome_of(failure) not in CONTACT_OUTCOMES:
        return None
    step = int(np.searchsorted(log.ego.t_us, failure.t_us))
    begin_us = max(int(log.ego.t_us[max(step - 1, 0)]), handover_us(log))
    in_step = [
        contact
        for contact in contacts
        if begin_us <= contact_us(log, contact) <= failure.t_us and contact.actor_id in log.actors
    ]
    return min(in_step, key=lambda contact: contact.t_s, default=None)


def contact_us(log: RolloutLog, contact: Contact) -> int:
    """Return when a contact begins, microseconds, as in the log."""
    return int(log.ego.t_us[0]) + round(contact.t_s * 1e6)


def words_of(actor: Actor, contact: Contact) -> str:
    """Say what kind of road user was touched, where it is seen from the ego, and its id."""
    kind = actor.label if actor.label in KINDS else "road user"
    if actor.actor_id.startswith(STANDING_ID):
        kind = "standing obstacle"
    place = {"front": "ahead", "rear": "behind"}.get(contact.side)
    if place is None:
        place = "on the left" if contact.y_m > 0.0 else "on the right"
    return f"the {kind} {place} (`{actor.actor_id}`)"


def plan_facts(
    log: RolloutLog, failed_us: int, outcomes: frozenset[str], contact: Contact | None
) -> list[str]:
    """Return what the plans before a failure, or before an end short of the path's, were: the most
    telling first.

    Args:
        log: The log, up to the failure at least.
        failed_us: When it failed, or ended.
        outcomes: Names of its outcomes; none of a drive that ended short.
        contact: What it failed with, as `contact_of_failure` gives it; None where that is no
            contact.
    """
    if contact is not None:
        failed_us = contact_us(log, contact)
    plans = [
        plan
        for plan in log.plans
        if failed_us - BEFORE_US <= plan.now_us <= failed_us and len(plan.trajectory) > 1
    ]
    if not plans:
        return []
    if contact is not None:
        actor = log.actors[contact.actor_id]
        leads = [_leads_into(log, plan.trajectory, actor) for plan in plans]
        property_text = f"before the failure leads into {words_of(actor, contact)}"
        facts = _since(plans, leads, failed_us, property_text)
        driven = speeds(log.ego)
        for plan in plans:
            speed = float(np.interp(plan.now_us, log.ego.t_us, driven))
            planned_mps = asked_mps(plan)
            if planned_mps < BRAKES * speed:
                before_s = (failed_us - plan.now_us) * 1e-6
                sentence = f"The first plan that brakes comes {before_s:.1f} s before the contact"
                return [*facts, f"{sentence}, at {speed:.1f} m/s."]
        return [
            *facts,
            f"No plan brakes: the last one asks for {planned_mps:.1f} m/s, at {speed:.1f} m/s.",
        ]
    if not outcomes or outcomes & {"stalled", "braked_without_cause"}:
        reaches = [float(np.hypot(*_ahead(plan, 2_000_000))) < STANDS_M for plan in plans]
        event = "failure" if outcomes else "end"
        property_text = f"before the {event} stands: less than {STANDS_M} m in two seconds"
    else:
        reaches = [_beside_m(plan) > AWAY_M for plan in plans]
        most_m = max(_beside_m(plan) for plan in plans)
        property_text = f"before the failure leads away from the route: up to {most_m:.1f} m beside it in two seconds"
    return _since(plans, reaches, failed_us, property_text)


def _since(
    plans: Sequence[LoggedPlan], flags: Sequence[bool], failed_us: int, property_text: str
) -> list[str]:
    """Say since when all plans have had a property; nothing where the last one does not."""
    first = len(flags) - [*flags[::-1], False].index(False)
    if first == len(plans):
        return []
    before_s = (failed_us - plans[first].now_us) * 1e-6
    return [f"Every plan of the last {before_s:.1f} s {property_text}."]


def _leads_into(log: RolloutLog, plan: Trajectory, actor: Actor) -> bool:
    """Tell whether the ego's box on a plan meets the box of a road user where it really went."""
    last_us = min(plan.t_us[-1], actor.track.t_us[-1])
    t_us = np.arange(max(plan.t_us[0], actor.track.t_us[0]), last_us + 1, STEP_US)
    ego = _boxes(interpolate(plan, t_us) @ log.T_rig_box, log.ego_box)
    return bool(shapely.intersects(ego, _boxes(interpolate(actor.track, t_us), actor.box)).any())


def _boxes(poses: F64, box: Box) -> Geometries:
    """Return the boxes at poses ``(N, 4, 4)`` of their centres as polygons ``(N,)``."""
    size = np.broadcast_to([box.length_m, box.width_m], (len(poses), 2))
    yaw = heading_of(poses[:, :2, 0])
    return shapely.polygons(rectangle_corners(poses[:, :2, 3], yaw, size))


def _ahead(plan: LoggedPlan, after_us: int) -> F64:
    """Return where a plan leads within some time, ``(2,)`` metres, rig frame at the query."""
    end_us = min(plan.trajectory.t_us[-1], plan.now_us + after_us)
    now, then = interpolate(plan.trajectory, np.array([plan.trajectory.t_us[0], end_us]))
    return (inverse(now) @ then)[:2, 3]


def asked_mps(plan: LoggedPlan) -> float:
    """Return the speed in m/s that a plan asks for one second ahead, or at its end where it is
    shorter: over its last tenth of a second up to there.
    """
    times_us = plan.trajectory.t_us
    end_us = min(times_us[-1], max(times_us[0] + STEP_US, plan.now_us + 1_000_000))
    begin_us = max(times_us[0], end_us - STEP_US)
    begin, end = interpolate(plan.trajectory, np.array([begin_us, end_us]))[:, :2, 3]
    return float(np.hypot(*(end - begin)) / ((end_us - begin_us) * 1e-6))


def _beside_m(plan: LoggedPlan) -> float:
    """Return how far from the route a plan ends two seconds ahead; 0 without a route."""
    route = plan.route[np.isfinite(plan.route).all(axis=1)]
    if len(route) < 2:
        return 0.0
    return float(
        shapely.distance(shapely.linestrings(route), shapely.points(_ahead(plan, 2_000_000)))
    )
