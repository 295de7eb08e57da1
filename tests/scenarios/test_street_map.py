"""The program that is assumed for the lights of a junction, and who waits where both have green."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.types import Lane, Signal
from scenarios.junction_rules import turning_lines
from scenarios.street_map import Head, with_cycles

DEGREES = {"east": 0.0, "north": 90.0, "west": 180.0, "south": 270.0}
TURNS = {"straight": 0.0, "left": 90.0, "right": -90.0}
EXIT_M = 12.0  # from the middle of the junction to its border
SIDE_M = 1.75  # of a lane from the middle of its road


def turned(xy, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.column_stack([c * xy[:, 0] - s * xy[:, 1], s * xy[:, 0] + c * xy[:, 1], 0 * xy[:, 0]])


def way(direction, turn):
    """The lane of somebody who drives to a direction when it comes to the junction, and then turns."""
    begin = np.array([-EXIT_M, -SIDE_M])
    end = {"straight": (EXIT_M, -SIDE_M), "left": (SIDE_M, EXIT_M), "right": (-SIDE_M, -EXIT_M)}
    share = np.linspace(0.0, 1.0, 21)[:, None]
    corner = np.array([end[turn][0], begin[1]]) if turn != "straight" else begin
    curve = (1 - share) ** 2 * begin + 2 * share * (1 - share) * corner + share**2 * end[turn]
    if turn == "straight":
        curve = begin + share * (np.array(end[turn]) - begin)
    key = f"{direction} {turn}"
    return Lane(key, turned(curve, DEGREES[direction]), None, None, is_intersection=True)


WAYS = [way(direction, turn) for direction in DEGREES for turn in TURNS]
LANES = {lane.lane_id: lane for lane in WAYS}


def head(direction, turn="straight", group="", degrees=0.0, road="", pedestrians=False):
    heading = np.radians(DEGREES[direction] + degrees)
    stop = turned(np.array([[-EXIT_M, -2 * SIDE_M], [-EXIT_M, 0.0]]), DEGREES[direction])
    name = f"{direction} {turn}"
    signal = Signal(stop, heading, (), name=name, lanes=(name,), pedestrians=pedestrians)
    return Head(signal, "j", group, road or name)


def lit(*heads):
    """Return each light's colours over three minutes, by its name."""
    signals = with_cycles(heads, {"j": 5_000_000})
    times = range(0, 180_000_000, 500_000)
    return {signal.name: [signal.colour_at(t_us) for t_us in times] for signal in signals}


EVERY_TURN = [head(direction, turn) for direction in DEGREES for turn in TURNS]


def test_opposite_approaches_are_green_together_with_all_their_turns_and_crossing_ones_never():
    colours = lit(*EVERY_TURN)
    for direction, other in (("east", "west"), ("north", "south")):
        same = [colours[f"{name} {turn}"] for name in (direction, other) for turn in TURNS]
        assert all(row == same[0] for row in same)
    both = zip(colours["east straight"], colours["north left"], strict=True)
    assert all("red" in pair for pair in both)
    for row in colours.values():
        assert {"green", "yellow", "red"} == set(row)
        assert row[:52] == row[128:180]  # a cycle of 64 s


@pytest.mark.parametrize(
    ("directions", "cycle_s"),
    [(("east",), 64), (("east", "west", "north"), 64), (("east", "north", "skew"), 76)],
)
def test_a_cycle_lasts_60_to_90_seconds(directions, cycle_s):
    heads = [
        head("east", degrees=45.0, road="skew") if name == "skew" else head(name)
        for name in directions
    ]
    for signal in with_cycles(heads, {}):
        assert sum(lasts_us for _, lasts_us in signal.phases) == cycle_s * 1_000_000


def test_the_controllers_of_a_map_are_its_phases_where_no_traffic_of_theirs_crosses():
    groups = {"east": "1", "west": "2", "north": "3", "south": "3"}
    colours = lit(*(head(name, group=group) for name, group in groups.items()))
    assert colours["north straight"] == colours["south straight"]
    pairs = zip(colours["east straight"], colours["west straight"], strict=True)
    assert all("red" in pair for pair in pairs)
    # Whoever switches all lights of a junction names no phases.
    colours = lit(*(head(name, group="all") for name in groups))
    assert colours["east straight"] == colours["west straight"]
    pairs = zip(colours["east straight"], colours["north straight"], strict=True)
    assert all("red" in pair for pair in pairs)
    mixed = {"east": "1", "west": "1", "north": "1", "south": "2"}
    assert lit(*(head(name, group=group) for name, group in mixed.items())) == colours


def test_people_walk_while_the_traffic_that_they_cross_has_red():
    walker = head("north", "walk", road="east straight", pedestrians=True)
    elsewhere = head("north", "other walk", road="of no vehicle", pedestrians=True)
    colours = lit(*EVERY_TURN, walker, elsewhere)
    for name in ("north walk", "north other walk"):
        crossed = zip(colours["east straight"], colours[name], strict=True)
        assert all(pair[0] == "red" or pair[1] == "red" for pair in crossed)
        assert "green" in colours[name]


def test_who_turns_left_across_oncoming_traffic_with_green_gives_way():
    lines = turning_lines(with_cycles(EVERY_TURN, {}), LANES)
    waiting = {key for line in lines for key in line.lanes}
    assert waiting == {f"{direction} left" for direction in DEGREES}
    stops = {line.lanes[0]: line.stop for line in lines}
    assert stops["east left"][:, 0] == pytest.approx([-EXIT_M, -EXIT_M])
    alone = [head(name, turn, group=name) for name in DEGREES for turn in TURNS]
    assert turning_lines(with_cycles(alone, {}), LANES) == ()  # each approach has its own phase


def test_a_light_of_the_road_before_the_junction_holds_the_turns_behind_it():
    roads = {
        f"{name} in": Lane(
            f"{name} in",
            way(name, "straight").centre[:2],
            None,
            None,
            successors=tuple(f"{name} {turn}" for turn in TURNS),
        )
        for name in ("east", "west")
    }
    heads = [head("east", "in"), head("west", "in")]
    lines = turning_lines(with_cycles(heads, {}), {**LANES, **roads})
    assert {key for line in lines for key in line.lanes} == {"east left", "west left"}


def test_oncoming_traffic_on_another_level_is_not_waited_for():
    def raised(key):
        z = 6.0 * key.startswith("west")
        return replace(LANES[key], centre=LANES[key].centre + np.array([0.0, 0.0, z]))

    lines = turning_lines(with_cycles(EVERY_TURN, {}), {key: raised(key) for key in LANES})
    assert {key for line in lines for key in line.lanes} == {"north left", "south left"}
