"""The driver model and the choice of a leader."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.types import Box
from alpasim_plugin.world.idm import (
    NO_LEADER,
    IdmParams,
    bodies_from,
    concatenate,
    find_leader,
    find_leaders,
    idm_acceleration,
)
from alpasim_plugin.world.path import Lines, polyline_path
from alpasim_plugin.world.yielding import TIMES_S, PredictedBodies, yielding_acceleration

P = IdmParams(desired_speed_mps=20.0, headway_s=1.5, min_gap_m=2.0, accel_mps2=1.0, brake_mps2=1.5)
STRAIGHT = polyline_path(np.column_stack([np.linspace(0, 200, 201), np.zeros((201, 2))]))
ROAD = Lines([STRAIGHT])
INF = float("inf")


def car(x, y, yaw=0.0, speed=0.0, box=Box(4.6, 1.85, 1.5)):
    return bodies_from(
        np.array([x, y]), np.array([yaw]), [box], speed * np.array([np.cos(yaw), np.sin(yaw)])
    )


def test_free_road_follows_the_power_law():
    assert idm_acceleration(0.0, INF, 0.0, P) == 1.0
    assert idm_acceleration(10.0, INF, 0.0, P) == pytest.approx(1.0 - 0.5**4)
    assert idm_acceleration(20.0, INF, 0.0, P) == pytest.approx(0.0)
    assert idm_acceleration(25.0, INF, 0.0, P) < 0.0


def test_equilibrium_gap_of_the_equation_gives_no_acceleration():
    # Treiber et al. (2000): s_e = (s0 + v T) / sqrt(1 - (v / v0)^4)
    for v in (0.0, 5.0, 15.0, 19.0):
        gap = (P.min_gap_m + v * P.headway_s) / np.sqrt(1 - (v / P.desired_speed_mps) ** 4)
        assert idm_acceleration(v, gap, 0.0, P) == pytest.approx(0.0, abs=1e-12)


def test_closing_in_brakes_harder_and_is_cut_off_at_what_the_vehicle_can_do():
    assert idm_acceleration(15.0, 30.0, 10.0, P) < idm_acceleration(15.0, 30.0, 0.0, P)
    assert idm_acceleration(20.0, 1.0, 20.0, P) == -P.hard_brake_mps2
    assert idm_acceleration(10.0, -3.0, 0.0, P) == -P.hard_brake_mps2


@settings(deadline=None)
@given(st.floats(0, 40), st.floats(0.1, 200), st.floats(-20, 40), st.floats(0.5, 100))
def test_a_larger_gap_never_brakes_harder(speed, gap, closing, more):
    assert idm_acceleration(speed, gap + more, closing, P) >= idm_acceleration(
        speed, gap, closing, P
    )


def test_a_platoon_behind_a_stopped_car_stops_without_contact():
    x = np.array([80.0, 40.0, 0.0])
    v = np.array([0.0, 15.0, 15.0])
    for _ in range(6000):
        a = [
            idm_acceleration(v[i], x[i - 1] - 5.0 - x[i], v[i] - v[i - 1], P) if i else 0.0
            for i in range(3)
        ]
        v = np.maximum(0.0, v + 0.01 * np.array(a))
        x = x + 0.01 * v
        assert (x[:-1] - 5.0 - x[1:] > 0).all()
    # The model creeps the last metre ever more slowly towards its gap at standstill.
    np.testing.assert_allclose(x[:-1] - 5.0 - x[1:], P.min_gap_m, atol=0.5)
    assert (v < 0.1).all()


def test_the_nearest_body_in_the_corridor_leads():
    leader = find_leader(
        ROAD, 10.0, 0.95, concatenate([car(60, 0, speed=5), car(40, 0, speed=7), car(30, 3.5)])
    )
    assert leader.index == 1
    assert leader.gap_m == pytest.approx(40 - 2.3 - 10, abs=1e-6)
    assert leader.speed_mps == pytest.approx(7.0)


@pytest.mark.parametrize(("y", "leads"), [(0.0, True), (2.0, True), (2.2, False), (-2.2, False)])
def test_corridor_is_as_wide_as_the_car_and_a_margin(y, leads):
    assert (
        find_leader(ROAD, 10.0, 0.95, car(40, y)).index == 0
    ) == leads  # 0.95 + 0.2 + 1.85 / 2 = 2.075


def test_a_body_behind_is_no_leader_and_a_touching_one_is():
    assert find_leader(ROAD, 50.0, 0.95, car(45, 0)).index == -1
    touching = find_leader(ROAD, 50.0, 0.95, car(51.5, 0))
    assert touching.index == 0
    assert touching.gap_m < 0


def test_a_crossing_truck_blocks_with_its_length():
    truck = Box(10.0, 2.5, 3.0)
    assert find_leader(
        ROAD, 10.0, 0.95, car(40, 5.0, np.pi / 2, 3.0, truck)
    ).gap_m == pytest.approx(40 - 1.25 - 10)
    assert find_leader(ROAD, 10.0, 0.95, car(40, 5.0, 0.0, 3.0, truck)).index == -1


def test_the_leaders_of_many_drivers_are_those_of_each():
    random = np.random.default_rng(0)
    angle = np.linspace(0, 0.9 * np.pi, 400)
    bend = polyline_path(np.stack([60 * np.cos(angle), 60 * np.sin(angle)], axis=1))
    paths, count, met = [STRAIGHT, bend], 30, 0
    for _ in range(10):
        boxes = [Box(*random.uniform([1, 0.6, 1], [12, 2.5, 3])) for _ in range(count)]
        xy = random.uniform(-40, 90, (count, 2))
        yaw = random.uniform(-np.pi, np.pi, count)
        xy[:20, 1] = random.normal(0, 3, 20)
        velocity = random.normal(0, 8, (count, 2))
        line = random.integers(0, 2, 12)
        front = random.uniform(-5, 120, 12)
        horizon = random.uniform(20, 120, 12)
        half = random.uniform(0.4, 1.3, 12)
        own = np.full(12, -1)
        everybody = bodies_from(xy, yaw, boxes, velocity)
        first = find_leaders(Lines(paths), line, front, half, everybody, horizon, own)
        own = np.array([leader.index for leader in first])  # so that leaving it out matters
        found = find_leaders(Lines(paths), line, front, half, everybody, horizon, own)
        for k, leader in enumerate(found):
            others = xy.copy()
            others[own[k]] = 1e6
            bodies = bodies_from(others, yaw, boxes, velocity)
            alone = find_leader(Lines([paths[line[k]]]), front[k], half[k], bodies, horizon[k])
            assert leader.index == alone.index
            assert leader.gap_m == pytest.approx(alone.gap_m, abs=1e-9)
            met += alone.index >= 0
    assert met > 15


def test_oncoming_leader_counts_as_standing():
    assert find_leader(ROAD, 10.0, 0.95, car(40, 0, np.pi, 8.0)).speed_mps == 0.0


class Unasked(Lines):
    """Lines that nothing may be projected onto."""

    def at(self, line, s_m, offset_m=0.0):
        raise AssertionError("a place on a line was asked for")

    def stations(self, line, low_m, high_m):
        raise AssertionError("stations of a line were asked for")


def test_on_an_empty_road_nothing_is_followed_and_nothing_projected():
    lines = Unasked([STRAIGHT, STRAIGHT])
    two = np.arange(2)
    leaders = find_leaders(
        lines, two, np.zeros(2), np.ones(2), nobody(), np.full(2, 100.0), np.full(2, -1)
    )
    assert leaders == [NO_LEADER, NO_LEADER]


def test_where_nobody_is_expected_nothing_limits_the_acceleration():
    rows = len(TIMES_S)
    none_ahead = PredictedBodies(
        xy=np.zeros((rows, 0, 2)),
        yaw=np.zeros((rows, 0)),
        velocity=np.zeros((rows, 0, 2)),
        present=np.zeros((rows, 0), dtype=bool),
        boxes=(),
        z=np.zeros((rows, 0)),
        yields=np.zeros(0, dtype=bool),
    )
    line = Unasked([STRAIGHT])
    assert yielding_acceleration(line, 10.0, 8.0, Box(4.6, 1.85, 1.5), none_ahead) == INF


def nobody():
    return bodies_from(np.zeros((0, 2)), np.zeros(0), [], np.zeros((0, 2)))
