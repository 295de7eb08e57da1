"""Which lights hold somebody who drives along a line."""

import numpy as np
import pytest

from alpasim_plugin.core.lights_passed import passed_red, passings
from alpasim_plugin.core.types import Lane, Signal

HERE = np.zeros(3)
RED = (("red", 10_000_000),)
GREEN = (("green", 10_000_000),)


BEFORE = np.column_stack([np.arange(-20.0, 0.0), np.zeros(20), np.zeros(20)])


def behind_line(turn):
    """A way from x = 0 on that is straight, or turns with a radius of 10 m: 1 left, -1 right."""
    angle = np.linspace(0.0, np.pi / 2, 31)
    if turn == 0:
        return np.column_stack([np.arange(0.0, 31.0), np.zeros(31), np.zeros(31)])
    return np.column_stack([np.sin(angle), turn * (1 - np.cos(angle)), 0 * angle]) * 10.0


def turned(turn):
    return np.concatenate([BEFORE, behind_line(turn)])


TURNS = {"left": 1, "straight": 0, "right": -1}
LANES = {
    "in": Lane("in", turned(0)[:21], None, None, successors=tuple(TURNS)),
    **{key: Lane(key, behind_line(turn), None, None) for key, turn in TURNS.items()},
}


def light(key, phases=RED, **more):
    stop = np.array([[0.0, -1.75, 0.0], [0.0, 1.75, 0.0]])
    return Signal(stop, 0.0, phases, name=f"of {key}", lanes=(key,), **more)


LIGHTS = [light(key) for key in TURNS]


@pytest.mark.parametrize("way", TURNS)
def test_of_the_lights_at_one_line_that_of_the_followed_turn_holds(way):
    for shift in (0.0, 0.4, -0.4):  # a driven line is not in the middle
        line = turned(TURNS[way]) + np.array([0.0, shift, 0.0])
        (passing,) = passings(line, LIGHTS, LANES, HERE)
        assert passing.signal.lanes == (way,)
        assert passing.lanes == (way,)
        assert passing.s_m == pytest.approx(20.0)


def test_the_light_of_the_road_holds_all_who_come_along_it_and_one_without_lanes_whoever_passes():
    whole = light("in")
    elsewhere = Signal(whole.stop, 0.0, RED, lanes=("not in this part of the map",))
    for turn in TURNS.values():
        line = turned(turn)
        assert len(passings(line, [whole], LANES, HERE)) == 1
        assert len(passings(line, [elsewhere], LANES, HERE)) == 1
        assert len(passings(line, LIGHTS, {}, HERE)) == 3
    assert passings(turned(0), [light("in", pedestrians=True)], LANES, HERE) == []


def test_who_crosses_the_lane_or_comes_towards_it_is_not_held():
    y = np.linspace(-10.0, 10.0, 41)
    across = np.column_stack([-0.2 + 0.02 * y, y, 0.0 * y])
    assert passings(across, LIGHTS, LANES, HERE) == []
    assert passings(turned(0)[::-1], LIGHTS, LANES, HERE) == []


def red_lights(line, *lights):
    at_lines = passings(line, lights, LANES, HERE)
    red = [passing.signal.phases == RED for passing in at_lines]
    return [passing.signal.name for passing in passed_red(at_lines, red)]


def test_a_red_light_of_another_turn_is_not_passed():
    lights = [light("left", RED), light("straight", GREEN), light("right", RED)]
    assert red_lights(turned(0), *lights) == []
    assert red_lights(turned(1), *lights) == ["of left"]
    assert red_lights(turned(-1), *lights) == ["of right"]


def test_a_drive_that_ends_before_the_turns_part_passes_red_only_where_all_of_them_have_it():
    short = turned(0)[:23]  # two metres behind the line
    assert len(passings(short, LIGHTS, LANES, HERE)) == 3
    assert len(red_lights(short, *LIGHTS)) == 3
    assert red_lights(short, light("left"), light("straight", GREEN), light("right")) == []
    assert red_lights(short, light("left"), light("straight")) == []  # none holds the right turn
    assert red_lights(short, light("in")) == ["of in"]
