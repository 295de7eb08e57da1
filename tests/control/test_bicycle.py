"""The vehicle model against its closed solution, at standstill, in reverse and at the limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.control.bicycle import BicycleState, Command, step
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Vehicle
from tests.examples import examples

VEHICLE = Vehicle()


def exact_arc(state, accel_mps2, dt_s, wheelbase_m):
    """Return the closed solution for a held wheel and a constant acceleration: an arc of a circle.

    The heading depends on the path length alone, ``yaw = yaw0 + s tan(steer) / L``, and the chord
    of an arc of length s and turn ``2 b`` is ``s sin(b) / b`` at the mean heading.
    """
    s = state.speed_mps * dt_s + 0.5 * accel_mps2 * dt_s**2
    turn = s * math.tan(state.steer_rad) / wheelbase_m
    half = turn / 2
    chord = s * (math.sin(half) / half if abs(half) > 1e-8 else 1.0 - half * half / 6)
    return BicycleState(
        state.x_m + chord * math.cos(state.yaw_rad + half),
        state.y_m + chord * math.sin(state.yaw_rad + half),
        state.yaw_rad + turn,
        state.speed_mps + accel_mps2 * dt_s,
        state.steer_rad,
    )


def error_m(a, b):
    return math.hypot(a.x_m - b.x_m, a.y_m - b.y_m)


def test_error_against_the_exact_circle_falls_with_the_fourth_power_of_the_step():
    start = BicycleState(3.0, -2.0, 0.4, 20.0, 0.5)
    exact = exact_arc(start, -3.0, 4.0, VEHICLE.wheelbase_m)
    steps = [0.2, 0.1, 0.05, 0.025]
    errors = [error_m(step(start, Command(0.5, -3.0), 4.0, VEHICLE, h), exact) for h in steps]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all((orders > 3.8) & (orders < 4.2)), (errors, orders)


def test_default_step_stays_within_a_tenth_of_a_millimetre_on_the_tightest_circle_for_a_minute():
    start = BicycleState(0.0, 0.0, 0.0, 5.0, VEHICLE.max_steer_rad)
    end = step(start, Command(VEHICLE.max_steer_rad), 60.0, VEHICLE)
    assert error_m(end, exact_arc(start, 0.0, 60.0, VEHICLE.wheelbase_m)) < 1e-4


@settings(deadline=None, max_examples=examples(60))
@given(
    speed=st.floats(-10, 40),
    steer=st.floats(-0.55, 0.55),
    yaw=st.floats(-4, 4),
    drive=st.floats(-3, 3),
    seconds=st.floats(0.001, 2.0),
)
def test_any_held_command_matches_the_closed_solution(speed, steer, yaw, drive, seconds):
    start = BicycleState(1e5, -2e5, yaw, speed, steer)
    end = step(start, Command(steer, drive), seconds, VEHICLE)
    exact = exact_arc(start, drive, seconds, VEHICLE.wheelbase_m)
    assert error_m(end, exact) < 1e-5
    assert end.yaw_rad == pytest.approx(exact.yaw_rad, abs=1e-9)
    assert end.speed_mps == pytest.approx(exact.speed_mps, abs=1e-9)


def test_turning_wheel_follows_the_integral_of_the_heading():
    """With a steer that grows linearly, yaw is the integral of v tan(steer) / L = -v ln(cos(steer))
    / (L rate).
    """
    speed = 4.0
    target = 0.5
    seconds = target / VEHICLE.max_steer_rate_radps
    end = step(BicycleState(0.0, 0.0, 0.0, speed, 0.0), Command(10.0), seconds, VEHICLE)
    assert end.steer_rad == pytest.approx(target, abs=1e-12)
    expected = (
        -speed * math.log(math.cos(target)) / (VEHICLE.wheelbase_m * VEHICLE.max_steer_rate_radps)
    )
    assert end.yaw_rad == pytest.approx(expected, abs=1e-9)


def test_error_falls_with_the_fourth_power_of_the_step_where_the_wheel_arrives_within_one():
    """The command of every 50 ms is reached after a part of it, at another instant each time; the
    finest step is the truth.
    """

    def drive(step_s):
        state = BicycleState(0.0, 0.0, 0.0, 15.0, 0.0)
        for k in range(80):
            state = step(
                state,
                Command(0.12 * math.sin(0.35 * k) + 0.017 * (k % 3), -1.0),
                0.05,
                VEHICLE,
                step_s,
            )
        return state

    truth = drive(2e-4)
    errors = [error_m(drive(h), truth) for h in (0.05, 0.025, 0.01)]
    assert errors[0] < 2e-5
    assert errors[1] < errors[0] / 8
    assert errors[2] < errors[1] / 20


def test_wheel_turns_no_faster_and_no_further_than_the_vehicle_can():
    state = BicycleState(0.0, 0.0, 0.0, 8.0, -0.2)
    last = -0.2
    for _ in range(150):
        state = step(state, Command(5.0), 0.01, VEHICLE)
        assert state.steer_rad - last <= VEHICLE.max_steer_rate_radps * 0.01 + 1e-12
        last = state.steer_rad
    assert state.steer_rad == pytest.approx(VEHICLE.max_steer_rad)


def test_standing_vehicle_stays_where_it_is_while_its_wheel_turns():
    end = step(BicycleState(5.0, 6.0, 1.0, 0.0, 0.0), Command(0.6, 0.0, 3.0), 10.0, VEHICLE)
    assert (end.x_m, end.y_m, end.yaw_rad, end.speed_mps) == (5.0, 6.0, 1.0, 0.0)
    assert end.steer_rad == pytest.approx(0.6)


@pytest.mark.parametrize("speed", [12.3, -4.56])
def test_brake_ends_at_exactly_zero_speed_after_the_textbook_distance(speed):
    end = step(BicycleState(0.0, 0.0, 0.0, speed, 0.0), Command(0.0, 0.0, 5.0), 10.0, VEHICLE)
    assert end.speed_mps == 0.0
    assert end.x_m == pytest.approx(math.copysign(speed**2 / 10.0, speed), abs=1e-9)


def test_brake_holds_against_a_weaker_drive_and_yields_to_a_stronger_one():
    standing = BicycleState(0.0, 0.0, 0.0, 0.0, 0.0)
    assert step(standing, Command(0.0, 1.0, 1.5), 3.0, VEHICLE).speed_mps == 0.0
    assert step(standing, Command(0.0, 2.0, 1.5), 3.0, VEHICLE).speed_mps == pytest.approx(1.5)
    assert step(standing, Command(0.0, -2.0, 1.5), 3.0, VEHICLE).speed_mps == pytest.approx(-1.5)


def test_reversing_retraces_the_forward_path():
    start = BicycleState(0.0, 0.0, 0.3, 7.0, 0.4)
    there = step(start, Command(0.4), 5.0, VEHICLE)
    back = step(
        BicycleState(there.x_m, there.y_m, there.yaw_rad, -7.0, 0.4), Command(0.4), 5.0, VEHICLE
    )
    assert error_m(back, start) < 1e-7


def test_accelerations_are_cut_to_what_the_vehicle_can():
    start = BicycleState(0.0, 0.0, 0.0, 20.0, 0.0)
    assert step(start, Command(0.0, 99.0), 1.0, VEHICLE).speed_mps == pytest.approx(
        20.0 + VEHICLE.max_accel_mps2
    )
    assert step(start, Command(0.0, 0.0, 99.0), 1.0, VEHICLE).speed_mps == pytest.approx(
        20.0 - VEHICLE.max_brake_mps2
    )


@pytest.mark.parametrize(
    ("command", "seconds"),
    [(Command(math.nan), 0.1), (Command(0.0, math.inf), 0.1), (Command(0.0), -0.1)],
)
def test_senseless_input_is_refused(command, seconds):
    with pytest.raises(InputError):
        step(BicycleState(0.0, 0.0, 0.0, 1.0, 0.0), command, seconds, VEHICLE)


def test_on_ice_reverse_gear_gets_no_more_grip_after_the_stop_than_before_it():
    ice = replace(VEHICLE, friction=0.1)
    begin = BicycleState(3.0, -2.0, 2.9, 0.001, 0.0)
    done = step(begin, Command(0.0, drive_mps2=-3.0), 0.5, ice)
    assert done.speed_mps == pytest.approx(0.001 - 0.981 * 0.5, abs=1e-9)
