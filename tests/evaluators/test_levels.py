"""Road users on a bridge above the ego, or on a road below it, are not near it."""

import numpy as np
import pytest
import shapely

from alpasim_plugin.core.types import Box, Lane
from evaluators import PRESETS
from evaluators.metrics.collision import contact_events
from evaluators.metrics.surface import Surface
from tests.evaluators.eval_build import (
    CAR,
    VEHICLE,
    car,
    lane,
    road_map,
    rollout,
    scored,
    track,
)
from tests.evaluators.motions import CRUISE, N

TRUCK = Box(8.5, 2.5, 3.4)
FLAT = ("alpasim", "alpasim@6f1029c")


def beside(z, box=CAR, ego_z=0.0):
    """A drive over a place on whose level, or not, somebody stands."""
    stands = car("stands", track(np.full(N, 40.0), 0.0, z=z), box)
    return rollout(track(CRUISE, 0.0, z=ego_z), [stands])


def touched(log, preset="strict"):
    return bool(scored(log, preset=preset)["collision_any"].value.any())


@pytest.mark.parametrize("preset", ["strict", "paper", *FLAT])
def test_a_car_on_a_bridge_is_not_touched_but_by_presets_without_heights(preset):
    assert PRESETS[preset].levels == (preset not in FLAT)
    for z in (7.0, 4.0, -4.0):  # two roads may be 4 m apart
        assert touched(beside(z), preset) == (preset in FLAT)
    for z in (0.0, 1.0):
        assert touched(beside(z), preset)


def test_heights_of_both_count_and_the_world_may_be_high_up():
    assert touched(beside(2.4, TRUCK))
    assert not touched(beside(4.0, TRUCK))
    assert touched(beside(640.0, ego_z=640.0))
    assert not touched(beside(647.0, ego_z=640.0))
    assert not touched(beside(0.0, ego_z=640.0))


def test_who_is_above_has_no_gap_no_time_to_collision_and_no_safe_distance():
    above = scored(beside(7.0))
    alone = scored(rollout(track(CRUISE, 0.0)))
    level = scored(beside(0.0))
    for name in ("min_distance_to_obstacle_m", "time_to_collision_s"):
        assert not np.array_equal(level[name].value, alone[name].value)
        assert np.array_equal(above[name].value, alone[name].value, equal_nan=True)
        assert np.array_equal(above[name].valid, alone[name].valid)
    assert contact_events(beside(7.0)) == ()
    assert len(contact_events(beside(0.0))) == 1


@pytest.mark.parametrize("name", ["nuplan", "navsim"])
def test_no_benchmark_blames_the_ego_for_a_car_above(name):
    above = scored(beside(7.0), preset=name)
    level = scored(beside(0.0), preset=name)
    alone = scored(rollout(track(CRUISE, 0.0)), preset=name)
    differing = {
        key
        for key in level
        if not np.array_equal(level[key].value, alone[key].value, equal_nan=True)
    }
    assert differing
    for key in differing:
        assert np.array_equal(above[key].value, alone[key].value, equal_nan=True)


def test_who_passes_over_the_ego_between_two_steps_does_not_touch_it():
    t = np.arange(N) * 0.1
    for z, touches in ((0.0, True), (6.0, False)):
        poses = track(40.0, 60.0 * (t - 4.75), yaw=np.pi / 2, z=z)
        crossing = car("crosses", poses, Box(1.5, 1.8, 1.5))
        assert touched(rollout(track(CRUISE, 0.0), [crossing])) == touches


def test_a_car_up_the_hill_is_ahead_and_a_ramp_leads_onto_the_ego_s_level():
    uphill = 0.1 * (CRUISE - CRUISE[0])  # 10 % from the start on
    far = 0.1 * (40.0 - CRUISE[0])
    stands = car("stands", track(np.full(N, 40.0), 0.0, z=far))
    hill = scored(rollout(track(CRUISE, 0.0, z=uphill), [stands]))
    flat = scored(beside(0.0))
    ahead = flat["time_to_collision_s"].value < 2.5
    assert ahead.any()
    assert hill["time_to_collision_s"].value[ahead] == pytest.approx(
        flat["time_to_collision_s"].value[ahead], abs=0.05
    )
    down = np.interp(np.arange(N), [0, N // 2], [7.0, 0.0])
    onto = car("merges", track(np.full(N, 40.0), 0.0, z=down))
    assert touched(rollout(track(CRUISE, 0.0), [onto]))


def stacked_map(above_m):
    """A road along x, and a wider one above it, driven the other way, with a limit of its own."""
    below = lane("below", 0.0, speed_limit_mps=20.0)
    centre = np.array([[200.0, 2.0, above_m], [-50.0, 2.0, above_m]])
    side = np.array([0.0, 6.0, 0.0])
    above = Lane("above", centre, centre - side, centre + side, speed_limit_mps=5.0)
    edges = [np.array([[-50.0, y, 0.0], [200.0, y, 0.0]]) for y in (-1.75, 1.75)]
    return road_map(below, above, edges=edges)


@pytest.mark.parametrize("above_m", [7.0, 4.0, 3.0])  # 3 m: decks of a car park
def test_the_road_above_is_neither_the_surface_nor_a_lane_of_the_ego(above_m):
    log = rollout(track(CRUISE, 1.5, z=VEHICLE.box.height_m / 2))
    alone = scored(log, road_map(stacked_map(above_m).lanes["below"]))
    under = scored(log, stacked_map(above_m))
    assert alone["offroad"].value.all()
    for name in ("offroad", "offroad_margin_m", "wrong_lane", "min_distance_to_lane_boundary_m"):
        assert np.array_equal(under[name].value, alone[name].value), name


@pytest.mark.parametrize("above_m", [7.0, 4.0, 3.0])
def test_on_the_upper_road_its_own_border_counts(above_m):
    yaw = np.full(N, np.pi)
    poses = track(150.0 - CRUISE, 6.0, yaw=yaw, z=above_m + VEHICLE.box.height_m / 2)
    values = scored(rollout(poses), stacked_map(above_m))
    half_m = VEHICLE.box.width_m / 2
    assert values["offroad_margin_m"].value == pytest.approx(np.full(N, 2.0 - half_m), abs=1e-6)
    assert not values["wrong_lane"].value.any()


@pytest.mark.parametrize("name", ["nuplan", "navsim"])
@pytest.mark.parametrize("above_m", [7.0, 4.0, 3.0])
def test_no_benchmark_takes_the_road_above_for_that_of_the_ego(name, above_m):
    both = stacked_map(above_m)
    below = road_map(both.lanes["below"], edges=both.road_edges)
    for y in (0.0, 3.0):
        log = rollout(track(CRUISE, y, z=VEHICLE.box.height_m / 2))
        alone = scored(log, below, preset=name)
        under = scored(log, both, preset=name)
        for key, series in alone.items():
            assert np.array_equal(under[key].value, series.value, equal_nan=True), key


def test_a_ramp_is_one_surface_with_the_road_at_its_foot_and_not_above_it():
    x = np.linspace(-50.0, 200.0, 251)
    height = 6.0 * np.clip((x - 20.0) / 60.0, 0.0, 1.0)
    lines = [np.column_stack([x, 0 * x + y, height]) for y in (3.5, 5.25, 1.75)]
    lanes = road_map(lane("road", 0.0), Lane("ramp", *lines))

    def margins(y, z):
        log = rollout(track(CRUISE, y, z=z + VEHICLE.box.height_m / 2))
        return scored(log, lanes)["offroad_margin_m"].value

    half_m = VEHICLE.box.width_m / 2
    between = margins(1.75, 0.0)
    assert between[CRUISE < 20.0] == pytest.approx(3.5 - half_m, abs=1e-6)
    assert between[CRUISE > 60.0] == pytest.approx(-half_m, abs=1e-6)
    on_ramp = margins(3.5, np.interp(CRUISE, x, height))
    assert on_ramp[CRUISE > 60.0] == pytest.approx(1.75 - half_m, abs=1e-6)


def test_presets_that_look_from_above_take_the_road_above_for_the_ego_s_own():
    log = rollout(track(CRUISE, 3.0, z=VEHICLE.box.height_m / 2))
    for preset in ("paper", *FLAT):
        assert PRESETS[preset].lane_height_m is None
        assert not scored(log, stacked_map(3.0), preset)["offroad"].value.any()
    for preset in ("strict", "nuplan", "navsim"):
        assert PRESETS[preset].lane_height_m == 2.0


def test_a_wide_area_on_a_slope_is_not_stacked_on_its_lane():
    """A square of 100 by 50 m that rises by 10 % across, and a lane in its middle."""
    corners = np.array([[0, -25], [100, -25], [100, 25], [0, 25], [0, -25]], dtype=np.float64)
    ring = np.column_stack([corners, 0.1 * corners[:, 1]])
    centre = np.array([[0.0, 0, 0], [100.0, 0, 0]])
    areas = np.array([shapely.box(0, -1.75, 100, 1.75), shapely.Polygon(corners)])
    square = Surface(areas, [centre, ring], 0.5, 2.0)
    assert square.on_level(np.array([[50.0, 1.5, 0.15], [50.0, 20.0, 2.0]])).all(axis=0)[1]
    assert square.on_level(np.array([[50.0, 1.5, 0.15]])).all()


@pytest.mark.parametrize("pitch_m", [2.5, 3.0, 4.0])
def test_a_lane_that_winds_above_itself_is_on_the_level_of_both_turns(pitch_m):
    angle = np.linspace(0, 4 * np.pi, 200)
    line = np.column_stack([15 * np.cos(angle), 15 * np.sin(angle), pitch_m * angle / (2 * np.pi)])
    area = shapely.buffer(shapely.linestrings(line[:, :2]), 2.0)
    ramp = Surface(np.array([area]), [line], 0.5, 2.0)
    assert ramp.on_level(line + np.array([0.3, 0.0, 0.1])).all()
    assert not ramp.on_level(line[[20]] + [0, 0, 2 * pitch_m + 2.0]).any()
