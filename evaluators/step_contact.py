"""Contact with other actors at logged instants: which step, which actor, which side of the ego; and the least gap.

Protocol (paper, appendix "Collision"): at each step the plan-view polygons of ego and actors are intersected; an actor that touches the
front-bumper segment is a front contact, else one that touches the rear-bumper segment a rear contact, else a lateral one. Touching counts
as contact.

All pairs of a rollout are handled at once: centre distances rule out nearly all of them, shapely's exact predicates decide the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.core.types import F64, I64
from evaluators.footprint import ActorTable, Footprints

FRONT, REAR, LATERAL = 0, 1, 2
# Slack of the distance filter: far above rounding, far below any size, so that the filter never rules out a touching pair.
_SLACK_M = 1e-6


@dataclass(frozen=True)
class Contacts:
    """Touching pairs, by step and then in the actors' order."""

    step: I64  # (M,) index into the ego's times
    actor: I64  # (M,) index into the actor table
    side: I64  # (M,) FRONT, REAR or LATERAL


def find_contacts(ego: Footprints, actors: ActorTable, t_us: I64) -> tuple[Contacts, F64]:
    """Find all contacts and the least gap per step.

    Args:
        ego: Footprints at the times.
        actors: All other actors.
        t_us: ``(T,)`` times.

    Returns:
        The contacts, and ``(T,)`` metres from the ego to the nearest actor: 0 on touch, inf where no actor is present.
    """
    gap_m = np.full(len(t_us), np.inf)
    none = np.zeros(0, dtype=np.int64)
    if len(actors) == 0:
        return Contacts(none, none, none), gap_m
    there = actors.at(t_us)
    centre_m = there.centre_distance_m(ego.xy)  # (A, T)
    at_least = centre_m - ego.radius_m[None] - actors.radius_m[:, None]
    at_most = centre_m - ego.inner_radius_m[None] - actors.inner_radius_m[:, None]
    # The nearest footprint is among those that could be as near as the surest one; every touching one is among them too.
    candidate = there.present & (at_least <= np.maximum(at_most.min(axis=0), 0.0)[None] + _SLACK_M)
    step, actor = np.nonzero(candidate.T)
    ego_shapes = ego.shapes()
    boxes = there.footprints(actor, step).shapes()
    distance_m = shapely.distance(ego_shapes[step], boxes)
    np.minimum.at(gap_m, step, distance_m)
    # Distance 0 and "intersects" may differ by rounding; the predicate is exact and decides, and the gap follows it.
    touch = shapely.intersects(ego_shapes[step], boxes)
    gap_m[step[touch]] = 0.0
    step, actor, boxes = step[touch], actor[touch], boxes[touch]
    front, rear = ego.take(step).bumpers()
    side = np.where(shapely.intersects(boxes, front), FRONT, np.where(shapely.intersects(boxes, rear), REAR, LATERAL))
    return Contacts(step, actor, side.astype(np.int64)), gap_m


def last_per_step(contacts: Contacts, ego: Footprints, actors: ActorTable, t_us: I64) -> Contacts:
    """Keep of each step's contacts the one that the spatial index names last.

    AlpaSim builds an STRtree of the ego and all present actors at every step, in the log's order, and the last result decides. The
    order depends on the tree's layout, so the tree is built the same way here, for the steps with more than one contact.
    """
    keep = np.ones(len(contacts.step), dtype=np.bool_)
    there = actors.at(t_us)
    for step in np.flatnonzero(np.bincount(contacts.step, minlength=len(t_us)) > 1):
        present = np.flatnonzero(there.present[:, step])
        shapes = np.concatenate([ego.take(np.array([step])).shapes(), there.footprints(present, np.full(len(present), step)).shapes()])
        order = [i for i in shapely.STRtree(shapes).query(shapes[0], predicate="intersects") if i != 0]
        rows = np.flatnonzero(contacts.step == step)
        keep[rows[contacts.actor[rows] != present[order[-1] - 1]]] = False
    return Contacts(contacts.step[keep], contacts.actor[keep], contacts.side[keep])
