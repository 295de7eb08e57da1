"""Borders of drivable surfaces: on each level their own."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from alpasim_plugin.core.lane_areas import lane_polygon
from scenarios.map_borders import border_lines, lane_borders, lane_edges, merge_areas
from tests.world.stacked_roads import HALF_M, lane_along, lanes_of, straight


def near(edges, xy, z, radius_m=0.5):
    """Whether an edge passes near a place at a height."""
    for edge in edges:
        line = shapely.linestrings(edge)
        place = shapely.line_interpolate_point(
            line, shapely.line_locate_point(line, shapely.points(xy))
        )
        away_m = shapely.distance(shapely.points(xy), place)
        if away_m < radius_m and abs(shapely.get_z(place) - z) < 0.5:
            return True
    return False


@pytest.mark.parametrize("above_m", [7.0, 4.0, 2.6])
@pytest.mark.parametrize("base_m", [0.0, 640.0])
def test_a_road_and_a_bridge_over_it_have_borders_of_their_own(above_m, base_m):
    road = straight("road", (-50, 0, base_m), (50, 0, base_m))
    bridge = straight("bridge", (0, -50, base_m + above_m), (0, 50, base_m + above_m))
    edges = lane_borders(lanes_of(road, bridge))
    assert len(edges) == 2
    for side in (-HALF_M, HALF_M):  # each goes on where the other crosses
        for t in np.linspace(-40.0, 40.0, 81):
            assert near(edges, (t, side), base_m)
            assert near(edges, (side, t), base_m + above_m)
    assert sorted(float(np.ptp(edge[:, 2])) for edge in edges) == pytest.approx([0.0, 0.0])


def test_each_deck_of_a_car_park_has_borders():
    decks = [straight(f"deck {k}", (0, 0, 3.0 * k), (60, 0, 3.0 * k)) for k in range(3)]
    edges = lane_borders(lanes_of(*decks))
    assert sorted(float(edge[:, 2].mean()) for edge in edges) == pytest.approx([0.0, 3.0, 6.0])
    assert all(shapely.Polygon(edge[:, :2]).area == pytest.approx(210.0) for edge in edges)


def ramp_onto_bridge():
    """A road, a bridge that crosses over it, and a ramp that climbs from the road to the bridge."""
    x = np.linspace(0.0, 100.0, 101)
    road = np.column_stack([x, 0 * x, 0 * x])
    ramp = np.column_stack([x, 3.5 + 0 * x, 6.0 * np.clip((x - 10.0) / 80.0, 0.0, 1.0)])
    bridge = np.column_stack([98.25 + 0 * x, x - 50.0, 0 * x + 6.0])
    lines = {"road": road, "ramp": ramp, "bridge": bridge}
    return lanes_of(*(lane_along(name, line) for name, line in lines.items()))


def test_a_ramp_is_open_to_the_road_at_its_foot_and_to_the_bridge_at_its_head():
    edges = lane_borders(ramp_onto_bridge())
    assert not near(edges, (5.0, HALF_M), 0.0)  # beside one another, at one height
    assert near(edges, (70.0, HALF_M), 0.0)  # the road's edge below the ramp ...
    assert near(edges, (70.0, HALF_M), 4.5)  # ... and the ramp's above it
    assert near(edges, (90.0, -HALF_M), 0.0)
    assert not near(edges, (96.5, 3.5), 6.0)  # from the ramp onto the bridge
    assert near(edges, (96.5, -20.0), 6.0)
    assert near(edges, (96.5, 0.0), 6.0)  # the bridge's edge over the road


def test_a_ramp_that_winds_above_itself_has_edges_on_each_turn():
    turn = np.linspace(0.0, 4 * np.pi, 400)
    line = np.column_stack([10 * np.cos(turn), 10 * np.sin(turn), 3.0 * turn / (2 * np.pi)])
    edges = lane_borders(lanes_of(lane_along("helix", line)))
    for angle in np.linspace(0.3, 4 * np.pi - 0.3, 60):
        z = 3.0 * angle / (2 * np.pi)
        for radius_m in (10.0 - HALF_M, 10.0 + HALF_M):
            assert near(edges, (radius_m * np.cos(angle), radius_m * np.sin(angle)), z)
        assert not near(edges, (10.0 * np.cos(angle), 10.0 * np.sin(angle)), z)


def test_hills_without_levels_keep_the_border_of_the_union():
    lanes = lanes_of(
        *(straight(f"lane {k}", (0, 3.5 * k, 0.05), (200, 3.5 * k, 24.0)) for k in range(3))
    )
    shapes = [lane_polygon(lane) for lane in lanes.values()]
    union = border_lines(merge_areas(shapes), np.concatenate(lane_edges(lanes)))
    for edge, plain in zip(lane_borders(lanes), union, strict=True):
        assert np.array_equal(edge, plain)


def test_lanes_without_edges_have_levels_too():
    lanes = {
        name: replace(lane, left=None, right=None)
        for name, lane in lanes_of(
            straight("road", (-50, 0, 0), (50, 0, 0)), straight("bridge", (0, -50, 7), (0, 50, 7))
        ).items()
    }
    assert len(lane_borders(lanes)) == 2
