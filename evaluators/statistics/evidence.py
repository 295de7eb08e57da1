"""What the driving and the plans of a failed rollout had to do with its failure, measured in its
log: facts, each a sentence, that name no cause. What happened in the second before the failure, at
that place, comes first.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from alpasim_plugin.core.geometry import (
    cross,
    heading_of,
    interpolate,
    inverse,
    rectangle_corners,
    speeds,
    transform_points,
)
from alpasim_plugin.core.json_types import JsonView
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
from evaluators.statistics.approach import (
    Approach,
    Neighbour,
    approach_of,
    gap_series,
    needed_mps2,
    neighbour_at,
    turns_of,
)
from evaluators.statistics.numbers import plural

CONTACT_OUTCOMES = ("collision_any", "collision_at_fault")
SLOW_OUTCOMES = {"stalled", "braked_without_cause"}
BEFORE_US = 6_000_000  # of the failure
LAST_US = 1_000_000  # of it, about which evidence comes first
STEP_US = 100_000
AWAY_M = 1.0  # from the route that the policy received
TURN_M = 2.0  # of a route beside the ego's axis
TURNS_SHARE = 0.25  # of it, which a plan that does not turn with it reaches
STANDS_M = 0.5
BRAKES_MPS = 0.5  # by which a plan that brakes asks for less, one second ahead
FASTER = 1.25  # share of the recorded speed from which on the ego is faster, and by how much more
FASTER_MPS = 1.5
SLOWER = 0.75
ASIDE_M = 0.4  # from the recorded path: less is no evidence
SWING_M = 0.25  # of an offset that swings to both sides
SWINGS = 3
SAME_PLAN_M = 0.01
STRAIGHT_M = 0.1  # beside its chord
HELD_S = 3.0  # before a failure: a plan that was held earlier has no part in it
SAME_PLANS = 3  # queries in a row with one plan
ROUTE_MOVED_M = 0.5  # by which the route near by has moved meanwhile in the rig frame
NEAR_POINTS = slice(1, 4)  # of the route, 4 to 13 m ahead: what lies farther need not change a plan


@dataclass(frozen=True)
class Failure:
    """A rollout at its failure, or at an end short of the path's.

    Attributes:
        log: Up to the failure at least.
        failed_us: When it failed, or ended.
        outcomes: Names of its outcomes; none of a drive that ended short.
        contact: What it failed with, as `contact_of_failure` gives it; None where that is no
            contact.
        approach: The seconds before; None where nothing could be measured.
        nearest: Who was touched, or else is the nearest one ahead at the failure: kind and id.
        gap_m: ``(T,)`` to that one at the steps of the approach, NaN where it is not there.
    """

    log: RolloutLog
    failed_us: int
    outcomes: frozenset[str]
    contact: Contact | None
    approach: Approach | None
    nearest: str = ""
    gap_m: F64 | None = None

    @classmethod
    def of(
        cls,
        log: RolloutLog,
        failed_us: int,
        outcomes: frozenset[str],
        contact: Contact | None,
        content: JsonView,
    ) -> "Failure":
        """Measure a failure.

        Args:
            log, failed_us, outcomes, contact: As the attributes; of a contact its own beginning
                counts.
            content: ``scenes/SCENE.json``.
        """
        if contact is not None:
            failed_us = contact_us(log, contact)
        approach = approach_of(log, failed_us, content)
        failure = cls(log, failed_us, outcomes, contact, approach)
        ahead = neighbour_at(log, failed_us)
        actor = None if ahead is None else ahead.actor
        if contact is not None:
            actor = log.actors[contact.actor_id]
        if approach is None or actor is None:
            return failure
        gap_m = gap_series(log, approach.t_us, actor.actor_id)
        return replace(failure, nearest=f"{kind_of(actor)} {actor.actor_id}", gap_m=gap_m)

    @property
    def plans(self) -> list[LoggedPlan]:
        """List the plans of the seconds before."""
        return [
            plan
            for plan in self.log.plans
            if self.failed_us - BEFORE_US <= plan.now_us <= self.failed_us
            and len(plan.trajectory) > 1
        ]

    @property
    def is_slow(self) -> bool:
        """Tell whether it failed because it was slow, or ended short."""
        return not self.outcomes or bool(self.outcomes & SLOW_OUTCOMES)

    def before_s(self, plan: LoggedPlan) -> float:
        """Return how long before the failure a plan was asked for, seconds."""
        return (self.failed_us - plan.now_us) * 1e-6

    def speed_mps(self, t_us: int) -> float:
        """Return the ego's speed at an instant."""
        return float(np.interp(t_us, self.log.ego.t_us, speeds(self.log.ego)))


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


def kind_of(actor: Actor) -> str:
    """Return what kind of road user an actor is, in a word or two."""
    if actor.actor_id.startswith(STANDING_ID):
        return "standing obstacle"
    return actor.label if actor.label in KINDS else "road user"


def words_of(actor: Actor, contact: Contact) -> str:
    """Say what kind of road user was touched, where it is seen from the ego, and its id."""
    place = {"front": "ahead", "rear": "behind"}.get(contact.side)
    if place is None:
        place = "on the left" if contact.y_m > 0.0 else "on the right"
    return f"the {kind_of(actor)} {place} (`{actor.actor_id}`)"


def failure_facts(failure: Failure) -> list[str]:
    """Return what the driving before a failure, or before an end short of the path's, was: the most
    telling first.
    """
    facts = [held_plan_fact(failure)]
    if failure.is_slow:
        facts += [slow_fact(failure), *plan_facts(failure)]
    elif failure.contact is not None:
        facts += [speed_fact(failure), *contact_facts(failure), side_fact(failure)]
    elif _plans_do_not_turn(failure):
        # At no speed do such plans lead along the route.
        facts += [side_fact(failure), *plan_facts(failure), speed_fact(failure)]
    else:
        facts += [speed_fact(failure), swing_fact(failure), side_fact(failure)]
        facts += plan_facts(failure)
    return [text for text in facts if text]


def _plans_do_not_turn(failure: Failure) -> bool:
    """Tell whether the route turns and no plan of the last second turns with it. Plans of an ego
    that is too fast for a bend do, though less than the route.
    """
    last = [plan for plan in failure.plans if failure.before_s(plan) <= LAST_US * 1e-6]
    turned = [_turned_share(plan) for plan in last]
    return bool(turned) and all(share is not None and share < TURNS_SHARE for share in turned)


def _turned_share(plan: LoggedPlan) -> float | None:
    """Return how far beside the ego's axis a plan ends two seconds ahead, as a share of how far the
    route lies there beside it; negative to the other side, None where the route leads straight on.
    """
    route = plan.route[np.isfinite(plan.route).all(axis=1)]
    if not len(route):
        return None
    end = _ahead(plan, 2_000_000)
    away_m = np.hypot(route[:, 0], route[:, 1])
    aside_m = float(route[np.abs(away_m - np.hypot(*end)).argmin(), 1])
    return float(end[1]) / aside_m if abs(aside_m) > TURN_M else None


def speed_fact(failure: Failure) -> str:
    """Say where the ego drives much faster than the recording at the same place: in the second
    before, or, before a contact, where the recording did not slow down yet. Where the recording did,
    say whether the ego is much faster than the recording is anywhere before; empty where it is not.
    """
    approach = failure.approach
    if approach is None or failure.is_slow:
        return ""
    v = approach.speed_mps
    recorded = approach.recorded_mps
    comparable = np.isfinite(recorded)
    if failure.contact is None:
        comparable &= approach.t_us >= approach.t_us[-1] - LAST_US
    elif comparable.any():
        comparable &= recorded >= 0.9 * np.nanmax(recorded)
    is_faster = comparable & (_margin_mps(v, recorded) > 0.0)
    if not is_faster.any():
        return "" if failure.contact is None else _above_fastest_fact(approach)
    worst = int(np.flatnonzero(is_faster)[np.argmax((v - recorded)[is_faster])])
    before_s = (approach.t_us[-1] - approach.t_us[worst]) * 1e-6
    moment = f"{before_s:.1f} s before the failure" if before_s >= 0.05 else "At the failure"
    return (
        f"{moment} it drives {v[worst]:.1f} m/s "
        f"where the recording drives {recorded[worst]:.1f} m/s{_posted_words(approach)}."
    )


def _above_fastest_fact(approach: Approach) -> str:
    """Say by what the ego is much faster at a failure than the recording is anywhere in the seconds
    before; empty where it is not.
    """
    if not np.isfinite(approach.recorded_mps).any():
        return ""
    fastest_mps = float(np.nanmax(approach.recorded_mps))
    if not _margin_mps(approach.speed_mps, fastest_mps)[-1] > 0.0:
        return ""
    return (
        f"At the failure it drives {approach.speed_mps[-1]:.1f} m/s; up to there the recording drives at most "
        f"{fastest_mps:.1f} m/s{_posted_words(approach)}."
    )


def _margin_mps(speed_mps: F64, recorded_mps: F64 | float) -> F64:
    """Return by how much speeds ``(T,)`` are above what counts as much faster than recorded."""
    return speed_mps - np.maximum(FASTER * recorded_mps, recorded_mps + FASTER_MPS)


def _posted_words(approach: Approach) -> str:
    return "" if approach.limit_mps is None else f"; {approach.limit_mps:.1f} m/s are posted"


def side_fact(failure: Failure) -> str:
    """Say to which side of the recorded path the ego moves in the second before a failure, and in
    which bend; empty where it stays on it.
    """
    approach = failure.approach
    if approach is None:
        return ""
    lateral = approach.lateral_m
    before_m, last_m = float(lateral[approach.index(1.0)]), float(lateral[-1])
    if not abs(last_m) >= ASIDE_M:
        return ""
    side = _side(last_m)
    begin = f"{abs(before_m):.1f}"
    if _side(before_m) != side and abs(before_m) >= 0.05:
        begin = f"{abs(before_m):.1f} m {_side(before_m)}"
    place = ""
    if approach.bend:
        edge = "inside" if approach.bend == side else "outside"
        place = f", on the {edge} of a {approach.bend}-hand bend"
    since_s = _aside_since_s(approach)
    lasting = f", and has been {side} of it for {since_s:.1f} s" if since_s > 1.5 else ""
    return (
        f"In the last second it moves from {begin} to {abs(last_m):.1f} m {side} of the recorded "
        f"path{place}{lasting}."
    )


def _side(left_m: float) -> str:
    return "left" if left_m > 0.0 else "right"


def _aside_since_s(approach: Approach) -> float:
    """Return for how long the ego has been on the side where it is last, seconds."""
    is_same = np.sign(approach.lateral_m) == np.sign(approach.lateral_m[-1])
    is_aside = is_same & (np.abs(approach.lateral_m) > ASIDE_M / 2)
    first = len(is_aside) - int(np.argmin([*is_aside[::-1], False]))
    return float((approach.t_us[-1] - approach.t_us[min(first, len(is_aside) - 1)]) * 1e-6)


def swing_fact(failure: Failure) -> str:
    """Say how the ego swings from side to side of a straight recorded path, farther and farther;
    empty where it does not.
    """
    approach = failure.approach
    if approach is None or np.abs(approach.bend_rad).max() > 0.5:
        return ""
    peaks = turns_of(approach.lateral_m, SWING_M)
    if len(peaks) < SWINGS or abs(peaks[-1]) < abs(peaks[0]):
        return ""
    sides = ", ".join(f"{abs(peak):.1f} m {_side(peak)}" for peak in peaks[-4:])
    return f"Before the failure it swings from side to side of the recorded path: {sides}."


def held_plan_fact(failure: Failure) -> str:
    """Say that queries in a row got one plan while the route moved; empty where each got its own."""
    plans = failure.plans
    longest: list[LoggedPlan] = []
    streak: list[LoggedPlan] = []
    for plan in plans:
        is_same = bool(streak) and _is_same(failure.log, streak[-1], plan)
        streak = [*streak, plan] if is_same else [plan]
        if len(streak) > len(longest) and abs(_route_moved_m(streak[0], plan)) > ROUTE_MOVED_M:
            longest = streak
    if len(longest) < SAME_PLANS or failure.before_s(longest[-1]) > HELD_S:
        return ""
    moved_m = _route_moved_m(longest[0], longest[-1])
    queries = plural(len(longest), "query", "queries")
    until_s = failure.before_s(longest[-1])
    until = f", until {until_s:.1f} s before the failure" if until_s >= 0.15 else ""
    if _is_straight(longest[-1]):
        return (
            f"Plans lead straight on in {queries} in a row, where the route turns "
            f"{_side(moved_m)}{until}."
        )
    return (
        f"{queries} in a row get the same plan, seen from the ego, while the route moves by "
        f"{abs(moved_m):.1f} m{until}."
    )


def _is_straight(plan: LoggedPlan) -> bool:
    """Tell whether a plan leads along a straight line."""
    xy = plan.trajectory.xyz[:, :2]
    chord = xy[-1] - xy[0]
    length_m = float(np.hypot(*chord))
    return length_m > 0.0 and bool(np.abs(cross(chord, xy - xy[0])).max() < STRAIGHT_M * length_m)


def _in_rig(log: RolloutLog, plan: LoggedPlan) -> F64:
    """Return a plan's positions ``(T, 3)`` in the rig frame at its query."""
    rig = interpolate(log.ego, plan.now_us) @ inverse(log.T_rig_box)
    return transform_points(inverse(rig), plan.trajectory.xyz)


def _is_same(log: RolloutLog, plan: LoggedPlan, other: LoggedPlan) -> bool:
    points, others = _in_rig(log, plan), _in_rig(log, other)
    return points.shape == others.shape and bool(np.abs(points - others).max() < SAME_PLAN_M)


def _route_moved_m(plan: LoggedPlan, other: LoggedPlan) -> float:
    """Return how far the route near by has moved to the left between two queries."""
    if plan.route.shape != other.route.shape or len(plan.route) < NEAR_POINTS.stop:
        return 0.0
    moved = other.route[NEAR_POINTS, 1] - plan.route[NEAR_POINTS, 1]
    moved = moved[np.isfinite(moved)]
    return float(max(moved, key=abs, default=0.0))


def slow_fact(failure: Failure) -> str:
    """Say how slow the ego is against the recording, and who is ahead of it where it slows down;
    empty where it is not slower.
    """
    approach = failure.approach
    if approach is None:
        return ""
    v = approach.speed_mps
    recorded = approach.recorded_mps[-1]
    if not np.isfinite(recorded):
        finite = approach.recorded_mps[np.isfinite(approach.recorded_mps)]
        recorded = finite[-1] if len(finite) else np.nan
    if not v[-1] < SLOWER * recorded:
        return ""
    fastest = float(v.max())
    begin = int(np.flatnonzero(v >= 0.95 * fastest)[-1])
    for_s = (approach.t_us[-1] - approach.t_us[begin]) * 1e-6
    if v[-1] < SLOWER * fastest:
        motion = f"It slows from {v[begin]:.1f} to {v[-1]:.1f} m/s within {for_s:.1f} s"
    else:
        motion = f"It drives {v[-1]:.1f} m/s"
        begin = len(v) - 1
    ahead = neighbour_at(failure.log, int(approach.t_us[begin]))
    return f"{motion}, where the recording drives {recorded:.1f} m/s; {_ahead_words(ahead)}."


def _ahead_words(neighbour: Neighbour | None) -> str:
    """Say who is ahead of the ego and whether that one is in its way."""
    if neighbour is None:
        return "nobody is ahead of it"
    heading = "oncoming " if neighbour.towards else ""
    name = f"{heading}{kind_of(neighbour.actor)} (`{neighbour.actor.actor_id}`)"
    if neighbour.is_in_way:
        return f"the {name} is {neighbour.gap_m:.0f} m ahead in its way"
    side = f"{abs(neighbour.left_m):.1f} m to the {_side(neighbour.left_m)}"
    return f"nobody is in its way: the nearest is the {name}, {neighbour.ahead_m:.0f} m ahead and {side}"


def contact_facts(failure: Failure) -> list[str]:
    """Return what a contact came of: the last second of braking and where plans led."""
    contact = failure.contact
    plans = failure.plans
    if contact is None or not plans:
        return []
    log = failure.log
    actor = log.actors[contact.actor_id]
    words = words_of(actor, contact)
    leads = [_leads_into(log, plan.trajectory, actor) for plan in plans]
    leading = _since(failure, plans, leads, f"before the failure leads into {words}")
    if contact.side != "front":
        return leading
    into = f", and leads into {words}" if leads[-1] else f" before the contact with {words}"
    return [*_braking_facts(failure, plans, actor, into), *leading]


def _braking_facts(
    failure: Failure, plans: Sequence[LoggedPlan], actor: Actor, into: str
) -> list[str]:
    """Say how the ego brakes in the second before a contact, what would have been enough, and when
    its plans braked.
    """
    brakes = [asked_mps(plan) < failure.speed_mps(plan.now_us) - BRAKES_MPS for plan in plans]
    before_mps = failure.speed_mps(failure.failed_us - LAST_US)
    last_mps = failure.speed_mps(failure.failed_us)
    last = [flag for plan, flag in zip(plans, brakes, strict=True) if failure.before_s(plan) <= 1.0]
    if not any(last):
        sentence = f"In the last second no plan brakes, at {last_mps:.1f} m/s{into}."
        return [sentence, _earlier_braking(failure, plans, brakes, actor)]
    first = len(brakes) - [*brakes[::-1], False].index(False)
    since = plans[min(first, len(plans) - 1)]
    enough = needed_mps2(failure.log, since.now_us, actor)
    since_s = failure.before_s(since)
    needed = "no braking would have been enough"
    if enough is not None:
        needed = f"{enough:.1f} m/s2 would have been enough"
    return [
        f"In the last second it brakes from {before_mps:.1f} to {last_mps:.1f} m/s, with "
        f"{before_mps - last_mps:.1f} m/s2{into}; from its first braking plan on, {since_s:.1f} s "
        f"before, {needed}."
    ]


def _earlier_braking(
    failure: Failure, plans: Sequence[LoggedPlan], brakes: Sequence[bool], actor: Actor
) -> str:
    """Say which earlier plans braked, and with what the contact could have been avoided."""
    braking = [plan for plan, flag in zip(plans, brakes, strict=True) if flag]
    enough = needed_mps2(failure.log, failure.failed_us - 2 * LAST_US, actor)
    needed = ""
    if enough is not None:
        needed = f"; braking with {enough:.1f} m/s2 from 2.0 s before on would have been enough"
    if not braking:
        span_s = failure.before_s(plans[0])
        return f"No plan of the {span_s:.1f} s before the contact brakes{needed}."
    return (
        f"{plural(len(braking), 'earlier plan')} braked, the last {failure.before_s(braking[-1]):.1f} s "
        f"before the contact{needed}."
    )


def plan_facts(failure: Failure) -> list[str]:
    """Say since when plans have led away from the route, or stand."""
    plans = failure.plans
    if not plans:
        return []
    if failure.is_slow:
        reaches = [float(np.hypot(*_ahead(plan, 2_000_000))) < STANDS_M for plan in plans]
        event = "failure" if failure.outcomes else "end"
        text = f"before the {event} stands: less than {STANDS_M} m in two seconds"
        return _since(failure, plans, reaches, text)
    beside_m = [_beside_m(plan) for plan in plans]
    farthest_m = max(beside_m, key=abs)
    text = (
        f"before the failure leads away from the route: up to {abs(farthest_m):.1f} m "
        f"{_side(farthest_m)} of it in two seconds"
    )
    return _since(failure, plans, [abs(aside_m) > AWAY_M for aside_m in beside_m], text)


def _since(
    failure: Failure, plans: Sequence[LoggedPlan], flags: Sequence[bool], property_text: str
) -> list[str]:
    """Say since when all plans have had a property; nothing where the last one does not."""
    first = len(flags) - [*flags[::-1], False].index(False)
    if first == len(plans):
        return []
    return [f"Every plan of the last {failure.before_s(plans[first]):.1f} s {property_text}."]


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
    """Return how far beside the route a plan ends two seconds ahead, left positive; 0 without a
    route.
    """
    route = plan.route[np.isfinite(plan.route).all(axis=1)]
    if len(route) < 2:
        return 0.0
    line = shapely.linestrings(route)
    end = _ahead(plan, 2_000_000)
    point = shapely.points(end)
    distance_m = float(shapely.distance(line, point))
    along_m = float(shapely.line_locate_point(line, point))
    ends = [shapely.line_interpolate_point(line, max(along_m + d, 0.0)) for d in (-0.5, 0.5)]
    begin, then = (shapely.get_coordinates(end_point)[0] for end_point in ends)
    return float(np.copysign(distance_m, cross(then - begin, end - begin)))
