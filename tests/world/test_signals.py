"""Where a driver has to let others pass."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.types import Box, Signal
from alpasim_plugin.world.idm import IdmParams, bend_speeds, bodies_from
from alpasim_plugin.world.path import polyline_path, smooth_path
from alpasim_plugin.world.signals import give_way_gap_m, lights_on, red_gap_m

NORTH = polyline_path(np.column_stack([np.zeros(101), np.arange(-50.0, 51.0), np.zeros(101)]))
LINE = Signal(np.array([[-2.0, -6.0, 0.0], [2.0, -6.0, 0.0]]), np.pi / 2, ())
BOX = Box(4.6, 1.85, 1.5)


def gap(x, y, speed_mps, heading, own=-1, front=30.0):
    along = np.array([np.cos(heading), np.sin(heading)])
    bodies = bodies_from(np.array([x, y]), np.array([heading]), [BOX], speed_mps * along)
    return give_way_gap_m(lights_on(NORTH, [LINE], {}), NORTH, front, bodies, own)


@pytest.mark.parametrize(
    ("body", "waits"),
    [
        ((-30.0, 0.0, 10.0, 0.0), True),  # there within 4 s
        ((-60.0, 0.0, 10.0, 0.0), False),  # later
        ((30.0, 0.0, 10.0, 0.0), False),  # has passed
        ((-30.0, 0.0, 0.0, 0.0), False),  # stands
        ((0.0, -40.0, 10.0, np.pi / 2), False),  # follows
        ((0.0, 30.0, 10.0, -np.pi / 2), True),  # comes on the own way
    ],
)
def test_who_comes_across_the_way_behind_the_line_is_let_pass(body, waits):
    assert gap(*body) == (pytest.approx(14.0) if waits else float("inf"))
    assert gap(*body, own=0) == float("inf")
    assert gap(*body, front=45.0) == float("inf")  # is over the line
    assert gap(*body, front=10.0) == float("inf")  # does not see it yet


@pytest.mark.parametrize(
    ("z_m", "waits"), [(np.nan, True), (0.75, True), (3.0, True), (7.75, False), (-6.0, False)]
)
def test_who_is_on_a_bridge_above_or_a_road_below_is_not_let_pass(z_m, waits):
    """A street that comes from 30 m aside may be 3 m higher there."""
    east = np.array([10.0, 0.0])
    comes = bodies_from(np.array([-30.0, 0.0]), np.zeros(1), [BOX], east, np.array([z_m]))
    lines = lights_on(NORTH, [LINE], {})
    met = give_way_gap_m(lines, NORTH, 30.0, comes, -1)
    assert met == (pytest.approx(14.0) if waits else float("inf"))


def test_a_driver_slows_down_before_a_bend_and_creeps_around_a_corner():
    angle = np.linspace(0.0, np.pi / 2, 20)
    arc = np.column_stack([60.0 + 12.0 * np.sin(angle), 12.0 - 12.0 * np.cos(angle), 0.0 * angle])
    line = np.concatenate([np.column_stack([np.arange(0.0, 60.0, 3.0), np.zeros((20, 2))]), arc])
    path = smooth_path(line)
    wanted = bend_speeds(path, IdmParams(12.0, lateral_accel_mps2=3.0))
    assert wanted[0] == pytest.approx(12.0, abs=0.1)
    assert np.interp(70.0, path.s, wanted) == pytest.approx(6.0, abs=0.3)
    assert (np.diff(wanted**2) / np.diff(path.s)).min() > -3.1
    assert bend_speeds(path, IdmParams(12.0)) is None
    assert bend_speeds(path, IdmParams(12.0, lateral_accel_mps2=1e-3)).min() == 2.0


def test_a_yellow_light_is_one_to_stop_at_where_the_brake_is_enough_for_it():
    crossing = replace(LINE, phases=(("yellow", 3_000_000), ("red", 3_000_000)))
    lights = lights_on(NORTH, [crossing], {})  # the line is 44 m along the path
    speed_mps = 12.0  # stops within 12^2 / (2 * 3) = 24 m
    for gap_m, stops in ((23.9, False), (24.1, True), (40.0, True)):
        met = red_gap_m(lights, 44.0 - gap_m, speed_mps, 1_000_000)
        assert met == (pytest.approx(gap_m) if stops else float("inf"))
    assert red_gap_m(lights, 43.0, speed_mps, 4_000_000) == pytest.approx(1.0)
    assert red_gap_m(lights, 44.5, speed_mps, 4_000_000) == float("inf")
