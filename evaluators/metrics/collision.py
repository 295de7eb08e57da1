"""Contact with other actors: flags by side, the least gap, and where contact is searched between
steps, time and place.

At fault is front or lateral, or what nuPlan calls so. By the paper's protocol only logged instants are looked at
(`evaluators.metrics.contact`); preset ``strict`` searches the motion between them as well
(`evaluators.metrics.contact`), and a row then says what happened since the row before.
"""

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.types import F64, I64, STANDING_ID, Bool, MetricSeries, RolloutLog, Scene
from alpasim_plugin.log.run_folder.records import Contact
from evaluators.metrics import nuplan
from evaluators.metrics.contact import (
    FRONT,
    LATERAL,
    REAR,
    Contacts,
    SweptContacts,
    begin_at_steps,
    find_contacts,
    find_swept,
    last_per_step,
)
from evaluators.metrics.footprint import ActorTable, ego_footprints, origin_of
from evaluators.metrics.presets import Preset
from evaluators.metrics.presets import preset as find_preset
from evaluators.metrics.score import handover_us, series, with_preset
from evaluators.metrics.scored import ScoredRollout
from evaluators.metrics.states import velocity_at

SIDES = {FRONT: "front", REAR: "rear", LATERAL: "lateral"}
NO_CONTACT = "nothing touches the ego"
NO_IMPACT = "no contact begins at this step while the policy drives"
NO_SPEED = "a road user that touches the ego has one pose: its velocity is not known"


@dataclass(frozen=True)
class ContactEvent:
    """One actor begins to touch the ego."""

    actor_id: str
    t_s: float  # since the log's first ego pose
    side: str  # front | rear | lateral
    x_m: float  # where on the footprint: rig frame, forward of the rear axle
    y_m: float  # rig frame, left

    def rounded(self) -> Contact:
        """Return the contact for a manifest; micrometres and tenths of microseconds are rounded
        away.
        """
        return Contact(
            actor_id=self.actor_id,
            t_s=round(self.t_s, 6),
            side=self.side,
            x_m=round(self.x_m, 5),
            y_m=round(self.y_m, 5),
        )


def contact_events(
    rollout: RolloutLog, preset: str | Preset = "strict"
) -> tuple[ContactEvent, ...]:
    """Return the beginning of every contact at or between steps, in order of time.

    Args:
        rollout: A log that `evaluators.metrics.score.check_rollout` accepts.
        preset: Sizes of the footprints.

    Returns:
        One entry each time an actor begins to touch the ego, however short; the warm-up included.
    """
    chosen = find_preset(preset)
    origin = origin_of(rollout.ego, chosen)
    ego = ego_footprints(rollout, chosen, origin)
    actors = ActorTable(rollout, chosen, origin)
    at_steps, _ = find_contacts(ego, actors, rollout.ego.t_us)
    begun = find_swept(ego, actors, rollout.ego.t_us, at_steps, handover_us(rollout)).onsets
    places = in_rig(begun.xy, rollout)
    return tuple(
        ContactEvent(
            actors.ids[begun.actor[k]],
            float(begun.t_s[k]),
            SIDES[int(begun.side[k])],
            float(places[k, 0]),
            float(places[k, 1]),
        )
        for k in np.argsort(begun.t_s, kind="stable")
    )


def evaluate_collision(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give the ``collision_*`` flags and ``min_distance_to_obstacle_m`` per step, and ``contact_*``
    where motion is searched too.

    In a recorded drive whose standing obstacles were found in its reconstruction, contact with them
    is also reported apart.
    """
    origin = origin_of(rollout.ego, preset)
    t_us = rollout.ego.t_us
    ego = ego_footprints(rollout, preset, origin)
    actors = ActorTable(rollout, preset, origin)
    contacts, gap_m = find_contacts(ego, actors, t_us)
    is_last_only = preset.hits == "last"
    if is_last_only:
        contacts = last_per_step(contacts, ego, actors, t_us)
    first = []
    begun_row, begun_actor = begin_at_steps(contacts, len(actors), len(t_us))
    if preset.contact == "between_steps":
        swept = find_swept(ego, actors, t_us, contacts, handover_us(rollout))
        contacts = Contacts(swept.step, swept.actor, swept.side)
        first = _first_contacts(rollout, swept)
        begun_row, begun_actor = swept.begun
        gap_m[swept.step] = 0.0
    touched = np.zeros((3, len(t_us)), dtype=np.bool_)
    touched[contacts.side, contacts.step] = True
    drive = None
    if len(contacts.step) and not preset.aliases:
        drive = ScoredRollout(rollout, scene, preset, rollout.ego)
    flags = {"collision_any": touched.any(axis=0)}
    if not is_last_only:
        flags["collision_at_fault"] = touched[FRONT] | touched[LATERAL]
        if preset.fault == "nuplan":
            flags["collision_at_fault"] = _by_fault_of_ego(drive, contacts, len(t_us))
    flags["collision_front"] = touched[FRONT]
    flags["collision_lateral"] = touched[LATERAL]
    flags["collision_rear"] = touched[REAR]
    if scene.standing == "found":
        flags["collision_standing"] = _with_standing(actors, contacts, len(t_us))
    nearest = series(
        "min_distance_to_obstacle_m",
        t_us,
        gap_m,
        np.isfinite(gap_m),
        "no other actor is present",
        keep_values=not preset.honour_valid,
    )
    impacts = [] if preset.aliases else [_impacts(rollout, drive, begun_actor, begun_row)]
    return [
        *(series(name, t_us, fired) for name, fired in flags.items()),
        nearest,
        *first,
        *impacts,
    ]


def _impacts(
    rollout: RolloutLog, drive: ScoredRollout | None, actor: I64, step: I64
) -> MetricSeries:
    """Give the greatest relative speed at each step at which a contact begins while the policy
    drives.

    Args:
        rollout: The log.
        drive: Its states; None where nothing touches the ego.
        actor, step: ``(B,)`` which road users begin to touch the ego, and the first step of each
            contact.
    """
    t_us = rollout.ego.t_us
    speed_mps = np.full(len(t_us), np.nan)
    reason = NO_CONTACT if drive is None else NO_IMPACT
    begun = t_us[step] >= handover_us(rollout)
    if drive is not None and begun.any():
        impact_mps = relative_mps(drive, rollout, actor[begun], step[begun])
        np.fmax.at(speed_mps, step[begun], impact_mps)
        reason = NO_IMPACT if np.isfinite(speed_mps).any() else NO_SPEED
    return series("impact_speed_mps", t_us, speed_mps, np.isfinite(speed_mps), reason)


def relative_mps(drive: ScoredRollout, rollout: RolloutLog, actor: I64, step: I64) -> F64:
    """Return the size ``(B,)`` of the difference of both velocities at steps, m/s; of a road user
    that is not there at the step its last one before, or that of its track; NaN where it has one
    pose alone.
    """
    ego = drive.ego
    tracks = drive.tracks
    out = np.full(len(step), np.nan)
    for k, (a, row) in enumerate(zip(actor.tolist(), step.tolist(), strict=True)):
        rows = np.flatnonzero(tracks.is_present[a, : row + 1])
        track = rollout.actors[tracks.ids[a]].track
        if len(rows) and int(tracks.is_present[a].sum()) > 1:
            velocity = tracks.velocity[a, rows[-1]]
        elif len(track) > 1:
            velocity = velocity_at(track, int(ego.t_us[row]))
        else:
            continue
        out[k] = np.hypot(*(ego.velocity[row, 0] * ego.heading[row] - velocity))
    return out


def _by_fault_of_ego(drive: ScoredRollout | None, contacts: Contacts, count: int) -> Bool:
    """Return at which of ``count`` steps the ego is at fault for a contact by nuPlan's rules: it moves,
    and it touches what stands, or somebody with its front, or at its side while no lane holds it.
    """
    fired = np.zeros(count, dtype=np.bool_)
    if drive is None:
        return fired
    tracks = drive.tracks
    step = contacts.step
    actor = contacts.actor
    stands = tracks.is_present[actor, step] & (tracks.speed[actor, step] <= nuplan.STOPPED_MPS)
    is_astray = False if drive.astray is None else drive.astray[step]
    between_lanes = (contacts.side == LATERAL) & is_astray
    moves = drive.ego.speed[step] > nuplan.STOPPED_MPS
    fired[step[moves & (stands | (contacts.side == FRONT) | between_lanes)]] = True
    return fired


def _with_standing(actors: ActorTable, contacts: Contacts, count: int) -> Bool:
    """Return at which of ``count`` steps something touches the ego that was found standing in a
    reconstruction.
    """
    stands = np.array([name.startswith(STANDING_ID) for name in actors.ids], dtype=np.bool_)
    touched = np.zeros(count, dtype=np.bool_)
    touched[contacts.step[stands[contacts.actor]]] = True
    return touched


def _first_contacts(rollout: RolloutLog, swept: SweptContacts) -> list[MetricSeries]:
    """Give time and place of the earliest begun among the contacts of each row."""
    t_us = rollout.ego.t_us
    began = swept.onsets
    order = np.lexsort((began.t_s[swept.begin], swept.step))
    step, first = np.unique(swept.step[order], return_index=True)
    begin = swept.begin[order][first]
    touched = np.zeros(len(t_us), dtype=np.bool_)
    touched[step] = True
    x_m, y_m = in_rig(began.xy[begin], rollout).T
    out = []
    for name, values in (
        ("contact_time_s", began.t_s[begin]),
        ("contact_x_m", x_m),
        ("contact_y_m", y_m),
    ):
        full = np.full(len(t_us), np.nan)
        full[step] = values
        out.append(series(name, t_us, full, touched, NO_CONTACT))
    return out


def in_rig(xy: F64, rollout: RolloutLog) -> F64:
    """Return points ``(N, 2)`` of the ego's box frame in its rig frame."""
    return xy @ rollout.T_rig_box[:2, :2].T + rollout.T_rig_box[:2, 3]


FACTORY = with_preset(evaluate_collision)
