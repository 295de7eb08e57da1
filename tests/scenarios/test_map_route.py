"""Ways along lanes: through places, by length, and none that passes a lane twice."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Lane
from scenarios.load import load_scenario
from scenarios.map_route import LaneGraph, Spot
from tests.files.opendrive_text import lane, road, section

BOTH = (lane(1, 1, 1), lane(-1, -1, -1))


def straight_lane(name, start, end, successors):
    points = np.linspace((*start, 0.0), (*end, 0.0), 20)
    across = np.array([end[1] - start[1], start[0] - end[0], 0.0])
    across = 1.75 * across / np.linalg.norm(across)
    return Lane(name, points, points - across, points + across, successors=successors)


def block_of_streets():
    """A street that forks into a short and a long way, which meet again; from their end a street
    leads back to the start.
    """
    return LaneGraph(
        {
            one.lane_id: one
            for one in (
                straight_lane("in", (0, 0), (100, 0), ("short", "long")),
                straight_lane("short", (100, 0), (200, 0), ("out",)),
                straight_lane("long", (100, 0), (200, 150), ("out",)),
                straight_lane("out", (200, 0), (300, 0), ("back",)),
                straight_lane("back", (300, 0), (0, 0), ("in",)),
            )
        }
    )


def test_a_way_passes_the_places_between_its_ends():
    graph = block_of_streets()
    start, goal = [Spot("in", 20.0)], [Spot("out", 60.0)]
    (direct,) = graph.through([start, goal])
    assert direct.lane_ids == ("in", "short", "out")
    (around,) = graph.through([start, [Spot("long", 30.0)], goal])
    assert around.lane_ids == ("in", "long", "out")
    assert (around.start_m, around.beyond_m) == (20.0, pytest.approx(40.0))
    # Both ways of the block are driven only by taking the first lane twice.
    assert graph.through([start, [Spot("short", 30.0)], [Spot("long", 5.0)]]) == []


def lanes_side_by_side():
    """Three lanes from left to right, of which the right one goes on."""
    left, middle, right = (
        straight_lane(name, (0, y), (300, y), ("ahead",) if name == "right" else ())
        for name, y in (("left", 7.0), ("middle", 3.5), ("right", 0.0))
    )
    lanes = (
        replace(left, right_neighbour="middle"),
        replace(middle, left_neighbour="left", right_neighbour="right"),
        replace(right, left_neighbour="middle"),
        straight_lane("ahead", (300, 0), (600, 0), ()),
    )
    return LaneGraph({one.lane_id: one for one in lanes})


def test_a_change_of_lanes_adds_no_length_and_two_follow_one_another_nowhere():
    graph = lanes_side_by_side()
    (way,) = graph.through([[Spot("middle", 10.0)], [Spot("right", 200.0)]])
    assert way.lane_ids == ("middle", "right")
    assert graph.driven_m(way) == pytest.approx(190.0)
    farther = graph.drawn(way, 400.0, np.random.default_rng(0))
    assert farther.lane_ids == ("middle", "right", "ahead")
    assert graph.driven_m(farther) == pytest.approx(400.0)
    line = graph.line(farther)
    assert line.length_m - farther.beyond_m == pytest.approx(400.0, abs=1.0)
    twice = [[Spot("left", 10.0)], [Spot("middle", 120.0)], [Spot("ahead", 100.0)]]
    assert graph.through(twice) == []


def test_a_drawn_way_has_the_length_wanted_and_drives_no_lane_twice():
    graph = block_of_streets()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        way = graph.drawn(graph.standing(Spot("in", 20.0)), 250.0, rng)
        assert graph.driven_m(way) == pytest.approx(250.0)
        longest = graph.drawn(graph.standing(Spot("in", 20.0)), 5000.0, rng)
        assert len(set(longest.lane_ids)) == len(longest.lane_ids)
        assert longest.beyond_m == 0.0


def test_a_drawn_way_ends_no_earlier_than_the_last_place_that_it_passes():
    graph = block_of_streets()
    (way,) = graph.through([[Spot("in", 0.0)], [Spot("back", 250.0)]])
    carried_on = graph.drawn(way, 200.0, np.random.default_rng(0))
    assert graph.driven_m(carried_on) == pytest.approx(graph.driven_m(way))


def straight_road(folder):
    parts = (
        road("1", section(0, *BOTH), length=260, after="road:2:start"),
        road("2", section(0, *BOTH), x=260, length=240, before="road:1:end"),
    )
    file = folder / "map.xodr"
    file.write_text(f"<OpenDRIVE>{''.join(parts)}</OpenDRIVE>", encoding="utf-8")
    return file


QUIET = ("map.vehicles=0", "map.pedestrians=0")


def test_a_drawn_route_of_more_than_200_m_is_driven_to_its_end(tmp_path):
    file = straight_road(tmp_path)
    made = load_scenario(file, 3, (*QUIET, "map.route.from=1:10", "map.route.length_m=320"))
    driven_m = float(np.linalg.norm(np.diff(made.ego_log.xyz, axis=0), axis=1).sum())
    assert driven_m == pytest.approx(320.0, abs=5.0)
    with pytest.raises(InputError, match="no route of 4000 m"):
        load_scenario(file, 3, (*QUIET, "map.route.length_m=4000"))


def test_lengths_and_places_of_a_route_are_options_of_the_command(tmp_path, capsys):
    command = ["--renderer", "clean", "--dry-run", str(straight_road(tmp_path))]
    assert run_command([*command, "--route-length", "220"]) == 0
    assert run_command([*command, "--from", "1:10", "--via", "2:20", "--to", "2:60"]) == 0
    assert run_command([*command, "--from", "1:10", "--via", "9:1", "--to", "2:60"]) == 2
    assert "9:1" in capsys.readouterr().err
    assert run_command([*command, "--from", "1:10", "--via", "2:60", "--to", "2:20"]) == 2
    assert "through 2:60" in capsys.readouterr().err
    assert run_command([*command, "--to", "2:100", "--route-length", "220"]) == 2
    assert "length_m" in capsys.readouterr().err
