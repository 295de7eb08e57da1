"""The Intelligent Driver Model and the choice of the leader that a driver follows.

Source: M. Treiber, A. Hennecke, D. Helbing, "Congested traffic states in empirical observations and
    microscopic simulations",
Physical Review E 62 (2000), equations 2 and 3.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.types import F64, I64, Bool, Box
from alpasim_plugin.world.path import Lines, Path

COMFORT_BRAKE_MPS2 = 1.5  # before bends
CREEP_MPS = 2.0  # even around a corner of the line


@dataclass(frozen=True)
class IdmParams:
    """Parameters of one driver."""

    desired_speed_mps: float = 13.9
    headway_s: float = 1.5
    min_gap_m: float = 2.0
    accel_mps2: float = 1.5
    brake_mps2: float = 2.0  # comfortable
    hard_brake_mps2: float = 7.0  # what the vehicle can do; the model's own demand is cut off here
    lateral_accel_mps2: float = math.inf  # in bends, before which the driver slows down
    change_gain_mps2: float = math.inf  # of a change of lanes that is worth it; infinite: stays
    politeness: float = 0.2  # share of the followers' gain in that
    safe_brake_mps2: float = 4.0  # that a change may ask of the new follower


def wanted_gap_m(speed_mps: float, closing_mps: float, p: IdmParams) -> float:
    """Return the gap that the driver wants at a speed and a closing speed (equation 3)."""
    dynamic = speed_mps * p.headway_s + speed_mps * closing_mps / (
        2.0 * math.sqrt(p.accel_mps2 * p.brake_mps2)
    )
    return p.min_gap_m + max(0.0, dynamic)


def idm_acceleration(speed_mps: float, gap_m: float, closing_mps: float, p: IdmParams) -> float:
    """Return the acceleration behind a leader (``gap_m`` infinite: free road), within
    ``[-hard_brake, accel]``.

    Args:
        speed_mps: Own speed, >= 0.
        gap_m: Bumper-to-bumper distance.
        closing_mps: Own speed minus the leader's.
        p: Driver.

    Example:
        >>> round(idm_acceleration(13.9, float("inf"), 0.0, IdmParams()), 6)
        0.0
    """
    free = 1.0 - (speed_mps / max(p.desired_speed_mps, 0.1)) ** 4
    interaction = (
        0.0
        if math.isinf(gap_m)
        else (wanted_gap_m(speed_mps, closing_mps, p) / max(gap_m, 0.01)) ** 2
    )
    return min(max(p.accel_mps2 * (free - interaction), -p.hard_brake_mps2), p.accel_mps2)


def moved_on(s_m: float, speed_mps: float, accel_mps2: float, dt_s: float) -> tuple[float, float]:
    """Return place (m) and speed (m/s) after a step at a held acceleration; a car that brakes
    stops, it does not reverse.
    """
    a = max(accel_mps2, -speed_mps / dt_s)
    return s_m + (speed_mps * dt_s + 0.5 * a * dt_s * dt_s), max(0.0, speed_mps + a * dt_s)


def allowed_speeds(path: Path, most_mps: float | F64, lateral_accel_mps2: float) -> F64:
    """Return the speed ``(N,)`` that bends and limits allow along a path, reachable with a
    comfortable brake from everywhere before them.
    """
    k = np.abs(path.curvature)
    v2 = np.minimum(np.square(most_mps), lateral_accel_mps2 / np.maximum(k, 1e-6))
    # v^2(s) <= v^2(s') + 2 b (s' - s) for all s' > s: a running minimum from the far end.
    rising = v2 + 2 * COMFORT_BRAKE_MPS2 * path.s
    return np.sqrt(np.minimum.accumulate(rising[::-1])[::-1] - 2 * COMFORT_BRAKE_MPS2 * path.s)


def bend_speeds(path: Path, p: IdmParams) -> F64 | None:
    """Return the speeds ``(N,)`` that a driver wants along a path; None for one who ignores
    bends.
    """
    if math.isinf(p.lateral_accel_mps2):
        return None
    allowed_mps = allowed_speeds(path, p.desired_speed_mps, p.lateral_accel_mps2)
    return np.maximum(allowed_mps, CREEP_MPS)


def at_place(p: IdmParams, path: Path, wanted_mps: F64 | None, s_m: float) -> IdmParams:
    """Return the driver with the speed that it wants at a place of its path."""
    if wanted_mps is None:
        return p
    return replace(p, desired_speed_mps=float(np.interp(s_m, path.s, wanted_mps)))


@dataclass(frozen=True)
class Bodies:
    """Road users at one instant, as rectangles."""

    xy: F64  # (M, 2) centre, metres, world
    yaw: F64  # (M,) radians
    half_length_m: F64  # (M,)
    half_width_m: F64  # (M,)
    velocity: F64  # (M, 2) metres per second, world
    z: F64  # (M,) height of the centre, metres, world; NaN: not known, on every level
    half_height_m: F64  # (M,)


@dataclass(frozen=True)
class Leader:
    """The road user ahead that limits the speed."""

    gap_m: float  # from the own front bumper; may be negative in contact
    speed_mps: float  # along the own path
    index: int  # row in `Bodies`, -1: none


NO_LEADER = Leader(float("inf"), 0.0, -1)

LEVEL_M = 1.25  # a line and the nearest face of a body on its level are no farther apart in height
BESIDE_M = 2.0  # a body whose rear is so far behind the own front bumper is beside
MERGE_S = 2.0  # who comes into the corridor from beside within this time is let in
MERGE_MPS = 0.3  # sideways, at least
SAME_WAY = 0.5  # cosine between a body and the line that it drives along
ON_FOOT_M = 0.6  # half the length of a body below which it is somebody on foot
WALK_S = 3.0  # somebody who steps into the corridor within this time is waited for ...
CLEAR_S = 1.0  # ... unless the driver has passed so long before
STANDS_MPS = 0.1
TORN_M = 1.0  # an outline is no wider across a line than its diagonal, and this for curvature
BEHIND_M = 15.0  # a body is looked for so far behind the own front bumper
_OUTLINE = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [0.0, 1.0], [0.0, -1.0]])


@dataclass(frozen=True)
class Spans:
    """Extent of bodies along and across lines, metres."""

    rear: F64  # (P,) smallest arc length of the outline
    front: F64  # (P,) largest
    low: F64  # (P,) rightmost distance from the line; infinite far from it
    high: F64  # (P,) leftmost; infinite far from it
    speed: F64  # (P,) along the line, >= 0
    on_level: Bool  # (P,) whether the body is at the height of the line, not on a bridge or below


def spans(lines: Lines, line: I64, bodies: Bodies, row: I64, low: I64, high: I64) -> Spans:
    """Return where bodies lie on lines: each row ``(P,)`` of ``bodies`` on its ``line (P,)``,
    between two of its stations ``(P,)``.
    """
    half = np.column_stack([bodies.half_length_m[row], bodies.half_width_m[row]])
    turn = np.array([np.cos(bodies.yaw[row]), np.sin(bodies.yaw[row])])
    corners = _OUTLINE * half[:, None]  # (P, 6, 2)
    x = corners[..., 0]
    y = corners[..., 1]
    outline = bodies.xy[row][:, None] + np.stack(
        [turn[0, :, None] * x - turn[1, :, None] * y, turn[1, :, None] * x + turn[0, :, None] * y],
        axis=-1,
    )
    per_corner = [np.repeat(number, len(_OUTLINE)) for number in (line, low, high)]
    along, across = lines.project(per_corner[0], outline.reshape(-1, 2), *per_corner[1:])
    along = along.reshape(-1, len(_OUTLINE))
    across = across.reshape(-1, len(_OUTLINE))
    rear = along.min(axis=1)
    lowest = across.min(axis=1)
    highest = across.max(axis=1)
    # Two corners on both sides of a far place from which a bend is equally near in two directions.
    is_torn = highest - lowest > 2.0 * np.hypot(*half.T) + TORN_M
    lowest[is_torn] = highest[is_torn] = np.inf
    xyz, yaw = lines.at(line, rear)
    is_apart = np.abs(bodies.z[row] - xyz[:, 2]) > bodies.half_height_m[row] + LEVEL_M
    speed = bodies.velocity[row, 0] * np.cos(yaw) + bodies.velocity[row, 1] * np.sin(yaw)
    return Spans(
        rear,
        along.max(axis=1),
        lowest,
        highest,
        np.maximum(speed, 0.0),
        ~is_apart,
    )


def find_leader(
    line: Lines,
    front_s_m: float,
    half_width_m: float,
    bodies: Bodies,
    horizon_m: float = 120.0,
    margin_m: float = 0.2,
) -> Leader:
    """Return the leader of one driver on the only line of ``line``; see `find_leaders`."""
    driver = (np.array([front_s_m]), np.array([half_width_m]))
    nobody = np.array([-1])
    zero = np.zeros(1, dtype=np.int64)
    return find_leaders(line, zero, *driver, bodies, np.array([horizon_m]), nobody, margin_m)[0]


def find_leaders(
    lines: Lines,
    line: I64,
    front_s_m: F64,
    half_width_m: F64,
    bodies: Bodies,
    horizon_m: F64,
    own_row: I64,
    margin_m: float = 0.2,
    lets_merge: bool = False,
) -> list[Leader]:
    """Return the leader of each of many drivers: the nearest body that reaches into the corridor of
    its line ahead of its front bumper.

    A body counts when it is on the line's level, its outline overlaps ``+-(half_width_m + margin_m)`` across the line and its
    rear end is not more than `BESIDE_M` behind the own front bumper, so that touching bodies still count.
    With ``lets_merge`` a longer body beside counts too that drives the same way, has its nose ahead, and
    reaches into the corridor or will within `MERGE_S`; until it does, the gap is that to its nose.
    So does somebody on foot ahead who will step into the corridor; see `_steps_in`.

    Args:
        lines: All lines.
        line: ``(N,)`` the one of each driver.
        front_s_m: ``(N,)`` arc lengths of the front bumpers.
        half_width_m: ``(N,)`` of the drivers' bodies.
        bodies: Everybody.
        horizon_m: ``(N,)`` how far each driver looks.
        own_row: ``(N,)`` rows of the drivers in ``bodies``, -1 where they are not among them.
        margin_m: Added to the half width.
        lets_merge: Whether drivers let in who merges from beside, and wait for who steps in.
    """
    if len(bodies.xy) == 0:  # an empty road: half of the calls of a built scene
        return [NO_LEADER] * len(line)
    driver, body = _near(lines, line, front_s_m, bodies, horizon_m, own_row)
    low, high = lines.stations(line, front_s_m - BEHIND_M, front_s_m + horizon_m)
    reach_m = (half_width_m + margin_m)[driver]
    pair_line = line[driver]
    span = spans(lines, pair_line, bodies, body, low[driver], high[driver])
    gap_m = span.rear - front_s_m[driver]
    inside = (span.low < reach_m) & (span.high > -reach_m)
    in_sight = span.on_level & (gap_m < horizon_m[driver])
    ahead = inside & in_sight & (gap_m > -BESIDE_M)
    if lets_merge:
        nose_m = span.front - front_s_m[driver]
        beside = np.flatnonzero(span.on_level & (gap_m <= -BESIDE_M) & (nose_m > 0.0))
        yaw_and_velocity = (bodies.yaw[body[beside]], bodies.velocity[body[beside]])
        near_m = _least_offsets(lines, pair_line[beside], span, beside, *yaw_and_velocity)
        merging = beside[near_m < reach_m[beside]]
        ahead[merging] = True
        gap_m[merging] = np.where(inside[merging], gap_m[merging], nose_m[merging])
        on_foot = bodies.half_length_m[body] < ON_FOOT_M
        walkers = np.flatnonzero(on_foot & in_sight & ~inside & (gap_m > 0.0))
        if len(walkers):
            own_mps = np.where(own_row < 0, 0.0, np.hypot(*bodies.velocity[own_row].T))
            arrives_s = gap_m[walkers] / np.maximum(own_mps[driver[walkers]], STANDS_MPS)
            velocity = bodies.velocity[body[walkers]]
            steps_s = _steps_in(lines, pair_line, span, walkers, reach_m, velocity)
            ahead[walkers] = (steps_s < WALK_S) & (steps_s < arrives_s + CLEAR_S)
    return _nearest(len(line), driver, body, gap_m, span.speed, ahead)


def _near(
    lines: Lines, line: I64, front_s_m: F64, bodies: Bodies, horizon_m: F64, own_row: I64
) -> tuple[I64, I64]:
    """Return the pairs ``(P,)`` of a driver and another body that is near enough to be looked at; see
    `find_leaders`.
    """
    start, _ = lines.at(line, front_s_m)
    delta = bodies.xy - start[:, None, :2]
    reaches = horizon_m[:, None] + bodies.half_length_m + 5.0
    near = np.hypot(delta[..., 0], delta[..., 1]) < reaches
    near[np.flatnonzero(own_row >= 0), own_row[own_row >= 0]] = False
    driver, body = np.nonzero(near)
    return driver, body


def _nearest(
    n_drivers: int, driver: I64, body: I64, gap_m: F64, speed_mps: F64, ahead: Bool
) -> list[Leader]:
    """Return the nearest of the bodies that are ahead of each driver, by pairs ``(P,)``."""
    out = [NO_LEADER] * n_drivers
    for k in np.lexsort((body, gap_m))[::-1]:  # the nearest last
        if ahead[k]:
            out[driver[k]] = Leader(float(gap_m[k]), float(speed_mps[k]), int(body[k]))
    return out


def _steps_in(
    lines: Lines, line: I64, span: Spans, walkers: I64, reach_m: F64, velocity: F64
) -> F64:
    """Return in how many seconds ``(W,)`` people beside the corridors of lines step into them;
    infinite for those who do not.

    Args:
        lines: All lines.
        line: ``(P,)`` the one of each row of ``span``.
        span: Where bodies are on lines.
        walkers: ``(W,)`` rows of the people in ``span``.
        reach_m: ``(P,)`` half widths of the corridors.
        velocity: ``(W, 2)`` of the people.
    """
    _, line_yaw = lines.at(line[walkers], span.rear[walkers])
    left_mps = velocity[:, 1] * np.cos(line_yaw) - velocity[:, 0] * np.sin(line_yaw)
    is_left = span.low[walkers] > 0.0
    away_m = np.where(is_left, span.low[walkers], -span.high[walkers]) - reach_m[walkers]
    nearer_mps = np.where(is_left, -left_mps, left_mps)
    steps_in = nearer_mps > MERGE_MPS
    return np.where(steps_in, away_m / np.where(steps_in, nearer_mps, 1.0), np.inf)


def _least_offsets(
    lines: Lines, line: I64, span: Spans, beside: I64, yaw: F64, velocity: F64
) -> F64:
    """Return how near ``(B,)`` to their lines bodies come within `MERGE_S`, metres; infinite for those
    that do not drive along them.

    Args:
        lines: All lines.
        line: ``(B,)`` the one of each body.
        span: Where bodies are on lines.
        beside: ``(B,)`` rows of the bodies in ``span``.
        yaw, velocity: ``(B,)`` and ``(B, 2)`` of the bodies.
    """
    _, line_yaw = lines.at(line, (span.rear[beside] + span.front[beside]) / 2)
    left_mps = velocity[:, 1] * np.cos(line_yaw) - velocity[:, 0] * np.sin(line_yaw)
    moved_m = MERGE_S * np.where(np.abs(left_mps) > MERGE_MPS, left_mps, 0.0)
    low = span.low[beside] + np.minimum(moved_m, 0.0)
    high = span.high[beside] + np.maximum(moved_m, 0.0)
    is_along = np.cos(yaw - line_yaw) > SAME_WAY
    return np.where(is_along, np.maximum(np.maximum(low, -high), 0.0), np.inf)


def bodies_from(
    xy: F64, yaw: F64, boxes: Sequence[Box], velocity: F64, z: F64 | None = None
) -> Bodies:
    """Build `Bodies` from centres ``(M, 2)``, headings ``(M,)``, boxes, velocities ``(M, 2)`` and
    heights ``(M,)`` of the centres; without heights they are on every level.
    """
    half = np.array([[b.length_m / 2, b.width_m / 2, b.height_m / 2] for b in boxes]).reshape(-1, 3)
    return Bodies(
        xy.reshape(-1, 2),
        yaw.reshape(-1),
        half[:, 0],
        half[:, 1],
        velocity.reshape(-1, 2),
        np.full(len(half), np.nan) if z is None else z.reshape(-1),
        half[:, 2],
    )


def concatenate(parts: Sequence[Bodies]) -> Bodies:
    """Stack several groups of bodies."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return Bodies(*map(np.concatenate, columns))
