"""The Intelligent Driver Model and the choice of the leader that a driver follows.

Source: M. Treiber, A. Hennecke, D. Helbing, "Congested traffic states in empirical observations and
    microscopic simulations",
Physical Review E 62 (2000), equations 2 and 3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, I64, Bool, Box
from alpasim_plugin.world.path import Lines, Path


@dataclass(frozen=True)
class IdmParams:
    """Parameters of one driver."""

    desired_speed_mps: float = 13.9
    headway_s: float = 1.5
    min_gap_m: float = 2.0
    accel_mps2: float = 1.5
    brake_mps2: float = 2.0  # comfortable
    hard_brake_mps2: float = 7.0  # what the vehicle can do; the model's own demand is cut off here

    @staticmethod
    def from_mapping(params: Mapping[str, float]) -> IdmParams:
        """Read the parameters of a `Behaviour`; absent ones take their defaults.

        Raises:
            InputError: A parameter that the model does not have, or one that is not positive.
        """
        known = IdmParams.__dataclass_fields__
        for key, value in params.items():
            if key not in known or not value > 0:
                found = f"{value} is not positive" if key in known else "no such parameter"
                raise InputError(
                    f"idm parameter {key!r}: {found}",
                    f"use positive {', '.join(known)}",
                )
        return IdmParams(**{k: float(v) for k, v in params.items()})


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
    v0 = max(p.desired_speed_mps, 0.1)
    free = 1.0 - (speed_mps / v0) ** 4
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


@dataclass(frozen=True)
class Bodies:
    """Road users at one instant, as rectangles."""

    xy: F64  # (M, 2) centre, metres, world
    yaw: F64  # (M,) radians
    half_length_m: F64  # (M,)
    half_width_m: F64  # (M,)
    velocity: F64  # (M, 2) metres per second, world


@dataclass(frozen=True)
class Leader:
    """The road user ahead that limits the speed."""

    gap_m: float  # from the own front bumper; may be negative in contact
    speed_mps: float  # along the own path
    index: int  # row in `Bodies`, -1: none


NO_LEADER = Leader(float("inf"), 0.0, -1)

BEHIND_M = 15.0  # a body is looked for so far behind the own front bumper
_OUTLINE = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [0.0, 1.0], [0.0, -1.0]])


@dataclass(frozen=True)
class Spans:
    """Extent of bodies along and across a path; rows are those near enough to matter."""

    index: I64  # (m,) row in `Bodies`
    rear: F64  # (m,) smallest arc length of the outline
    front: F64  # (m,) largest
    low: F64  # (m,) rightmost distance from the path
    high: F64  # (m,) leftmost
    speed: F64  # (m,) along the path, >= 0

    def only(self, keep: Bool) -> Spans:
        """Return the rows ``(m,)`` that are kept."""
        return Spans(*(column[keep] for column in vars(self).values()))


def _outlines(bodies: Bodies, rows: I64) -> F64:
    """Return corners and middles of the long sides ``(m, 6, 2)`` of some bodies."""
    c, s = np.cos(bodies.yaw[rows])[:, None], np.sin(bodies.yaw[rows])[:, None]
    ax = _OUTLINE[:, 0] * bodies.half_length_m[rows, None]  # (m, 6)
    ay = _OUTLINE[:, 1] * bodies.half_width_m[rows, None]
    return np.stack(
        [bodies.xy[rows, 0:1] + c * ax - s * ay, bodies.xy[rows, 1:2] + s * ax + c * ay], axis=-1
    )


def spans(
    path: Path, from_s_m: float, bodies: Bodies, horizon_m: float = 120.0, window: bool = True
) -> Spans | None:
    """Return where bodies lie on a path, from `BEHIND_M` behind ``from_s_m`` to ``horizon_m`` ahead; None
    where there is none.

    Without ``window`` the whole path is searched, for static bodies that are queried repeatedly.
    """
    if len(bodies.xy) == 0:
        return None
    start, _ = path.at(from_s_m)
    near = np.flatnonzero(
        np.hypot(*(bodies.xy - start[:2]).T) < horizon_m + bodies.half_length_m + 5.0
    )
    if len(near) == 0:
        return None
    along, across = path.project(
        _outlines(bodies, near).reshape(-1, 2),
        (from_s_m - BEHIND_M, from_s_m + horizon_m) if window else None,
    )
    along, across = along.reshape(-1, 6), across.reshape(-1, 6)
    rear = along.min(axis=1)
    _, yaw = path.at(rear)
    speed = bodies.velocity[near, 0] * np.cos(yaw) + bodies.velocity[near, 1] * np.sin(yaw)
    return Spans(
        near,
        rear,
        along.max(axis=1),
        across.min(axis=1),
        across.max(axis=1),
        np.maximum(speed, 0.0),
    )


def find_leader(
    path: Path,
    front_s_m: float,
    half_width_m: float,
    bodies: Bodies,
    horizon_m: float = 120.0,
    margin_m: float = 0.2,
    own_row: int = -1,
) -> Leader:
    """Return the nearest body that reaches into the corridor of a path ahead of the own front
    bumper.

    ``own_row`` is the driver's own row in ``bodies``, which is left out.

    A body counts when its outline overlaps ``+-(half_width_m + margin_m)`` across the path and its
    rear end is not more than 2 m behind the own front bumper, so that touching bodies still count.
    """
    return nearest_ahead(
        spans(path, front_s_m, bodies, horizon_m),
        front_s_m,
        half_width_m,
        horizon_m,
        margin_m,
        own_row,
    )


def find_leaders(
    lines: Lines,
    line: I64,
    front_s_m: F64,
    half_width_m: F64,
    bodies: Bodies,
    horizon_m: F64,
    own_row: I64,
    margin_m: float = 0.2,
) -> list[Leader]:
    """Return the leader of each of many drivers; see `find_leader`.

    Args:
        lines: All lines.
        line: ``(N,)`` the one of each driver.
        front_s_m: ``(N,)`` arc lengths of the front bumpers.
        half_width_m: ``(N,)`` of the drivers' bodies.
        bodies: Everybody.
        horizon_m: ``(N,)`` how far each driver looks.
        own_row: ``(N,)`` rows of the drivers in ``bodies``, -1 where they are not among them.
        margin_m: Added to the half width.
    """
    start, _ = lines.at(line, front_s_m, np.zeros(len(line)))
    delta = bodies.xy - start[:, None, :2]
    reaches = horizon_m[:, None] + bodies.half_length_m + 5.0
    near = np.hypot(delta[..., 0], delta[..., 1]) < reaches
    near[np.flatnonzero(own_row >= 0), own_row[own_row >= 0]] = False
    driver, body = np.nonzero(near)
    half = np.stack([bodies.half_length_m, bodies.half_width_m], axis=1)[body]
    low, high = lines.stations(line, front_s_m - BEHIND_M, front_s_m + horizon_m)
    reach = half_width_m + margin_m
    may = lines.may_overlap(
        line[driver],
        bodies.xy[body],
        bodies.yaw[body],
        half,
        reach[driver],
        low[driver],
        high[driver],
    )
    driver, body = driver[may], body[may]
    out = [NO_LEADER] * len(line)
    if len(driver) == 0:
        return out
    every = np.repeat(driver, len(_OUTLINE))
    along, across = lines.project(
        line[every], _outlines(bodies, body).reshape(-1, 2), low[every], high[every]
    )
    along, across = along.reshape(-1, len(_OUTLINE)), across.reshape(-1, len(_OUTLINE))
    rear = along.min(axis=1)
    ahead = (across.min(axis=1) < reach[driver]) & (across.max(axis=1) > -reach[driver])
    ahead &= (rear > front_s_m[driver] - 2.0) & (rear < (front_s_m + horizon_m)[driver])
    driver, body, rear = driver[ahead], body[ahead], rear[ahead]
    _, yaw = lines.at(line[driver], rear, np.zeros(len(driver)))
    speed = bodies.velocity[body, 0] * np.cos(yaw) + bodies.velocity[body, 1] * np.sin(yaw)
    for k in np.lexsort((body, rear))[::-1].tolist():  # the nearest last
        gap_m = float(rear[k] - front_s_m[driver[k]])
        out[driver[k]] = Leader(gap_m, max(float(speed[k]), 0.0), int(body[k]))
    return out


def nearest_ahead(
    span: Spans | None,
    front_s_m: float,
    half_width_m: float,
    horizon_m: float = 120.0,
    margin_m: float = 0.2,
    own_row: int = -1,
) -> Leader:
    """Return the leader among bodies whose place on the path is known (see `find_leader`)."""
    if span is None:
        return NO_LEADER
    reach = half_width_m + margin_m
    ahead = (
        (span.low < reach)
        & (span.high > -reach)
        & (span.rear > front_s_m - 2.0)
        & (span.rear < front_s_m + horizon_m)
    )
    ahead &= span.index != own_row
    if not ahead.any():
        return NO_LEADER
    k = int(np.argmin(np.where(ahead, span.rear, np.inf)))
    return Leader(float(span.rear[k] - front_s_m), float(span.speed[k]), int(span.index[k]))


NO_BODIES = Bodies(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 2)))


def bodies_from(xy: F64, yaw: F64, boxes: Sequence[Box], velocity: F64) -> Bodies:
    """Build `Bodies` from centres ``(M, 2)``, headings ``(M,)``, boxes and velocities ``(M,
    2)``.
    """
    half = np.array([[b.length_m / 2, b.width_m / 2] for b in boxes]).reshape(-1, 2)
    return Bodies(
        np.asarray(xy).reshape(-1, 2),
        np.asarray(yaw).reshape(-1),
        half[:, 0],
        half[:, 1],
        np.asarray(velocity).reshape(-1, 2),
    )


def concatenate(parts: Sequence[Bodies]) -> Bodies:
    """Stack several groups of bodies."""
    if not parts:
        return NO_BODIES
    return Bodies(
        *(
            np.concatenate(columns)
            for columns in zip(*(vars(part).values() for part in parts), strict=True)
        )
    )
