"""Contact with other actors, at logged instants and between them: which actor, which side of the
ego, when and where; and the least gap.

**At steps** (paper, appendix "Collision"): the plan-view polygons of ego and actors are
intersected; an actor that touches the front-bumper segment is a front contact, else one that
touches the rear-bumper segment a rear contact, else a lateral one. Touching counts as contact. All
pairs of a rollout are handled at once: centre distances rule out nearly all of them, shapely's
exact predicates decide the rest.

**Between steps** a body's centre moves straight and its heading turns at a constant rate the
shorter way. Distances of the centres rule out nearly all pairs; the rest is solved by `evaluators.metrics.sweep`, for all pairs at once. A contact has one
side from its beginning to its end: the one that its normal leaves the ego through, front, rear or
lateral. At a corner that is the side nearer to the normal's direction; a tie is front before rear
before lateral. Contact that is there from the start, or from an actor's first logged time, has no
first touch; its normal is the shortest way out of the overlap.
"""

from dataclasses import dataclass

import numpy as np
import shapely

from alpasim_plugin.core.geometry import in_axes, rectangle_corners, wrap_angle
from alpasim_plugin.core.types import F64, I64, Bool
from evaluators.metrics.footprint import ActorTable, Footprints
from evaluators.metrics.sweep import Motions, first_contact, gaps

FRONT = 0
REAR = 1
LATERAL = 2
# Slack of the distance filter: far above rounding, far below any size, so that the filter never
# rules out a touching pair.
_SLACK_M = 1e-6
_SLACK_S = 1e-9  # far below the microsecond of the logs, far above the rounding of seconds
# Where two bodies touch is read off their overlap when the ego is this much larger on every side.
PLACE_M = 1e-6


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
        The contacts, and ``(T,)`` metres from the ego to the nearest actor: 0 on touch, inf where
        no actor is present.
    """
    gap_m = np.full(len(t_us), np.inf)
    none = np.zeros(0, dtype=np.int64)
    if len(actors) == 0:
        return Contacts(none, none, none), gap_m
    actors_at = actors.at(t_us)
    centre_m = actors_at.centre_distance_m(ego.xy)  # (A, T)
    at_least = centre_m - ego.radius_m[None] - actors.radius_m[:, None]
    at_most = centre_m - ego.inner_radius_m[None] - actors.inner_radius_m[:, None]
    # The nearest footprint is among those that could be as near as the surest one; every touching
    # one is among them too.
    candidate = actors_at.present & (
        at_least <= np.maximum(at_most.min(axis=0), 0.0)[None] + _SLACK_M
    )
    step, actor = np.nonzero(candidate.T)
    ego_shapes = ego.shapes()
    boxes = actors_at.footprints(actor, step).shapes()
    distance_m = shapely.distance(ego_shapes[step], boxes)
    np.minimum.at(gap_m, step, distance_m)
    # Distance 0 and "intersects" may differ by rounding; the predicate is exact and decides, and
    # the gap follows it.
    touch = shapely.intersects(ego_shapes[step], boxes)
    gap_m[step[touch]] = 0.0
    step = step[touch]
    actor = actor[touch]
    boxes = boxes[touch]
    front, rear = ego.take(step).bumpers()
    side = np.where(
        shapely.intersects(boxes, front),
        FRONT,
        np.where(shapely.intersects(boxes, rear), REAR, LATERAL),
    )
    return Contacts(step, actor, side.astype(np.int64)), gap_m


def begin_at_steps(contacts: Contacts, n_actors: int, n_steps: int) -> tuple[I64, I64]:
    """Return at which steps ``(B,)`` which actors ``(B,)`` touch the ego that do not touch it at
    the step before.
    """
    touch = np.zeros((n_actors, n_steps), dtype=np.bool_)
    touch[contacts.actor, contacts.step] = True
    before = np.zeros_like(touch)
    before[:, 1:] = touch[:, :-1]
    actor, step = np.nonzero(touch & ~before)
    return step, actor


def last_per_step(contacts: Contacts, ego: Footprints, actors: ActorTable, t_us: I64) -> Contacts:
    """Keep of each step's contacts the one that the spatial index names last.

    AlpaSim builds an STRtree of the ego and all present actors at every step, in the log's order,
    and the last result decides. The order depends on the tree's layout, so the tree is built the
    same way here, for the steps with more than one contact.
    """
    keep = np.ones(len(contacts.step), dtype=np.bool_)
    actors_at = actors.at(t_us)
    for step in np.flatnonzero(np.bincount(contacts.step, minlength=len(t_us)) > 1):
        present = np.flatnonzero(actors_at.present[:, step])
        shapes = np.concatenate(
            [
                ego.take(np.array([step])).shapes(),
                actors_at.footprints(present, np.full(len(present), step)).shapes(),
            ]
        )
        order = [
            i for i in shapely.STRtree(shapes).query(shapes[0], predicate="intersects") if i != 0
        ]
        rows = np.flatnonzero(contacts.step == step)
        keep[rows[contacts.actor[rows] != present[order[-1] - 1]]] = False
    return Contacts(contacts.step[keep], contacts.actor[keep], contacts.side[keep])


@dataclass(frozen=True)
class ContactOnsets:
    """When and where contacts begin, by actor and then by time."""

    actor: I64  # (B,) index into the actor table
    t_s: F64  # (B,) since the ego's first pose
    side: I64  # (B,) FRONT, REAR or LATERAL
    xy: F64  # (B, 2) on the ego's rectangle, metres from its centre, x forward


@dataclass(frozen=True)
class SweptContacts:
    """Rows in which an actor touches the ego: at the row's time, or at any time since the row
    before.
    """

    step: I64  # (M,)
    actor: I64  # (M,)
    begin: I64  # (M,) index into the onsets
    onsets: ContactOnsets

    @property
    def side(self) -> I64:
        """Side of each row's contact."""
        return self.onsets.side[self.begin]

    @property
    def begun(self) -> tuple[I64, I64]:
        """Give the first row ``(B,)`` and the actor ``(B,)`` of each contact."""
        begin, first = np.unique(self.begin, return_index=True)
        row = np.full(len(begin), np.iinfo(np.int64).max)
        np.minimum.at(row, np.searchsorted(begin, self.begin), self.step)
        return row, self.actor[first]


@dataclass(frozen=True)
class _Found:
    """First contacts within an interval between two steps."""

    actor: I64  # (M,)
    interval: I64  # (M,) from step i to step i + 1
    t_s: F64  # (M,)
    side: I64  # (M,)
    xy: F64  # (M, 2)


def find_swept(
    ego: Footprints, actors: ActorTable, t_us: I64, at_steps: Contacts, handover_us: int
) -> SweptContacts:
    """Find all contacts at and between steps.

    Args:
        ego: Footprints at the times, sharp-cornered.
        actors: All other actors.
        t_us: ``(T,)`` times.
        at_steps: What touches at the times themselves; decided by exact predicates.
        handover_us: When the policy takes over. A contact before it belongs to the row before it,
            although the next row is the policy's.
    """
    touch = np.zeros((len(actors), len(t_us)), dtype=np.bool_)
    touch[at_steps.actor, at_steps.step] = True
    between = _between(ego, actors, t_us, touch)
    forced = (between.t_s < (handover_us - t_us[0]) * 1e-6) & (
        t_us[np.minimum(between.interval + 1, len(t_us) - 1)] >= handover_us
    )
    row = np.where(forced, between.interval, between.interval + 1)
    began = np.zeros_like(touch)
    began[between.actor, np.minimum(between.interval + 1, len(t_us) - 1)] = True
    before = np.zeros_like(touch)
    before[:, 1:] = touch[:, :-1]
    fresh = np.flatnonzero(~(before | began)[at_steps.actor, at_steps.step])
    onsets, order = _onsets(between, at_steps, fresh, ego, actors, t_us)
    place_of = np.empty(len(order), dtype=np.int64)
    place_of[order] = np.arange(len(order))
    # Rows with contact at their own time follow the latest beginning of that actor; the others are
    # the beginning's own row.
    span = (t_us[-1] - t_us[0]) * 1e-6 + 1.0
    keys = onsets.actor * span + onsets.t_s
    times = at_steps.actor * span + (t_us[at_steps.step] - t_us[0]) * 1e-6
    latest = np.searchsorted(keys, times + _SLACK_S, side="right") - 1
    alone = np.flatnonzero(~touch[between.actor, row])
    step = np.concatenate([at_steps.step, row[alone]])
    actor = np.concatenate([at_steps.actor, between.actor[alone]])
    begin = np.concatenate([latest, place_of[alone]])
    rank = np.lexsort((actor, step))
    return SweptContacts(step[rank], actor[rank], begin[rank], onsets)


def _onsets(
    between: _Found, at_steps: Contacts, fresh: I64, ego: Footprints, actors: ActorTable, t_us: I64
) -> tuple[ContactOnsets, I64]:
    """Join contacts found between steps with those that are there at once; also return how they
    were sorted (found ones first).
    """
    step = at_steps.step[fresh]
    actor = at_steps.actor[fresh]
    boxes = actors.boxes(actor, t_us[step])
    still = np.zeros((len(fresh), 2))
    bodies = ego.take(step)
    half = np.stack([bodies.size, boxes.size], axis=1) / 2
    pairs = Motions(
        boxes.xy - bodies.xy, still, np.stack([bodies.yaw, boxes.yaw], axis=1), still, half
    )
    at_once, xy = _place(pairs, np.zeros(len(fresh)))
    who = np.concatenate([between.actor, actor])
    t_s = np.concatenate([between.t_s, (t_us[step] - t_us[0]) * 1e-6])
    side = np.concatenate([between.side, at_once])
    order = np.lexsort((t_s, who))
    return ContactOnsets(
        who[order], t_s[order], side[order], np.concatenate([between.xy, xy])[order]
    ), order


def _between(ego: Footprints, actors: ActorTable, t_us: I64, touch: Bool) -> _Found:
    """Find the first contact of each actor in each interval at whose start it does not touch."""
    # Cut the presence of each actor at the steps and at its own logged times.
    pieces = [np.zeros((3, 0), dtype=np.int64)]
    for a in range(len(actors)):
        logged = actors.times_of(a)
        knots = np.union1d(t_us, logged)
        first_us = max(logged[0], t_us[0])
        last_us = min(logged[-1], t_us[-1])
        knots = knots[(knots >= first_us) & (knots <= last_us)]
        starts = knots[:-1]
        ends = knots[1:]
        if len(knots) == 1 and knots[0] not in t_us:
            starts = ends = knots
        pieces.append(np.stack([np.full(len(starts), a), starts, ends]))
    actor, t0, t1 = np.concatenate(pieces, axis=1)
    interval = np.searchsorted(t_us, t0, side="right") - 1
    is_open = ~touch[actor, interval]
    is_open &= actors.on_level(actor, t0) | actors.on_level(actor, t1)
    actor, interval, t0, t1 = actor[is_open], interval[is_open], t0[is_open], t1[is_open]
    pairs = _motions(ego, actors, t_us, actor, interval, t0, t1)
    near = np.flatnonzero(pairs.distance_m() <= pairs.radius_m().sum(axis=1) + _SLACK_M)
    tau = first_contact(pairs.take(near))
    hit = np.flatnonzero(np.isfinite(tau))
    rows = near[hit]
    tau = tau[hit]
    side, xy = _place(pairs.take(rows), tau)
    t_s = (t0[rows] - t_us[0]) * 1e-6 + tau * (t1[rows] - t0[rows]) * 1e-6
    # Pieces of a pair run forward in time: the first hit is the earliest.
    _, first = np.unique(np.stack([actor[rows], interval[rows]], axis=1), axis=0, return_index=True)
    return _Found(actor[rows][first], interval[rows][first], t_s[first], side[first], xy[first])


def _motions(
    ego: Footprints, actors: ActorTable, t_us: I64, actor: I64, interval: I64, t0: I64, t1: I64
) -> Motions:
    """Return the relative motion of ego and actors over pieces ``(M,)`` from t0 to t1 within an
    interval.
    """
    span = (t_us[interval + 1] - t_us[interval]).astype(np.float64)
    turn = wrap_angle(ego.yaw[interval + 1] - ego.yaw[interval])
    ego_at = []
    for t in (t0, t1):
        f = (t - t_us[interval]) / span
        ego_at.append(
            (
                ego.xy[interval] * (1 - f)[:, None] + ego.xy[interval + 1] * f[:, None],
                ego.yaw[interval] + f * turn,
            )
        )
    first = actors.boxes(actor, t0)
    last = actors.boxes(actor, t1)
    start = first.xy - ego_at[0][0]
    return Motions(
        start,
        last.xy - ego_at[1][0] - start,
        np.stack([ego_at[0][1], first.yaw], axis=1),
        np.stack([ego_at[1][1] - ego_at[0][1], wrap_angle(last.yaw - first.yaw)], axis=1),
        np.stack([ego.size[interval], first.size], axis=1) / 2,
    )


def _place(pairs: Motions, tau: F64) -> tuple[I64, F64]:
    """Return side ``(M,)`` and place ``(M, 2)`` of touching pairs: the middle of what they share,
    in the ego's box frame.
    """
    center = pairs.start + tau[:, None] * pairs.shift
    yaw = pairs.yaw + tau[:, None] * pairs.turn
    centre_in_box = in_axes(center, yaw[:, 0])
    half = pairs.half[:, 0]
    flat = np.zeros(len(tau))
    ego_box = shapely.polygons(rectangle_corners(np.zeros_like(half), flat, 2 * (half + PLACE_M)))
    other_box = shapely.polygons(
        rectangle_corners(centre_in_box, yaw[:, 1] - yaw[:, 0], 2 * pairs.half[:, 1])
    )
    shared = shapely.intersection(ego_box, other_box)
    middle = shapely.get_coordinates(shapely.centroid(shared)).reshape(-1, 2)
    gap = gaps(pairs, tau)  # (M, 8)
    turned = pairs.yaw[:, 1] - pairs.yaw[:, 0] + tau * (pairs.turn[:, 1] - pairs.turn[:, 0])
    cosine = np.cos(turned)
    sine = np.sin(turned)
    ones = np.ones(len(tau))
    zero = np.zeros(len(tau))
    # Forward and left part of the directions that `gaps` looks along, ego's first; odd columns look
    # the other way.
    forward = np.repeat(np.stack([ones, zero, cosine, -sine], axis=1), 2, axis=1)
    forward *= np.tile([1.0, -1.0], 4)
    left = np.repeat(np.stack([zero, ones, sine, cosine], axis=1), 2, axis=1)
    normal = gap >= gap.max(axis=1, keepdims=True) - PLACE_M
    along = np.abs(forward) >= np.abs(left)
    front, rear = (np.any(normal & along & (forward * sign > 0), axis=1) for sign in (1, -1))
    side = np.where(front, FRONT, np.where(rear, REAR, LATERAL)).astype(np.int64)
    return side, np.clip(middle, -half, half)
