"""How a drive ends, in words: every outcome is defined here once, and those that no other evaluator
gives are found here.

An ego that is much slower than the recording is excused where it has a cause: a road user on the
recorded path ahead of it or about to be there, a traffic light there that is not green, a place at
which the recording was slow as well, or the end of the path.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import shapely

from alpasim_plugin.core.geometry import arc_lengths, inverse, offset_trajectory, speeds
from alpasim_plugin.core.lights_passed import passings
from alpasim_plugin.core.path_end import ends_with_path
from alpasim_plugin.core.types import (
    F64,
    I64,
    Bool,
    LaneMap,
    MetricSeries,
    RolloutLog,
    Scene,
    Trajectory,
)
from alpasim_plugin.log.run_folder.records import DriveEvent
from evaluators.metrics.footprint import ActorTable, ego_footprints, origin_of
from evaluators.metrics.motion import time_to_collision_s
from evaluators.metrics.presets import Preset
from evaluators.metrics.route import (
    NO_DIRECTION,
    followed,
    on_route,
    recorded_path,
    to_path,
    way_beyond,
)
from evaluators.metrics.score import handover_us, series, with_preset
from evaluators.metrics.scored import ScoredRollout
from evaluators.metrics.table import LEFT_ROUTE_M, METRICS

if TYPE_CHECKING:
    from alpasim_plugin.log.run_folder.rows import Rollout


@dataclass(frozen=True)
class Outcome:
    """One way in which a drive fails.

    Attributes:
        name: Its metric, or the failure class of a rollout that has no metrics.
        words: What sentences call it.
        implied_by: Outcomes that say more, beside which this one is not named.
        ending: What tables of endings call it, where that is not its words.
    """

    name: str
    words: str
    implied_by: tuple[str, ...] = ()
    ending: str = ""


POLICY_FAULT = "policy"  # the failure class of a rollout that the policy broke
OUTCOMES = {  # the gravest first
    outcome.name: outcome
    for outcome in (
        Outcome(POLICY_FAULT, "policy fault"),
        Outcome("collision_at_fault", "at-fault collision", ending="collision"),
        Outcome("collision_any", "collision", ("collision_at_fault",)),
        Outcome("offroad", "off-road"),
        Outcome("wrong_lane", "wrong lane"),
        Outcome("left_route", "left the route"),
        Outcome("ended_in_danger", "ended in danger", ("collision_at_fault", "collision_any")),
        Outcome("stalled", "stalled"),
        Outcome("braked_without_cause", "braked without cause", ("stalled",)),
    )
}
NO_OUTCOME = "no event"
CONTACT_SIDES = (
    "collision_front",
    "collision_lateral",
    "collision_rear",
)  # events name a contact by its side
REACHED = 0.95  # share of the recorded path from which on a drive has reached its end


def outcomes_of(rollout: Rollout) -> frozenset[str]:
    """Return the names of the outcomes of a rollout; none where another part of the program
    failed.
    """
    if not rollout.ok:
        return frozenset({POLICY_FAULT} if rollout.failure_class == POLICY_FAULT else ())
    return frozenset(name for name in OUTCOMES if rollout.flag(name))


def told(had: Iterable[str]) -> list[Outcome]:
    """Return the outcomes that are named, the gravest first."""
    names = set(had)
    return [
        outcome
        for name, outcome in OUTCOMES.items()
        if name in names and not names & set(outcome.implied_by)
    ]


def gravity(rollout: Rollout) -> int:
    """Return the rank of the gravest outcome of a rollout, 0 first; beyond all without one."""
    had = outcomes_of(rollout)
    return next((rank for rank, name in enumerate(OUTCOMES) if name in had), len(OUTCOMES))


def worst_of(rollouts: Iterable[Rollout]) -> Rollout | None:
    """Return the rollout that failed worst: one that broke off, then the gravest outcome, then the
    first; None where none failed.
    """
    failed = [rollout for rollout in rollouts if not rollout.ok or outcomes_of(rollout)]
    return min(failed, key=lambda rollout: gravity(rollout) if rollout.ok else -1, default=None)


def in_words(had: Iterable[str]) -> str:
    """Name outcomes.

    Example:
        >>> in_words({"collision_any", "collision_at_fault", "offroad"}), in_words(())
        ('at-fault collision and off-road', 'no event')
    """
    return " and ".join(outcome.words for outcome in told(had)) or NO_OUTCOME


def first_failure(events: Iterable[DriveEvent]) -> DriveEvent | None:
    """Return the event of a rollout with which its drive failed first, among those that its outcome
    names; None where it did not fail.

    Example:
        >>> def event(metric, t_us):
        ...     return DriveEvent(metric, t_us, t_us * 1e-6, 0.0, 0.0)
        >>> first_failure([event("offroad", 9), event("collision_front", 5)]).metric
        'collision_front'
        >>> first_failure([event("collision_rear", 2), event("collision_at_fault", 5)]).metric
        'collision_at_fault'
    """
    began = outcome_events(events)
    failures = (began[outcome.name] for outcome in told(began))
    return min(failures, key=lambda event: event.t_us, default=None)


def outcome_events(events: Iterable[DriveEvent]) -> dict[str, DriveEvent]:
    """Return OUTCOME -> the event of a rollout with which it began, by time. A contact at any side
    is a collision; only an event of that name is an at-fault collision.
    """
    began: dict[str, DriveEvent] = {}
    for event in sorted(events, key=lambda event: event.t_us):
        name = outcome_of(event)
        if name in OUTCOMES:
            began.setdefault(name, event)
    return began


def outcome_of(event: DriveEvent) -> str:
    """Return the outcome that an event makes, or its metric where it makes none."""
    return "collision_any" if event.metric in CONTACT_SIDES else event.metric


def events_in_words(events: Iterable[DriveEvent]) -> list[str]:
    """Name the events of a manifest by time: its outcomes, as far as they are named, and other
    metrics with a label.

    Example:
        >>> names = "hard_brake", "collision_front", "collision_at_fault"
        >>> events_in_words(DriveEvent(name, 0, 0.0, 0.0, 0.0) for name in names)
        ['hard brake', 'at-fault collision']
    """
    in_order = sorted(events, key=lambda event: event.t_us)
    words = {outcome.name: outcome.words for outcome in told(outcome_events(in_order))}
    words |= {
        event.metric: METRICS.shown(event.metric).label
        for event in in_order
        if event.metric not in OUTCOMES
    }
    if "collision_any" in words:
        words |= dict.fromkeys(CONTACT_SIDES, words["collision_any"])
    return list(dict.fromkeys(word for event in in_order if (word := words.get(event.metric))))


def has_ended(rollout: Rollout) -> bool:
    """Tell whether the outcome of a rollout is known: it ran to its end, or the policy broke it."""
    return rollout.ok or rollout.failure_class == POLICY_FAULT


def reached_end(rollout: Rollout) -> bool:
    """Tell whether a drive without a failure came to the end of the recorded path."""
    return (
        rollout.ok
        and not outcomes_of(rollout)
        and (rollout.metrics.get("progress") or 0.0) >= REACHED
    )


REACHED_END, SHORT_OF_END, NOT_RUN = "reached the end", "end not reached", "not run"
ENDINGS = tuple(  # the best first, and last what says nothing of the policy
    dict.fromkeys(
        (
            REACHED_END,
            NO_OUTCOME,
            SHORT_OF_END,
            *(outcome.ending or outcome.words for outcome in reversed(OUTCOMES.values())),
            NOT_RUN,
        )
    )
)


def ending_of(rollout: Rollout) -> str:
    """Name the one way in which a rollout ended: its gravest outcome, else whether it came to the
    end of the recorded path as far as that is measured.
    """
    if not has_ended(rollout):
        return NOT_RUN
    failures = told(outcomes_of(rollout))
    if failures:
        return failures[0].ending or failures[0].words
    if rollout.metrics.get("progress") is None:
        return NO_OUTCOME
    return REACHED_END if reached_end(rollout) else SHORT_OF_END


# what the manifest of a rollout calls its end, in words
ENDED = {
    "time": "its time was up",
    "goal": "it came to its goal",
    "road": "the known road ends there",
    "record": "the recorded images and map end there",
}
DANGER_S = 2.0  # time to collision at the end of a rollout that its path ended
STAND_MPS = 0.3
STAND_S = 3.0
SLOW_SHARE = 0.5
LEAST_MPS = 2.0
SLOW_S = 1.0
AHEAD_M, AHEAD_S, BEHIND_M = (
    15.0,
    3.0,
    2.0,
)  # where a road user, or a slow place of the recording, is a cause
BESIDE_M = 1.0  # between the ego's way and a road user
SOON_S = (0.0, 1.0, 2.0)  # when a road user may be there
AFTER_S = 3.0  # what has been a cause excuses for so long


def evaluate_outcomes(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give ``stalled``, ``braked_without_cause``, ``left_route`` and ``ended_in_danger`` per step;
    nothing by AlpaSim's presets, whose metrics are AlpaSim's. Both of the first compare with the
    recording, and are no event of a step behind its end.
    """
    if preset.aliases:
        return []
    t_us = rollout.ego.t_us
    origin = origin_of(rollout.ego_log, preset)
    path = recorded_path(rollout, preset)
    ego = ego_footprints(rollout, preset, origin)
    line = path.xyz[:, :2] - origin[:2]
    on = on_route(line, path.t_us, t_us, ego.xy, way_beyond(rollout, scene, preset))
    s = followed(
        line,
        *to_path(line, ego.xy),
        ego.xy,
        float(np.interp(t_us[0], path.t_us, arc_lengths(line))),
    )
    has_side = np.isfinite(on.lateral_m)
    stalled, braked = _slow(rollout, scene, preset, path, s)
    # Behind the end of the recording nothing drove on with which a slow ego could be compared.
    stalled &= ~on.is_beyond
    braked &= ~on.is_beyond
    return [
        series("stalled", t_us, stalled, has_side, NO_DIRECTION),
        series("braked_without_cause", t_us, braked, has_side, NO_DIRECTION),
        series(
            "left_route", t_us, np.nan_to_num(on.lateral_m) >= LEFT_ROUTE_M, has_side, NO_DIRECTION
        ),
        series("ended_in_danger", t_us, _in_danger(rollout, scene, preset)),
    ]


def _in_danger(rollout: RolloutLog, scene: Scene, preset: Preset) -> Bool:
    """Return ``(T,)`` whether the ego would touch a road user within `DANGER_S`: at the last step of
    a rollout that its path ended, since nobody sees what comes then.
    """
    out = np.zeros(len(rollout.ego.t_us), dtype=np.bool_)
    rig = offset_trajectory(rollout.ego, inverse(rollout.T_rig_box))
    if ends_with_path(rig.xyz[1:, :2], scene):
        drive = ScoredRollout(rollout, scene, preset, rollout.ego)
        out[-1] = time_to_collision_s(drive.ego, drive.tracks)[-1] < DANGER_S
    return out


def _slow(
    rollout: RolloutLog, scene: Scene, preset: Preset, path: Trajectory, s: F64
) -> tuple[Bool, Bool]:
    """Return at which steps ``(T,)`` the ego has stood too long, and has braked without a cause."""
    t_us = rollout.ego.t_us
    origin = origin_of(rollout.ego_log, preset)
    line = path.xyz[:, :2] - origin[:2]
    seconds = (t_us - t_us[0]) * 1e-6
    v = speeds(rollout.ego)
    engaged = t_us >= handover_us(rollout)
    fastest = np.maximum.accumulate(np.where(engaged, v, 0.0))
    along = arc_lengths(line)
    then = (path.t_us - path.t_us[0]) * 1e-6
    usual, pause_s = recorded_speed(along, then, speeds(path), s)
    expected = np.minimum(fastest, usual)
    stands = engaged & (v < STAND_MPS)
    slow = engaged & (expected > LEAST_MPS) & (v < SLOW_SHARE * expected)
    ahead = np.zeros(len(t_us), dtype=np.bool_)
    steps_before_slow = np.flatnonzero(
        _recently((stands | slow)[::-1], -seconds[::-1])[::-1]
    )  # what comes before a slow step may excuse it
    reach_m = AHEAD_M + AHEAD_S * fastest
    ahead[steps_before_slow] = actor_ahead(rollout, preset, line, s, reach_m, steps_before_slow)
    ahead |= light_ahead(scene.lane_map, path, t_us, s, reach_m)
    excused = _recently(ahead, seconds) | (s >= along[-1] - AHEAD_M)
    stood_s = _lasting(stands & ~excused, seconds)
    slow_s = _lasting(slow & ~excused, seconds)
    return stood_s >= STAND_S + pause_s, slow_s >= SLOW_S


def recorded_speed(along: F64, seconds: F64, v: F64, s: F64) -> tuple[F64, F64]:
    """Return how the recording drove where the ego is.

    Args:
        along: ``(N,)`` arc length of the recording.
        seconds: ``(N,)`` its times.
        v: ``(N,)`` its speeds, m/s.
        s: ``(T,)`` arc length of the ego on the recorded path.

    Returns:
        ``(T,)`` its least speed from there to `AHEAD_M` ahead, m/s, and ``(T,)`` the seconds for
        which it stood there.
    """
    dwell = np.append(np.diff(seconds), 0.0)
    first = np.clip(np.searchsorted(along, s - BEHIND_M, "right") - 1, 0, None)
    last = np.maximum(np.searchsorted(along, s + AHEAD_M, "right"), first + 1)
    windows = [slice(begin, end) for begin, end in zip(first.tolist(), last.tolist(), strict=True)]
    return np.array([v[window].min() for window in windows]), np.array(
        [dwell[window][v[window] < LEAST_MPS].sum() for window in windows]
    )


def actor_ahead(
    rollout: RolloutLog, preset: Preset, line: F64, s: F64, reach_m: F64, steps: I64
) -> Bool:
    """Return at which of some steps ``(K,)`` a road user is on the recorded path ahead of the ego,
    or is about to be.

    Args:
        rollout: The log.
        preset: Sizes of the footprints.
        line: ``(N, 2)`` the recorded path.
        s: ``(T,)`` arc length of the ego on it.
        reach_m: ``(T,)`` how far ahead counts.
        steps: ``(K,)`` which steps are asked for.
    """
    origin = origin_of(rollout.ego_log, preset)
    actors = ActorTable(rollout, preset, origin)
    out = np.zeros(len(steps), dtype=np.bool_)
    if len(steps) == 0 or len(actors) == 0 or len(line) < 2:
        return out
    way = shapely.linestrings(line)
    shapely.prepare(way)
    ego_xy = rollout.ego.xyz[steps, :2] - origin[:2]
    s = s[steps]
    reach_m = reach_m[steps]
    for soon_s in SOON_S:
        actors_at = actors.at(rollout.ego.t_us[steps] + round(soon_s * 1e6))
        actor, step = np.nonzero(
            actors_at.present
            & (actors_at.centre_distance_m(ego_xy) < reach_m + actors.radius_m[:, None])
        )
        boxes = actors_at.footprints(actor, step)
        beside = shapely.dwithin(way, boxes.shapes(), rollout.ego_box.width_m / 2 + BESIDE_M)
        step = step[beside]
        boxes = boxes.take(np.flatnonzero(beside))
        corners = to_path(line, boxes.corners().reshape(-1, 2))[1].reshape(-1, 4)
        gap_m = corners.max(axis=1) - s[step]
        near = (gap_m > 0.0) & (gap_m < reach_m[step] + boxes.size[:, 0])
        out[step[near]] = True
    return out


def light_ahead(lane_map: LaneMap, path: Trajectory, t_us: I64, s: F64, reach_m: F64) -> Bool:
    """Return at which steps ``(T,)`` a traffic light that is not green holds who is on the recorded
    path.

    Args:
        lane_map: The map, with its lights.
        path: The recorded path.
        t_us: ``(T,)`` times.
        s: ``(T,)`` arc length of the ego on the path.
        reach_m: ``(T,)`` how far ahead counts.
    """
    out = np.zeros(len(t_us), dtype=np.bool_)
    for light in passings(path.xyz, lane_map.signals or (), lane_map.lanes, np.zeros(3)):
        near = np.flatnonzero((light.s_m > s) & (light.s_m < s + reach_m))
        colours = np.array([light.signal.colour_at(now) for now in t_us[near].tolist()])
        out[near[colours != "green"]] = True
    return out


def _lasting(condition: Bool, seconds: F64) -> F64:
    """Return for how many seconds ``(T,)`` a condition has held without a break; -1 where it does
    not.
    """
    began = np.maximum.accumulate(
        np.where(condition & ~np.append(False, condition[:-1]), seconds, -np.inf)
    )
    return np.where(condition, seconds - np.where(condition, began, 0.0), -1.0)


def _recently(condition: Bool, seconds: F64) -> Bool:
    """Return where a condition holds or has held within `AFTER_S`."""
    last = np.maximum.accumulate(np.where(condition, seconds, -np.inf))
    return seconds - last <= AFTER_S


FACTORY = with_preset(evaluate_outcomes)
