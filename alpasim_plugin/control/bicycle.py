"""Kinematic bicycle about the rear axle, integrated with the classical Runge-Kutta method of order
4.

The reference point is the rig origin, on the ground under the rear axle, where a kinematic bicycle
has no side slip (Rajamani, Vehicle Dynamics and Control, 2nd ed., section 2.2)::

    x' = v cos(yaw)    y' = v sin(yaw)    yaw' = v tan(steer) / wheelbase    v' = accel    steer' = rate

The equations hold at standstill and in reverse without a special case: nothing is divided by the
speed. On a road with a coefficient of friction the acceleration, of speed and of direction together,
stays within the friction circle: beyond it both are less by the same factor, so the vehicle brakes
longer and follows a wider curve, but does not spin. Otherwise tyre slip is left out; the tracker
keeps its commands where that is fair (`tracker.MAX_LATERAL_MPS2`).
"""

import math
from dataclasses import dataclass, replace

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Vehicle

MAX_SUBSTEP_S = 0.01
G_MPS2 = 9.81


@dataclass(frozen=True)
class BicycleState:
    """Planar state of the rear axle; world metres and radians, ``speed_mps`` along the body,
    negative in reverse.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    steer_rad: float


@dataclass(frozen=True)
class Command:
    """What the driver does with wheel and pedals.

    ``drive_mps2`` pushes along the body (negative: reverse gear). ``brake_mps2`` >= 0 opposes the
    motion and can stop the vehicle but never turn its motion round; at standstill it holds against
    any smaller drive.
    """

    steer_rad: float
    drive_mps2: float = 0.0
    brake_mps2: float = 0.0


def step(
    state: BicycleState,
    command: Command,
    dt_s: float,
    vehicle: Vehicle,
    max_substep_s: float = MAX_SUBSTEP_S,
) -> BicycleState:
    """Advance the vehicle by ``dt_s`` under a held command.

    The wheel turns towards the commanded angle at no more than ``vehicle.max_steer_rate_radps``;
    drive and brake are cut to the vehicle's limits. The instant of stopping is found exactly, so
    that braking ends at a speed of exactly 0.

    Args:
        state: Where the vehicle is.
        command: Held over the whole interval.
        dt_s: Length of the interval, >= 0.
        vehicle: Wheelbase and limits.
        max_substep_s: Longest integration step.

    Raises:
        InputError: The interval is negative, or a value of state or command is not finite.

    Example:
        >>> s = step(BicycleState(0.0, 0.0, 0.0, 10.0, 0.0), Command(0.0), 1.0, Vehicle())
        >>> round(s.x_m, 9)
        10.0
    """
    values = (*vars(state).values(), *vars(command).values(), dt_s)
    if not all(map(math.isfinite, values)) or dt_s < 0:
        raise InputError(
            f"{state} under {command}: a value that is not finite, or dt_s = {dt_s} < 0",
            "give finite values and dt_s >= 0",
        )
    target = _clip(command.steer_rad, vehicle.max_steer_rad)
    drive = _clip(command.drive_mps2, vehicle.max_accel_mps2)
    brake = min(max(command.brake_mps2, 0.0), vehicle.max_brake_mps2)
    turn = target - state.steer_rad
    slew_s = min(abs(turn) / vehicle.max_steer_rate_radps, dt_s)
    # No step contains the instant at which the wheel arrives: the right-hand side is smooth inside
    # each, which order 4 needs.
    for span_s, rate in (
        (slew_s, math.copysign(vehicle.max_steer_rate_radps, turn)),
        (dt_s - slew_s, 0.0),
    ):
        n = math.ceil(span_s / max_substep_s - 1e-9)
        for _ in range(n):
            state = _substep(state, rate, drive, brake, span_s / n, vehicle)
        if slew_s < dt_s:
            state = replace(state, steer_rad=target)
    return state


def _substep(
    state: BicycleState, steer_rate: float, drive: float, brake: float, h: float, vehicle: Vehicle
) -> BicycleState:
    """Integrate one sub-step, cut at the instant of standstill where the brake brings one."""
    accel = _accel(state.speed_mps, drive, brake)
    share = grip_share(accel, state.speed_mps, state.steer_rad + 0.5 * h * steer_rate, vehicle)
    accel *= share
    wheelbase = vehicle.wheelbase_m / share  # a longer vehicle turns less
    if state.speed_mps * accel < 0:
        stop_s = -state.speed_mps / accel
        if stop_s < h:
            at_stop = replace(_rk4(state, steer_rate, accel, stop_s, wheelbase), speed_mps=0.0)
            accel = _accel(0.0, drive, brake) * share
            return _rk4(at_stop, steer_rate, accel, h - stop_s, wheelbase)
    return _rk4(state, steer_rate, accel, h, wheelbase)


def grip_share(accel_mps2: float, speed_mps: float, steer_rad: float, vehicle: Vehicle) -> float:
    """Return the share of an acceleration along the body, and of the one across it that speed and
    steering ask for, that the friction circle leaves: 1 within it.
    """
    if vehicle.friction is None:
        return 1.0
    lateral = speed_mps**2 * math.tan(steer_rad) / vehicle.wheelbase_m
    demand = math.hypot(accel_mps2, lateral)
    return min(1.0, vehicle.friction * G_MPS2 / demand) if demand > 0 else 1.0


def _accel(speed: float, drive: float, brake: float) -> float:
    """Return the net acceleration: the brake acts against the motion, and at standstill against the
    drive.
    """
    if speed != 0:
        return drive - math.copysign(brake, speed)
    return math.copysign(max(abs(drive) - brake, 0.0), drive)


def _rk4(
    s: BicycleState, steer_rate: float, accel: float, h: float, wheelbase: float
) -> BicycleState:
    """Take one classical Runge-Kutta step; speed and steer are linear in time, so only x, y and yaw
    need the four stages.
    """
    v0 = s.speed_mps
    v1 = s.speed_mps + 0.5 * h * accel
    v2 = s.speed_mps + h * accel
    w0 = v0 * math.tan(s.steer_rad) / wheelbase
    w1 = v1 * math.tan(s.steer_rad + 0.5 * h * steer_rate) / wheelbase
    w2 = v2 * math.tan(s.steer_rad + h * steer_rate) / wheelbase
    yaw_a = s.yaw_rad + 0.5 * h * w0
    yaw_b = s.yaw_rad + 0.5 * h * w1
    yaw_c = s.yaw_rad + h * w1
    cos = math.cos
    sin = math.sin
    x = s.x_m + h / 6 * (v0 * cos(s.yaw_rad) + 2 * v1 * (cos(yaw_a) + cos(yaw_b)) + v2 * cos(yaw_c))
    y = s.y_m + h / 6 * (v0 * sin(s.yaw_rad) + 2 * v1 * (sin(yaw_a) + sin(yaw_b)) + v2 * sin(yaw_c))
    return BicycleState(
        x, y, s.yaw_rad + h / 6 * (w0 + 4 * w1 + w2), v2, s.steer_rad + h * steer_rate
    )


def _clip(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)
