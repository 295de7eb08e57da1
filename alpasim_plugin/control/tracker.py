"""Follow a plan: exactly, or with a vehicle that has limits (preview steering, preview speed,
kinematic bicycle).

What all controllers share stands first: the move from a world pose to the plane and back. Plans are
checked where they come from (`core.plan_check`).

Steering minimises, over the next 20 nodes of the path, ``sum of lateral error^2 + rho * steer
rate^2`` for the bicycle itself (not for a linear model of it), by Gauss-Newton. The nodes are
spaced by path length, so the law has the same shape at every speed and needs no special case at
standstill. With ``rho = v^4 / (L^2 w^6)`` the closed loop is a third-order Butterworth filter of
bandwidth ``w`` (the linear-quadratic regulator of ``y''' = v^2 u / L``; Anderson and Moore, Optimal
Control, 1990, section 6.1): no oscillation at any speed.

Speed is the constant acceleration that best meets the planned progress over the next 0.8 s.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from alpasim_plugin.control.bicycle import BicycleState, Command, grip_share, step
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import (
    direction_of,
    interpolate,
    left_of,
    se2,
    unit,
    wrap_angle,
    yaw_from_quat,
    yaw_of,
)
from alpasim_plugin.core.interfaces import Controller
from alpasim_plugin.core.types import F64, EgoState, Trajectory, Vehicle

GENTLE_BRAKE_MPS2 = 2.0  # what a vehicle does without a plan that it can follow
LEADS_BEHIND = math.cos(math.radians(120.0))  # of the angle between the heading and the path

MIN_SPACING_M = 0.25  # closer poses say nothing about the path's direction
_SEARCHED = np.arange(41.0)
MAX_LATERAL_MPS2 = 8.0  # beyond it tyres slip and a kinematic bicycle is no model of a car
CONTROL_S = 0.05  # how often the law looks again within one call
NODES = 20
NODE_S = 0.1
BANDWIDTH_RADPS = 2.5
MIN_PREVIEW_MPS = 5.0  # below it the nodes stay this speed's distance apart: 10 m of preview
GAUSS_NEWTON_STEPS = 2
PREVIEW_S = np.linspace(0.2, 0.8, 4)
HOLD_SPEED_MPS = 0.5
HOLD_MOVE_M = 0.3  # a plan that moves less than this in HOLD_S is a stop
HOLD_S = 2.0
# Derivative of the steer at the start of step k by the change in step j.
_BEFORE = np.tril(np.ones((NODES, NODES)), -1)
_MIDDLE = _BEFORE + 0.5 * np.eye(NODES)
_UP_TO = np.tril(np.ones((NODES, NODES), dtype=bool))


def check_interval(state: EgoState, to_us: int) -> float:
    """Return the seconds from the state to ``to_us``; raise InputError unless they are positive."""
    if to_us <= state.t_us:
        raise InputError(
            f"a state at {state.t_us} us: the target time {to_us} us is not later",
            "ask for a later time",
        )
    return (to_us - state.t_us) * 1e-6


def planar(state: EgoState) -> BicycleState:
    """Return the state of the rear axle in the world's xy plane."""
    pose = state.T_world_rig
    return BicycleState(
        float(pose[0, 3]), float(pose[1, 3]), yaw_of(pose), state.speed_mps, state.steer_rad
    )


def spatial(
    now: BicycleState, t_us: int, z_m: float, accel_mps2: float, vehicle: Vehicle
) -> EgoState:
    """Return the ego state of a planar state: level, at height ``z_m``."""
    pose = se2(now.x_m, now.y_m, now.yaw_rad, z_m)
    yaw_rate = now.speed_mps * float(np.tan(now.steer_rad)) / vehicle.wheelbase_m
    yaw_rate *= grip_share(accel_mps2, now.speed_mps, now.steer_rad, vehicle)
    return EgoState(t_us, pose, now.speed_mps, accel_mps2, yaw_rate, now.steer_rad)


def coast_to_stop(state: EgoState, to_us: int, vehicle: Vehicle) -> EgoState:
    """Return the state at ``to_us`` without a plan: gentle braking, steering held."""
    dt_s = check_interval(state, to_us)
    before = planar(state)
    after = step(before, Command(before.steer_rad, 0.0, GENTLE_BRAKE_MPS2), dt_s, vehicle)
    accel = 0.0 if after.speed_mps == 0 else (after.speed_mps - before.speed_mps) / dt_s
    return spatial(after, to_us, float(state.T_world_rig[2, 3]), accel, vehicle)


class PerfectController(Controller):
    """Put the ego on the plan's interpolated pose at the given time; before the first and after the
    last pose, hold that pose.

    Raises:
        InputError: The road has a coefficient of friction, which this would ignore.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        if vehicle.friction is not None:
            raise InputError(
                f"controller perfect: it ignores environment.friction = {vehicle.friction:g}",
                "Add --controller bicycle, or leave out environment.friction.",
            )
        self.vehicle = vehicle

    def advance(self, state: EgoState, plan: Trajectory | None, to_us: int) -> EgoState:
        """Return the state at ``to_us``; see `Controller.advance`. Speed and yaw rate are
        differences over the step.
        """
        if plan is None:
            return coast_to_stop(state, to_us, self.vehicle)
        dt_s = check_interval(state, to_us)
        at_us = min(max(to_us, int(plan.t_us[0])), int(plan.t_us[-1]))
        pose = interpolate(plan, at_us)
        moved = pose[:2, 3] - state.T_world_rig[:2, 3]
        turn = float(wrap_angle(yaw_of(pose) - yaw_of(state.T_world_rig)))
        # The chord of the step points along its mean heading.
        mean_yaw = yaw_of(state.T_world_rig) + turn / 2
        speed = float(moved @ direction_of(mean_yaw)) / dt_s
        yaw_rate = turn / dt_s
        steer = (
            float(np.arctan(self.vehicle.wheelbase_m * yaw_rate / speed))
            if abs(speed) > 0.5
            else state.steer_rad
        )
        return EgoState(to_us, pose, speed, (speed - state.speed_mps) / dt_s, yaw_rate, steer)


@dataclass(frozen=True)
class ReferencePath:
    """A plan in coordinates around ``origin``; arc length is signed: it falls where the plan drives
    backwards.
    """

    t_s: F64  # (T,) seconds after the state's time
    s_m: F64  # (T,) signed progress at t_s; 0 at the first pose
    path_s: F64  # (P,) increasing progress of the path's knots
    path_xy: F64  # (P, 2) metres, world axes, relative to the origin

    @cached_property
    def pieces(self) -> tuple[F64, F64, F64]:
        """Give of each piece between two knots its span (P - 1,) of progress, its step (P - 1, 2)
        and its left normal (P - 1, 2).
        """
        step = self.path_xy[1:] - self.path_xy[:-1]
        tangent = unit(step)
        return (
            self.path_s[1:] - self.path_s[:-1],
            step,
            left_of(tangent),
        )

    def progress(self, t_s: F64) -> F64:
        """Return the progress (K,) planned for times (K,); the first and last pose are held outside
        the plan.
        """
        return np.interp(t_s, self.t_s, self.s_m)

    def at(self, s_m: F64) -> tuple[F64, F64]:
        """Return points (K, 2) and left normals (K, 2) of the path at progress (K,), straight
        beyond its ends.
        """
        knots, (span, step, normal) = self.path_s, self.pieces
        i = np.minimum(np.maximum(np.searchsorted(knots, s_m, side="right") - 1, 0), len(span) - 1)
        point = self.path_xy[i] + ((s_m - knots[i]) / span[i])[:, None] * step[i]
        return point, normal[i]

    def project(self, xy: F64, near_s: float, window_m: float) -> float:
        """Return the progress of the path point nearest to ``xy`` (2,), searched within
        ``window_m`` of ``near_s``.
        """
        reach = _SEARCHED * (window_m / 20) - window_m
        reach[-1] = window_m
        s = near_s + reach
        point, _ = self.at(s)
        k = int(np.argmin(np.sum((point - xy) ** 2, axis=1)))
        foot, _ = self.at(s[k : k + 1])
        along = self.tangent(float(s[k]))
        return float(s[k] + min(max((xy - foot[0]) @ along, -window_m / 20), window_m / 20))

    def tangent(self, s_m: float) -> F64:
        """Return the direction ``(2,)`` of the path at a progress."""
        _, normal = self.at(np.array([s_m]))
        return np.array([normal[0, 1], -normal[0, 0]])


def build_reference_path(plan: Trajectory, t_us: int, origin_xy: F64) -> ReferencePath:
    """Read a checked plan relative to a time and a place.

    A step counts by its component along the pose's heading, so noise on a standing plan adds up to
    nothing instead of to a speed. The path keeps only knots that lie ``MIN_SPACING_M`` further than
    every knot before; a plan that never gets that far is a point, and its path is the straight line
    through it along its heading.
    """
    xy = plan.xyz[:, :2] - origin_xy
    yaw = yaw_from_quat(plan.quat)
    heading = direction_of(yaw)
    mean = heading[:-1] + heading[1:]
    mean = unit(mean)
    s = np.concatenate([[0.0], np.cumsum(np.sum((xy[1:] - xy[:-1]) * mean, axis=1))])
    # Knots in the order of time while the plan drives one way; the way is the sign of the furthest
    # excursion.
    sign = 1.0 if s[np.argmax(np.abs(s))] >= 0 else -1.0
    keep = [0]
    places = list(zip(s.tolist(), *xy.T.tolist(), strict=True))
    s_kept, x_kept, y_kept = places[0]
    for i, (s_i, x, y) in enumerate(places):
        # Headings that contradict the motion can make progress where nothing moves: such a step has
        # no direction.
        if (
            sign * (s_i - s_kept) >= MIN_SPACING_M
            and math.hypot(x - x_kept, y - y_kept) >= 0.5 * MIN_SPACING_M
        ):
            keep.append(i)
            s_kept = s_i
            x_kept = x
            y_kept = y
    path_s = s[keep]
    path_xy = xy[keep]
    if len(keep) == 1:
        path_s = np.array([s[0] - 1.0, s[0] + 1.0])
        path_xy = np.stack([xy[0] - heading[0], xy[0] + heading[0]])
    elif sign < 0:
        path_s = path_s[::-1]
        path_xy = path_xy[::-1]
    return ReferencePath((plan.t_us - t_us).astype(np.float64) * 1e-6, s, path_s, path_xy)


class PlanTracker(Controller):
    """Drive a kinematic bicycle along the plan within the vehicle's limits.

    A plan that ends is held at its last pose, so a short plan brakes. The vehicle reverses only for
    a plan that drives backwards by more than half a metre; noise around a standing plan neither
    moves it nor turns the wheel. No vehicle drives forwards along a path that leads more than 120
    degrees off its heading: it brakes as without a plan.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle

    def advance(self, state: EgoState, plan: Trajectory | None, to_us: int) -> EgoState:
        """Return the state at ``to_us``; see `Controller.advance`."""
        if plan is None:
            return coast_to_stop(state, to_us, self.vehicle)
        dt_s = check_interval(state, to_us)
        origin = state.T_world_rig[:2, 3]
        reference = build_reference_path(plan, state.t_us, origin)
        before = planar(state)
        now = BicycleState(0.0, 0.0, before.yaw_rad, before.speed_mps, before.steer_rad)
        n = max(1, math.ceil(dt_s / CONTROL_S - 1e-9))
        for i in range(n):
            now = step(now, self.command(now, reference, i * dt_s / n), dt_s / n, self.vehicle)
        accel = (now.speed_mps - before.speed_mps) / dt_s
        world = BicycleState(
            now.x_m + float(origin[0]),
            now.y_m + float(origin[1]),
            now.yaw_rad,
            now.speed_mps,
            now.steer_rad,
        )
        return spatial(world, to_us, float(state.T_world_rig[2, 3]), accel, self.vehicle)

    def command(self, now: BicycleState, reference: ReferencePath, t_s: float) -> Command:
        """Return the command at ``t_s`` seconds after the reference's time for a vehicle in the
        reference's coordinates.
        """
        planned = reference.progress(np.concatenate([[t_s], t_s + PREVIEW_S, [t_s + HOLD_S]]))
        xy = np.array([now.x_m, now.y_m])
        s_now = reference.project(xy, float(planned[0]), 2.0 + abs(now.speed_mps) * 0.5)
        to_go = planned[1:] - s_now
        if reference.tangent(s_now) @ direction_of(now.yaw_rad) < LEADS_BEHIND:
            return Command(now.steer_rad, 0.0, GENTLE_BRAKE_MPS2)
        # What counts is that the plan goes back, not that the car has gone too far.
        goes_back = float(planned[-1] - planned[0]) < -2 * HOLD_MOVE_M
        direction = -1.0 if goes_back and now.speed_mps < HOLD_SPEED_MPS else 1.0
        if direction * to_go[-1] < HOLD_MOVE_M and abs(now.speed_mps) < HOLD_SPEED_MPS:
            return Command(now.steer_rad, 0.0, self.vehicle.max_brake_mps2 / 2)
        # The constant acceleration whose motion best meets the progress ``to_go`` (K,) at
        # ``PREVIEW_S``.
        basis = 0.5 * PREVIEW_S**2
        accel = float(basis @ (to_go[:-1] - now.speed_mps * PREVIEW_S) / (basis @ basis))
        target = self.steer_target(now, reference, s_now, direction)
        return (
            Command(target, 0.0, abs(accel))
            if direction * accel < 0
            else Command(target, accel, 0.0)
        )

    def steer_target(
        self, now: BicycleState, reference: ReferencePath, s_now: float, direction: float
    ) -> float:
        """Return the wheel angle to be reached ``CONTROL_S`` later: the first move of the optimal
        sequence.
        """
        wheelbase = self.vehicle.wheelbase_m
        speed = max(abs(now.speed_mps), MIN_PREVIEW_MPS)
        ds = speed * NODE_S * direction
        target, normal = reference.at(s_now + ds * np.arange(1.0, NODES + 1))
        # sqrt(rho) per change of steer in one node
        weight = speed**2 / (wheelbase * BANDWIDTH_RADPS**3) / NODE_S
        grip = math.atan(MAX_LATERAL_MPS2 * wheelbase / max(now.speed_mps**2, 1e-6))
        limit = min(grip, self.vehicle.max_steer_rad)
        change = np.zeros(NODES)
        start = now.steer_rad
        for _ in range(GAUSS_NEWTON_STEPS):
            max_steer = self.vehicle.max_steer_rad
            middle = np.minimum(np.maximum(start + _MIDDLE @ change, -max_steer), max_steer)
            yaw_middle = now.yaw_rad + _MIDDLE @ (ds * np.tan(middle) / wheelbase)
            along = direction_of(yaw_middle)
            position = np.array([now.x_m, now.y_m]) + ds * np.cumsum(along, axis=0)
            error = np.sum(normal * (position - target), axis=1)
            d_turn = (ds / wheelbase / np.cos(middle) ** 2)[:, None] * _MIDDLE
            d_yaw = _MIDDLE @ d_turn
            left = left_of(along)
            # d error_k = normal_k . sum_{i <= k} ds left_i d_yaw_i
            jacobian = np.where(_UP_TO, ds * (normal @ left.T), 0.0) @ d_yaw
            hessian = jacobian.T @ jacobian
            hessian.reshape(-1)[:: NODES + 1] += weight**2
            change = change - np.linalg.solve(hessian, jacobian.T @ error + weight**2 * change)
        # The move is per node of path; in time it takes NODE_S at the preview's speed.
        return min(max(start + float(change[0]) * CONTROL_S / NODE_S, -limit), limit)
