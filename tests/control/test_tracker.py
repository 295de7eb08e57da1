"""The tracker on steps, curves, lane changes, stops, and on plans that are short, noisy, kinked or
broken.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.control import make_controller
from alpasim_plugin.control.tracker import MAX_LATERAL_MPS2
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import quat_from_yaw, se2, yaw_of
from alpasim_plugin.core.types import EgoState, Trajectory, Vehicle
from tests.examples import examples, first_of, first_rows_of

VEHICLE = Vehicle()
TRACKER = make_controller("bicycle", VEHICLE)


def plan_of(t_s, x, y, yaw):
    t, x_, y_, yaw_ = (
        np.broadcast_to(np.asarray(v, dtype=np.float64), np.shape(t_s)) for v in (t_s, x, y, yaw)
    )
    with np.errstate(invalid="ignore"):  # some plans are broken on purpose
        return Trajectory(
            np.rint(t * 1e6).astype(np.int64),
            np.column_stack([x_, y_, np.zeros_like(x_)]),
            quat_from_yaw(yaw_),
        )


def drive(
    plan,
    start,
    seconds,
    step_us=100_000,
    tracker=TRACKER,
):
    states = [start]
    for _ in range(round(seconds * 1e6 / step_us)):
        now = states[-1]
        states.append(
            tracker.advance(now, plan(now) if callable(plan) else plan, now.t_us + step_us)
        )
    return states


def at(x=0.0, y=0.0, yaw=0.0, speed=0.0, steer=0.0):
    return EgoState(0, se2(x, y, yaw), speed, steer_rad=steer)


def xy(states):
    return np.array([s.T_world_rig[:2, 3] for s in states])


@pytest.mark.parametrize("speed", first_of([1.0, 35.0, 3.0, 5.0, 10.0, 20.0]))
def test_half_a_metre_beside_a_straight_plan_is_closed_with_one_small_overshoot(
    speed,
):
    t = np.arange(0, 40, 0.1)
    states = drive(plan_of(t, speed * t, 0, 0), at(y=0.5, speed=speed), max(6.0, 30.0 / speed))
    y = xy(states)[:, 1]
    assert y.min() > -0.06, "overshoot"
    assert abs(y[-1]) < 0.005
    # A damped answer crosses zero at most a few times; an oscillation would go on.
    late = y[len(y) // 2 :]
    assert np.abs(late).max() < 0.05
    assert max(abs(s.yaw_rate_radps * s.speed_mps) for s in states) < 1.5, "comfort"


@pytest.mark.parametrize(
    ("speed", "radius"),
    first_rows_of([(2, 6), (35, 400), (5, 10), (10, 20), (15, 60), (30, 200)], 2),
)
def test_circle_is_held_to_a_centimetre(speed, radius):
    t = np.arange(0, 30, 0.1)
    a = speed * t / radius
    states = drive(
        plan_of(t, radius * np.sin(a), radius * (1 - np.cos(a)), a), at(speed=speed), 15.0
    )
    off = np.hypot(xy(states)[:, 0], xy(states)[:, 1] - radius) - radius
    assert np.abs(off[-30:]).max() < 0.01
    assert np.abs(off).max() < 0.4, "while the wheel is still turning in"
    assert states[-1].speed_mps == pytest.approx(speed, rel=2e-3)


@pytest.mark.parametrize("speed", first_of([35.0, 5.0, 10.0, 20.0]))
def test_lane_change_is_followed_within_ten_centimetres(speed):
    t = np.arange(0, 20, 0.1)
    x = speed * t
    u = np.clip((x - 10) / (4 * speed), 0, 1)
    y = 3.5 * (10 * u**3 - 15 * u**4 + 6 * u**5)
    states = drive(plan_of(t, x, y, np.arctan(np.gradient(y, x))), at(speed=speed), 8.0)
    went = xy(states)
    assert np.abs(went[:, 1] - np.interp(went[:, 0], x, y)).max() < 0.1
    assert np.abs(went[:, 0] - speed * 0.1 * np.arange(len(went))).max() < 0.1


def test_drive_does_not_depend_on_where_in_the_world_it_happens():
    t = np.arange(
        0, 10, 0.0937
    )  # the preview's nodes, 0.8 m apart, do not lie on the path's knots: there its direction has two values
    a = 8 * t / 25
    x = 25 * np.sin(a)
    y = 25 * (1 - np.cos(a))
    here = drive(plan_of(t, x, y, a), at(speed=8.0), 6.0)
    c = np.cos(2.5)
    s = np.sin(2.5)
    far = plan_of(t, c * x - s * y + 4e5, s * x + c * y - 5e6, a + 2.5)
    there = drive(far, EgoState(0, se2(4e5, -5e6, 2.5), 8.0), 6.0)
    back = (xy(there) - [4e5, -5e6]) @ np.array([[c, -s], [s, c]])
    assert np.allclose(back, xy(here), atol=1e-5)


@pytest.mark.parametrize("speed", [2.0, 10.0, 25.0])
def test_noisy_plan_that_stops_is_left_standing_without_creeping_or_reversing(speed):
    stop_s = speed / 3
    t = np.arange(0, stop_s + 8, 0.1)
    x = np.where(t < stop_s, speed * t - 1.5 * t * t, speed**2 / 6)
    random = np.random.default_rng(0)

    def noisy(_):
        return plan_of(
            t,
            x + random.normal(0, 0.05, len(t)),
            random.normal(0, 0.05, len(t)),
            random.normal(0, 0.02, len(t)),
        )

    states = drive(noisy, at(speed=speed), stop_s + 6)
    assert min(s.speed_mps for s in states) == 0.0
    assert xy(states)[-1, 0] == pytest.approx(speed**2 / 6, abs=0.35)
    standing = states[-30:]
    assert np.ptp(xy(standing), axis=0).max() == 0.0
    assert np.ptp([s.steer_rad for s in standing]) == 0.0, "the wheel does not hunt either"


def test_short_plan_is_held_at_its_last_pose_so_the_car_brakes_and_stays():
    states = drive(plan_of([0.0, 0.1, 0.2, 0.5], [0, 1, 2, 5], 0, 0), at(speed=10.0), 6.0)
    assert states[-1].speed_mps == 0.0
    assert states[-1].T_world_rig[0, 3] < 10.0**2 / 2 / VEHICLE.max_brake_mps2 + 4.0
    assert abs(states[-1].T_world_rig[1, 3]) < 1e-6


def test_plan_that_drives_backwards_is_reversed_along():
    t = np.arange(0, 12, 0.1)
    a = 2 * t / 20
    states = drive(plan_of(t, -20 * np.sin(a), 20 * (1 - np.cos(a)), -a), at(), 6.0)
    off = np.hypot(xy(states)[:, 0], xy(states)[:, 1] - 20) - 20
    assert states[-1].speed_mps == pytest.approx(-2.0, abs=0.05)
    assert np.abs(off).max() < 0.15


def test_kinked_plan_is_rounded_within_the_limits_and_met_again():
    t = np.arange(0, 10, 0.1)
    d = 8 * t
    x = np.where(d < 20, d, 20 + (d - 20) * np.cos(1.0))
    y = np.where(d < 20, 0.0, (d - 20) * np.sin(1.0))
    states = drive(plan_of(t, x, y, np.where(d < 20, 0.0, 1.0)), at(speed=8.0), 7.0)
    end = xy(states)[-1] - [20, 0]
    assert abs(end @ [-np.sin(1.0), np.cos(1.0)]) < 0.1
    assert yaw_of(states[-1].T_world_rig) == pytest.approx(1.0, abs=0.03)
    steps = np.abs(np.diff([s.steer_rad for s in states]))
    assert steps.max() <= VEHICLE.max_steer_rate_radps * 0.1 + 1e-9


def test_plan_beside_a_fast_car_is_not_met_with_more_grip_than_tyres_have():
    t = np.arange(0, 10, 0.1)
    states = drive(plan_of(t, 35 * t, 30.0, 0), at(speed=35.0), 4.0)
    assert max(abs(s.yaw_rate_radps * s.speed_mps) for s in states) <= MAX_LATERAL_MPS2 * 1.02


@settings(deadline=None, max_examples=examples(40))
@given(data=st.data())
def test_any_finite_plan_keeps_state_finite_and_within_the_limits(data):
    n = data.draw(st.integers(1, 12))
    coordinate = st.floats(-60, 60)
    x, y, yaw = (data.draw(st.lists(coordinate, min_size=n, max_size=n)) for _ in range(3))
    start = at(
        speed=data.draw(st.floats(-3, 35)),
        steer=data.draw(st.floats(-0.6, 0.6)),
        yaw=data.draw(st.floats(-3, 3)),
    )
    for a, b in pairwise(drive(plan_of(0.3 * np.arange(n), x, y, yaw), start, 1.0)):
        assert np.isfinite(b.T_world_rig).all()
        assert abs(b.steer_rad) <= VEHICLE.max_steer_rad + 1e-9
        assert abs(b.steer_rad - a.steer_rad) <= VEHICLE.max_steer_rate_radps * 0.1 + 1e-9
        assert (
            -VEHICLE.max_brake_mps2 * 0.1 - 1e-9
            <= abs(b.speed_mps) - abs(a.speed_mps)
            <= VEHICLE.max_accel_mps2 * 0.1 + 1e-9
        )


def test_advancing_twice_from_the_same_state_gives_the_same_and_leaves_the_input_alone():
    t = np.arange(0, 5, 0.1)
    plan = plan_of(t, 9 * t, 0.1 * t, 0.01)
    state = at(y=0.2, speed=9.0)
    before = state.T_world_rig.copy()
    first = TRACKER.advance(state, plan, 100_000)
    TRACKER.advance(at(speed=3.0), plan_of(t, 3 * t, 0, 0), 100_000)
    again = TRACKER.advance(state, plan, 100_000)
    assert np.array_equal(first.T_world_rig, again.T_world_rig)
    assert first.speed_mps == again.speed_mps
    assert np.array_equal(before, state.T_world_rig)


def test_no_plan_brakes_gently_to_a_stop():
    states = [at(speed=6.0, steer=0.1)]
    for _ in range(40):
        states.append(TRACKER.advance(states[-1], None, states[-1].t_us + 100_000))
    assert states[1].speed_mps == pytest.approx(5.8)
    assert states[-1].speed_mps == 0.0


@pytest.mark.parametrize("turn", [np.pi, -2.5])
@pytest.mark.parametrize("speed", [0.0, 8.0])
def test_plan_that_leads_behind_the_car_is_braked_for(speed, turn):
    t = np.arange(0, 8, 0.1)
    plan = plan_of(t, 8 * t * np.cos(turn), 8 * t * np.sin(turn), turn)
    states = drive(plan, at(speed=speed), 6.0)
    speeds_mps = [state.speed_mps for state in states]
    assert speeds_mps == sorted(speeds_mps, reverse=True)
    assert speeds_mps[-1] == 0.0


def test_u_turn_is_driven():
    t = np.arange(0, 14, 0.1)
    angle = np.clip(4 * t / 9, 0, np.pi)
    beyond_m = np.maximum(4 * t - 9 * np.pi, 0)
    plan = plan_of(t, 9 * np.sin(angle) - beyond_m, 9 * (1 - np.cos(angle)), angle)
    states = drive(plan, at(speed=4.0), 10.0)
    assert np.abs(xy(states)[-1] - [9 * np.pi - 40.0, 18.0]).max() < 0.3
    assert states[-1].speed_mps == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize("name", ["bicycle", "perfect"])
def test_time_that_does_not_advance_is_refused(name):
    with pytest.raises(InputError, match="not later"):
        make_controller(name, VEHICLE).advance(at(), plan_of([0.0], [0.0], 0, 0), 0)


def test_perfect_controller_stands_on_the_plan_and_holds_its_last_pose():
    perfect = make_controller("perfect", VEHICLE)
    t = np.arange(0, 2.01, 0.1)
    a = 5 * t / 10
    plan = plan_of(t, 10 * np.sin(a), 10 * (1 - np.cos(a)), a)
    state = perfect.advance(at(speed=5.0), plan, 1_000_000)
    assert np.allclose(
        state.T_world_rig[:2, 3], [10 * np.sin(0.5), 10 * (1 - np.cos(0.5))], atol=1e-12
    )
    state = perfect.advance(state, plan, 1_100_000)
    assert state.speed_mps == pytest.approx(5.0, abs=1e-2)
    assert state.yaw_rate_radps == pytest.approx(0.5, abs=1e-6)
    held = perfect.advance(state, plan, 5_000_000)
    assert yaw_of(held.T_world_rig) == pytest.approx(1.0)
    assert perfect.advance(held, plan, 5_100_000).speed_mps == 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_perfect_controller_turns_the_shorter_way_across_180_degrees(side):
    perfect = make_controller("perfect", VEHICLE)
    t = np.arange(0, 2.01, 0.1)
    yaw = side * (np.radians(170) + 0.5 * t)
    x = 10 * (np.sin(yaw) - np.sin(yaw[0])) * side
    y = 10 * (np.cos(yaw[0]) - np.cos(yaw)) * side
    state = at(yaw=yaw[0], speed=5.0)
    for t_us in range(100_000, 1_000_001, 100_000):
        state = perfect.advance(state, plan_of(t, x, y, yaw), t_us)
        assert state.yaw_rate_radps == pytest.approx(side * 0.5, abs=1e-6)
        assert state.speed_mps == pytest.approx(5.0, abs=1e-2)
        assert state.steer_rad == pytest.approx(
            side * np.arctan(VEHICLE.wheelbase_m / 10), abs=1e-3
        )


def test_perfect_controller_steers_to_the_same_side_in_reverse():
    perfect = make_controller("perfect", VEHICLE)
    t = np.arange(0, 2.01, 0.1)
    yaw = np.radians(-172) - 0.5 * t  # backwards on a circle to the left
    x = 10 * (np.sin(yaw) - np.sin(yaw[0]))
    y = 10 * (np.cos(yaw[0]) - np.cos(yaw))
    state = at(yaw=yaw[0], speed=-5.0)
    for t_us in range(100_000, 1_000_001, 100_000):
        state = perfect.advance(state, plan_of(t, x, y, yaw), t_us)
        assert state.speed_mps == pytest.approx(-5.0, abs=1e-2)
        assert state.yaw_rate_radps == pytest.approx(-0.5, abs=1e-6)
        assert state.steer_rad == pytest.approx(np.arctan(VEHICLE.wheelbase_m / 10), abs=1e-3)


def test_standing_start_reaches_the_planned_acceleration_and_place():
    t = np.arange(0, 10, 0.1)
    states = drive(plan_of(t, t * t, 0, 0), at(), 5.0)
    assert states[-1].speed_mps == pytest.approx(10.0, abs=0.05)
    assert states[-1].T_world_rig[0, 3] == pytest.approx(25.0, abs=0.1)


def test_on_a_slippery_road_braking_is_longer_and_curves_are_wider():
    speed = 15.0
    limit = 0.2 * 9.81
    tracker = make_controller("bicycle", replace(VEHICLE, friction=0.2))
    t = np.arange(0, 40, 0.1)
    stopped = drive(plan_of(t, 0, 0, 0), at(speed=speed), 12, tracker=tracker)
    assert stopped[-1].speed_mps == 0
    assert xy(stopped)[-1, 0] == pytest.approx(speed**2 / (2 * limit), rel=0.05)
    turn = speed * t / 60  # a curve of 60 m asks for 3.75 m/s2
    curve = plan_of(t, 60 * np.sin(turn), 60 * (1 - np.cos(turn)), turn)
    states = drive(curve, at(speed=speed), 3, tracker=tracker)
    for before, after in pairwise(states):
        turned = yaw_of(after.T_world_rig) - yaw_of(before.T_world_rig)
        assert np.hypot(turned / 0.1 * after.speed_mps, after.accel_mps2) < 1.03 * limit
    assert abs(states[-1].yaw_rate_radps) * states[-1].speed_mps == pytest.approx(limit, rel=0.1)
    assert np.hypot(*(xy(states)[-1] - [0, 60])) > 65
    with pytest.raises(InputError):
        make_controller("perfect", tracker.vehicle)
