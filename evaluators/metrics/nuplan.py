"""nuPlan's closed-loop score and the metrics below it, from their published definitions.

Source: Caesar et al., "NuPlan: A closed-loop ML-based planning benchmark for autonomous vehicles",
    and the description of metrics of the
nuplan-devkit. All angles are radians, all lengths metres; what the devkit calls a track is here a
road user.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely

from alpasim_plugin.core.types import F64, I64, Bool
from evaluators.metrics.states import EgoStates, Kind, Tracks, derivative, smooth

STOPPED_MPS = 5e-2  # for a contact; for the time to collision the ego stands below STANDS_MPS
STANDS_MPS = 5e-3
AHEAD_RAD = np.deg2rad(30.0)
BEHIND_RAD = np.deg2rad(150.0)
TTC_STEP_S = 0.1
TTC_HORIZON_S = 3.0
LEAST_TTC_S = 0.95
OBJECTS_ALLOWED = 1
LEAST_INSTANTS = 3  # a polynomial of order 3 needs more
MASS_SHARE = 0.5  # of the other's mass in the sum of both: 2000 kg each
COMFORT = {  # least and greatest: m/s2, m/s3, rad/s, rad/s2
    "lon_accel": (-4.05, 2.40),
    "lat_accel": (-4.89, 4.89),
    "lon_jerk": (-4.13, 4.13),
    "jerk": (-8.37, 8.37),
    "yaw_rate": (-0.95, 0.95),
    "yaw_accel": (-1.93, 1.93),
}
PROGRESS_M = 2.0
PROGRESS_SHARE = 0.2
OFF_AREA_M = 0.3
OVERSPEED_MPS = 2.23
AGAINST_S = 1.0
AGAINST_M = 2.0
FAR_AGAINST_M = 6.0
WEIGHTS = {"progress": 5.0, "time_to_collision": 5.0, "speed_limit": 4.0, "comfort": 2.0}
MULTIPLIERS = ("no_at_fault_collision", "drivable_area", "making_progress", "driving_direction")

Place = Literal["centre", "rear_axle"]
Type = Literal["stopped_ego", "stopped_track", "active_rear", "active_front", "active_lateral"]


@dataclass(frozen=True)
class Collision:
    """The first contact with one road user.

    Attributes:
        actor: Row in the tracks.
        step: Row in the states.
        delta_v_mps: What the ego loses of its velocity if both weigh the same and stay together.
    """

    actor: int
    step: int
    type: Type
    kind: Kind
    delta_v_mps: float
    at_fault: bool


def bearing(ego: EgoStates, step: I64, points: F64) -> F64:
    """Return the angle ``(M,)`` between the ego's heading and the way from its rear axle to points
    ``(M, 2)`` at steps ``(M,)``.
    """
    to = points - ego.rear_xy[step]
    along = np.sum(to * ego.heading[step], axis=1) / np.maximum(np.hypot(to[:, 0], to[:, 1]), 1e-12)
    return np.arccos(np.clip(along, -1.0, 1.0))


def collisions(ego: EgoStates, tracks: Tracks, astray: Bool | None = None) -> list[Collision]:
    """Return the first contact with each road user, in order of time.

    Args:
        ego, tracks: The drive.
        astray: ``(T,)`` where the ego is in several lanes or off the road: a contact at its side is
            then its fault. None: nowhere.
    """
    boxes = ego.boxes(ego.centre, ego.yaw)
    radius = boxes.radius_m
    apart = np.hypot(*np.moveaxis(tracks.xy - ego.centre, -1, 0))
    actor, step = np.nonzero(
        tracks.is_present & (apart <= radius + np.hypot(*tracks.size.T)[:, None] / 2)
    )
    touches = shapely.intersects(boxes.take(step).shapes(), tracks.boxes(actor, step).shapes())
    actor = actor[touches]
    step = step[touches]
    out = []
    for a in np.unique(actor).tolist():
        k = int(step[actor == a].min())
        kind: Type = _type(ego, tracks, a, k)
        gone = ego.velocity[k, 0] * ego.heading[k] - tracks.velocity[a, k]
        guilty = kind in ("active_front", "stopped_track") or (
            kind == "active_lateral" and astray is not None and bool(astray[k])
        )
        out.append(
            Collision(a, k, kind, tracks.kinds[a], MASS_SHARE * float(np.hypot(*gone)), guilty)
        )
    return sorted(out, key=lambda collision: collision.step)


def _type(ego: EgoStates, tracks: Tracks, a: int, k: int) -> Type:
    if ego.speed[k] <= STOPPED_MPS:
        return "stopped_ego"
    if tracks.kinds[a] == "object" or tracks.speed[a, k] <= STOPPED_MPS:
        return "stopped_track"
    index = np.array([k])
    if bearing(ego, index, tracks.xy[a, index])[0] > BEHIND_RAD:
        return "active_rear"
    front = ego.boxes(ego.centre[index], ego.yaw[index]).bumpers()[0]
    touches = shapely.intersects(front, tracks.boxes(np.array([a]), index).shapes())[0]
    return "active_front" if touches else "active_lateral"


def collision_score(collisions: list[Collision]) -> float:
    """Return 1, less for contacts at fault: none is allowed with a vehicle or a person, one with an
    object costs a half.
    """
    guilty = [collision.kind for collision in collisions if collision.at_fault]
    if any(kind != "object" for kind in guilty):
        return 0.0
    return max(0.0, 1.0 - len(guilty) / (OBJECTS_ALLOWED + 1))


def time_to_collision(
    ego: EgoStates,
    tracks: Tracks,
    collisions: list[Collision],
    beside: Bool | None = None,
    step_s: float = TTC_STEP_S,
    horizon_s: float = TTC_HORIZON_S,
) -> F64:
    """Return ``(T,)`` seconds until the ego touches a road user if all go on at their velocity;
    infinite where none is within the horizon.

    Args:
        ego, tracks: The drive.
        collisions: Its collisions: one at fault makes the time 0, and a road user that was touched
            counts no more.
        beside: ``(T,)`` where road users at the ego's side count as those ahead do: in several
            lanes, off the road, at a junction.
        step_s, horizon_s: Times that are looked at: multiples of the step before the horizon.
    """
    out = np.full(len(ego.t_us), np.inf)
    counts = tracks.is_present & (ego.speed > STANDS_MPS)
    for collision in collisions:
        counts[collision.actor, collision.step :] = False
    actor, step = np.nonzero(counts)
    angle = bearing(ego, step, tracks.xy[actor, step])
    near = angle < AHEAD_RAD
    if beside is not None:
        near |= beside[step] & (angle <= BEHIND_RAD)
    actor = actor[near]
    step = step[near]
    first_s, last_s = touching_s(ego, tracks, actor, step)
    after_s = step_s * np.maximum(np.ceil(first_s / step_s - 1e-9), 1.0)
    hit = (after_s <= last_s) & (after_s < horizon_s - 1e-9)
    np.minimum.at(out, step[hit], after_s[hit])
    for collision in collisions:
        if collision.at_fault and ego.speed[collision.step] > STANDS_MPS:
            out[collision.step] = 0.0
    return out


@np.errstate(
    divide="ignore", invalid="ignore"
)  # boxes that do not move along an axis overlap on it always or never
def touching_s(ego: EgoStates, tracks: Tracks, actor: I64, step: I64) -> tuple[F64, F64]:
    """Return from when to when ``(M,)`` boxes of pairs touch if both go straight on; the first is
    later than the last where they never do.

    The ego moves at its speed along its heading. Two boxes touch while they overlap on each of
    their four axes.
    """
    apart = tracks.xy[actor, step] - ego.centre[step]
    yaws = (ego.yaw[step], tracks.yaw[actor, step])
    gone = tracks.velocity[actor, step] - ego.speed[step][:, None] * ego.heading[step]
    sizes = np.broadcast_to(np.array(ego.size), (len(step), 2)), tracks.size[actor]
    first_s = np.full(len(step), -np.inf)
    last_s = np.full(len(step), np.inf)
    for yaw in (yaws[0], yaws[0] + np.pi / 2, yaws[1], yaws[1] + np.pi / 2):
        axis = np.cos(yaw), np.sin(yaw)
        reach = sum(
            np.abs(size[:, 0] * np.cos(yaw - body_yaw) / 2)
            + np.abs(size[:, 1] * np.sin(yaw - body_yaw) / 2)
            for body_yaw, size in zip(yaws, sizes, strict=True)
        )
        distance, rate = (
            axis[0] * vector[:, 0] + axis[1] * vector[:, 1] for vector in (apart, gone)
        )
        ends = np.sort([(-reach - distance) / rate, (reach - distance) / rate], axis=0)
        still = rate == 0.0
        ends[:, still] = np.where(
            np.abs(distance) <= reach, [[-np.inf], [np.inf]], [[np.inf], [-np.inf]]
        )[:, still]
        first_s = np.maximum(first_s, ends[0])
        last_s = np.minimum(last_s, ends[1])
    return first_s, last_s


def motion(ego: EgoStates, place: Place = "centre") -> dict[str, F64]:
    """Return the series ``(T,)`` that comfort is judged by, under the names of `COMFORT`, and
    ``accel``, the acceleration's magnitude.

    Args:
        ego: The drive.
        place: Where accelerations along and across the vehicle are taken: nuPlan takes those of the
            box's centre (its `extract_ego_acceleration`), NAVSIM those of the rear axle. The
            magnitude, and the jerk made of it, are the rear axle's in both.

    Raises:
        EvaluatorError: Three instants or fewer.
    """
    along_and_across = ego.centre_accel if place == "centre" else ego.accel
    accel = {
        "lon_accel": along_and_across[:, 0],
        "lat_accel": along_and_across[:, 1],
        "accel": np.hypot(ego.accel[:, 0], ego.accel[:, 1]),
    }
    out = {name: smooth(values) for name, values in accel.items()}
    out |= {
        derived: derivative(out[source], ego.t_us, window=15)
        for derived, source in (
            ("lon_jerk", "lon_accel"),
            ("lat_jerk", "lat_accel"),
            ("jerk", "accel"),
        )
    }
    yaw = np.unwrap(ego.yaw)
    return out | {
        "yaw_rate": derivative(yaw, ego.t_us),
        "yaw_accel": derivative(yaw, ego.t_us, order=3, times=2),
    }


def uncomfortable(series: dict[str, F64]) -> Bool:
    """Return where ``(T,)`` one of the bounds of comfort is broken, from what `motion` gives."""
    return np.any(
        [(series[name] <= low) | (series[name] >= high) for name, (low, high) in COMFORT.items()],
        axis=0,
    )


def progress_ratio(ego_m: float, expert_m: float) -> float:
    """Return the share of the expert's progress that was made, at most 1; 0 of a drive that goes
    back by more than `PROGRESS_M`.
    """
    return (
        0.0 if ego_m < -PROGRESS_M else min(1.0, max(ego_m, PROGRESS_M) / max(expert_m, PROGRESS_M))
    )


def speed_limit_score(over_mps: F64, t_us: I64) -> float:
    """Return 1, less the mean of the overspeed ``(T,)`` over time as a share of `OVERSPEED_MPS`, at
    least 0.
    """
    took_s = max(float(t_us[-1] - t_us[0]) * 1e-6, 1e-9)
    return max(
        0.0,
        1.0
        - float(np.trapezoid(np.maximum(over_mps, 0.0), t_us * 1e-6)) / (OVERSPEED_MPS * took_s),
    )


def direction_score(against_m: float) -> float:
    """Return 1, a half or 0 by how far the ego has driven against the traffic within
    `AGAINST_S`.
    """
    return 1.0 if against_m < AGAINST_M else 0.5 if against_m < FAR_AGAINST_M else 0.0


def closed_loop_score(parts: Mapping[str, float]) -> float:
    """Return the product of the multipliers and the weighted mean of the others.

    >>> closed_loop_score({**dict.fromkeys(MULTIPLIERS, 1.0), **dict.fromkeys(WEIGHTS, 1.0), "comfort": 0.0})
    0.875
    """
    mean = sum(weight * parts[name] for name, weight in WEIGHTS.items()) / sum(WEIGHTS.values())
    return float(np.prod([parts[name] for name in MULTIPLIERS])) * mean
