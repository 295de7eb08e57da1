"""The parts of the camera policy, each against something simpler: grid, ridges, lane filter,
obstacles.
"""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.geometry import inverse
from policies.lane_filter import predict, search, start, update
from policies.obstacle_vision import anomaly, find_foot, learn_road, track_obstacle
from policies.painted_road import Line, PaintedRoad, pinhole_camera
from policies.road_vision import (
    PaintPoints,
    RidgeFilter,
    find_paint,
    make_grid,
)
from tests.examples import examples
from tests.policies.busy_road import Block, BusyRoad

CAMERA = pinhole_camera()
GRID = make_grid(CAMERA)
RIDGES = RidgeFilter(GRID)


# --- grid


@pytest.mark.parametrize(
    "camera",
    [CAMERA, pinhole_camera(pitch_deg=8.0), pinhole_camera(mount_m=(2.2, -0.3, 1.2), hfov_deg=100)],
)
def test_every_grid_cell_falls_where_a_plain_projection_puts_it(camera):
    grid = make_grid(camera)  # type: ignore[arg-type]
    K, T = camera.K, inverse(camera.T_rig_camera)  # type: ignore[attr-defined]
    for row in (0, len(grid.x_m) // 2, len(grid.x_m) - 1):
        for column in (0, 160, 319):
            x, y, z = (T @ [grid.x_m[row], grid.y_m[column], 0.0, 1.0])[:3]
            u = K[0, 0] * x / z + K[0, 2] - 0.5
            v = K[1, 1] * y / z + K[1, 2] - 0.5
            assert grid.map_u[row, column] == pytest.approx(u, abs=1e-2)
            assert grid.map_v[row, column] == pytest.approx(v, abs=1e-2)


# --- ridges


def test_step_edge_is_no_paint_but_a_stroke_is():
    value = np.full(GRID.inside.shape, 90, dtype=np.uint8)
    value[:, 200:] = 180
    assert RIDGES.response(value)[:, 150:250].max() == 0.0
    value[:] = 90
    value[:, 159:162] = 200
    assert RIDGES.response(value)[5:30, 160].min() > 60.0


def test_bars_of_a_crosswalk_are_not_taken_for_lines():
    ground = np.full((*GRID.inside.shape, 3), 90, dtype=np.uint8)
    for y in (1.75, -1.75):
        c = round(float(GRID.column_of(np.array(y))))
        ground[:, c - 1 : c + 2] = 220
    plain, none = find_paint(ground, GRID, RIDGES)
    rows = (GRID.x_m > 9.0) & (GRID.x_m < 12.0)
    for y in np.arange(-4.0, 4.0, 1.0):
        c = round(float(GRID.column_of(np.array(y))))
        ground[np.ix_(rows, range(c - 5, c + 5))] = 220
    with_bars, crosswalk = find_paint(ground, GRID, RIDGES)
    inside = (with_bars.x_m > 9.1) & (with_bars.x_m < 11.9)
    assert len(plain.x_m) > 60
    assert not none.any()
    assert crosswalk[np.ix_(np.flatnonzero(rows)[1:-1], range(120, 200))].mean() > 0.6
    assert inside.sum() <= 2
    assert (~inside).sum() > 0.8 * np.sum((plain.x_m < 9.1) | (plain.x_m > 11.9))


# --- lane filter


def paint_of(
    offset,
    heading,
    curvature,
    width,
    sides=(-1, 1),
):
    random = np.random.default_rng(0)
    x = np.repeat(np.arange(6.0, 30.0, 1.0), len(sides))
    side = np.tile(sides, len(x) // len(sides))
    slope = heading + curvature * x
    y = (
        offset
        + heading * x
        + curvature * x**2 / 2
        + side * width / 2 * np.sqrt(1 + slope**2)
        + random.normal(0, 0.04, len(x))
    )
    return PaintPoints(x, y, np.full(len(x), 3.0), np.full(len(x), 0.06))


def settled(points, lane):
    for _ in range(15):
        lane = update(predict(lane, 0.0, 0.0, 0.0), points, np.ones(len(points.x_m)))
    return lane


@settings(deadline=None, max_examples=examples(25))
@given(
    offset=st.floats(-0.6, 0.6),
    heading=st.floats(-0.08, 0.08),
    curvature=st.floats(-0.015, 0.015),
    width=st.floats(3.0, 4.0),
)
def test_lane_is_recovered_from_its_paint(offset, heading, curvature, width):
    points = paint_of(offset, heading, curvature, width)
    found = search(points, np.ones(48), 0.0, 0.0, 0.0)
    assert found is not None
    lane = settled(points, found)
    assert lane.mean[4] == pytest.approx(width, abs=0.12)
    x = np.array([6.0, 10.0, 18.0])  # where paint is; nearer and further it is extrapolated
    assert np.allclose(lane.centre(x), offset + heading * x + curvature * x**2 / 2, atol=0.12)


def test_prediction_sees_the_lane_that_a_moved_ego_would_see():
    """The same curve, drawn from a pose further along it."""
    road = PaintedRoad(curvature_1pm=1 / 80)
    before = road.pose(0.0, -0.3)
    after = road.pose(3.0, 0.1, 0.05)
    step = inverse(before) @ after
    lane = predict(
        start(0.3, 0.0, 1 / 80),
        float(step[0, 3]),
        float(step[1, 3]),
        float(np.arctan2(step[1, 0], step[0, 0])),
    )
    for ahead in (4.0, 9.0):
        x, y = (inverse(after) @ road.pose(3.0 + ahead))[:2, 3]
        assert lane.centre(np.array([x]))[0] == pytest.approx(y, abs=0.05)


# --- obstacles


def foot_in(road):
    centre = np.zeros(len(GRID.x_m))
    empty = cv2.cvtColor(
        GRID.warp(PaintedRoad().image(CAMERA, np.eye(4), seed=9)), cv2.COLOR_RGB2LAB
    )
    colour = learn_road(None, empty, GRID, centre, np.inf)
    assert colour is not None
    lab = cv2.cvtColor(GRID.warp(road.image(CAMERA, np.eye(4), 0)), cv2.COLOR_RGB2LAB)
    return find_foot(anomaly(lab, colour, GRID), GRID, centre, float(GRID.x_m[0]), 50.0)


@pytest.mark.parametrize("distance", [8.0, 12.0, 20.0, 30.0, 40.0])
@pytest.mark.parametrize("colour", [(150, 30, 30), (235, 235, 235), (25, 25, 30), (30, 60, 160)])
def test_foot_of_a_car_gives_its_distance(distance, colour):
    found = foot_in(BusyRoad(blocks=(Block(distance + 2.25, colour=colour),)))
    assert found[0] == pytest.approx(distance, abs=0.35 + 2.0 * found[1])
    assert found[1] < 0.15 * distance


def test_pedestrian_in_the_corridor_is_seen_and_beside_it_is_not():
    person = (0.4, 0.5, 1.75)
    assert foot_in(BusyRoad(blocks=(Block(15.0, 0.3, person, (40, 40, 90)),))) is not None
    assert foot_in(BusyRoad(blocks=(Block(15.0, 2.2, person, (40, 40, 90)),))) is None


def test_low_kerb_stone_is_not_taken_for_a_car():
    assert foot_in(BusyRoad(blocks=(Block(20.0, 0.0, (0.5, 1.8, 0.15), (200, 200, 200)),))) is None


def test_road_colour_is_not_learned_from_the_car_in_front():
    road = BusyRoad(lines=(Line(1.75), Line(-1.75)), blocks=(Block(9.0),))
    lab = cv2.cvtColor(GRID.warp(road.image(CAMERA, np.eye(4))), cv2.COLOR_RGB2LAB)
    centre = np.zeros(len(GRID.x_m))
    assert learn_road(None, lab, GRID, centre, free_to_m=6.5) is None


def test_closing_speed_is_learned_from_the_feet():
    track = None
    random = np.random.default_rng(0)
    for k in range(40):
        truth = 40.0 + (6.0 - 10.0) * k * 0.1
        track = track_obstacle(track, (truth + random.normal(0, 0.4), 0.5), 10.0, 0.1)
    assert track.confirmed
    assert track.distance_m == pytest.approx(40.0 - 4.0 * 3.9, abs=0.6)
    assert track.speed_mps == pytest.approx(6.0, abs=1.0)


def test_track_needs_three_sightings_and_ends_after_nine_misses():
    track = track_obstacle(None, (20.0, 0.5), 5.0, 0.1)
    assert not track.confirmed
    for k in range(5):
        track = track_obstacle(track, (20.0 - 0.5 * (k + 1), 0.5), 5.0, 0.1)
    assert track.confirmed
    for _ in range(8):
        track = track_obstacle(track, None, 0.0, 0.1)
        assert track is not None
    assert track_obstacle(track, None, 0.0, 0.1) is None
