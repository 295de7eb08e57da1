"""Scripted tracks: speeds, lane changes, walkers."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from alpasim_plugin.core.geometry import quat_from_yaw, se2, speeds, yaw_from_quat
from alpasim_plugin.core.types import Actor, Box, EgoState, Trajectory, Vehicle
from alpasim_plugin.world.path import polyline_path
from alpasim_plugin.world.walkers import MARGIN_M, Walker
from scenarios.ego_path import driven_m, grid, standing_track, track_on_path, walk_track
from scenarios.load import load_scenario

BOX = Box(4.0, 1.8, 1.5)


def straight(y):
    return polyline_path(
        np.column_stack([np.linspace(0, 150, 151), np.full(151, y), np.zeros(151)])
    )


def test_hard_brake_stops_after_the_physical_distance():
    s = driven_m(grid(8_000_000), [(2.0, 12.0), (4.0, 0.0)], 10.0)
    assert s[-1] == pytest.approx(10 + 12 * 2 + 12**2 / (2 * 6), abs=1e-9)
    assert s[-1] == s[-20]


def test_cut_in_starts_and_ends_in_the_middle_of_its_lanes_without_a_jolt(tmp_path):
    (tmp_path / "a.yaml").write_text(
        "version: 1\nroad: {lanes_forward: 2, segments: [{kind: straight, length_m: 200}]}\n"
        "actors: [{kind: cut_in, id: a, from_lane: 1, to_lane: 0, s_m: 30, speed_mps: 12, at_us: 1000000}]\n"
    )
    (actor,) = load_scenario(tmp_path / "a.yaml").actors
    t = actor.track.t_us
    y = actor.track.xyz[:, 1]
    assert_allclose(y[t <= 1_000_000], -5.25, atol=1e-9)
    assert_allclose(y[t >= 3_500_000], -1.75, atol=1e-9)
    assert (np.diff(y) >= -1e-9).all()
    lateral_accel = np.gradient(np.gradient(y[:-1], 0.05), 0.05)
    # Peak of the quintic: 10 / sqrt(3) * distance / duration^2.
    assert np.abs(lateral_accel).max() == pytest.approx(10 / np.sqrt(3) * 3.5 / 2.5**2, rel=0.03)
    heading = yaw_from_quat(actor.track.quat)
    v = np.gradient(actor.track.xyz[:, :2], axis=0)
    assert_allclose(heading[5:-5], np.arctan2(v[5:-5, 1], v[5:-5, 0]), atol=2e-3)


def test_track_is_cut_where_the_path_ends():
    t = grid(10_000_000)
    track = track_on_path(straight(0.0), t, driven_m(t, [(0.0, 20.0)], 100.0), BOX)
    assert track.xyz[-1, 0] <= 150.0
    assert track.t_us[-1] == 2_500_000
    assert (track.xyz[:, 2] == 0.75).all()


def test_walker_stands_walks_at_its_speed_and_stands_again():
    t = np.arange(0, 12_000_001, 10_000)
    track = walk_track(np.array([0.0, -5, 0]), np.array([0.0, 5, 0]), t, 2_000_000, 1.4, BOX)
    assert (track.xyz[t <= 2_000_000, 1] == -5.0).all()
    assert track.xyz[-1, 1] == pytest.approx(5.0)
    v = speeds(track)
    assert v.max() == pytest.approx(1.4, abs=1e-6)
    assert np.abs(np.gradient(v, 0.01)).max() < 1.4 / 0.4 + 0.1
    assert_allclose(yaw_from_quat(track.quat), np.pi / 2)
    assert track.xyz[:, 1].max() <= 5.0 + 1e-9


def test_standing_track_covers_the_whole_time():
    track = standing_track(np.array([1.0, 2.0, 0.5]), 0.3, grid(5_000_000), BOX)
    assert track.t_us.tolist() == [0, 5_000_000]
    assert track.xyz[0].tolist() == [1.0, 2.0, 1.25]


@pytest.mark.parametrize(("side", "before_ego_s"), [("right", 0.0), ("left", 1.5)])
def test_a_pedestrian_reaches_the_middle_of_the_egos_line_before_the_egos_front(
    tmp_path, side, before_ego_s
):
    scene = (
        "version: 1\nroad: {lanes_forward: 2, segments: [{kind: straight, length_m: 300}]}\n"
        "ego: {lane: 0, start_m: 10, speed_mps: 8, cruise_mps: 8}\n"
        "timing: {duration_us: 12000000}\n"
    )
    crossing = f"{{kind: crossing_pedestrian, id: p, s_m: 60, side: {side}, before_ego_s: %s}}"
    (tmp_path / "empty.yaml").write_text(scene)
    (tmp_path / "a.yaml").write_text(f"{scene}actors: [{crossing % before_ego_s}]\n")
    log = load_scenario(tmp_path / "empty.yaml").ego_log  # undisturbed
    scenario = load_scenario(tmp_path / "a.yaml")
    vehicle = scenario.vehicle
    front_m = log.xyz[:, 0] + vehicle.rear_axle_to_centre_m + vehicle.box.length_m / 2
    (walker,) = scenario.actors
    track = walker.track
    arrival_us = np.interp(track.xyz[0, 0], front_m, log.t_us)
    aside_m = track.xyz[:, 1] - log.xyz[0, 1]
    rising = 1.0 if side == "right" else -1.0
    middle_us = np.interp(0.0, rising * aside_m, track.t_us)
    # The walk begins and ends gently: it loses some tenths of a second to a walk at full speed.
    assert middle_us * 1e-6 == pytest.approx(arrival_us * 1e-6 - before_ego_s, abs=0.25)


@pytest.mark.parametrize("yaw", np.radians([175.0, -60.0]))
def test_a_walker_waits_for_a_body_that_reaches_from_its_centre_to_both_ends(yaw):
    vehicle = Vehicle()
    ego = EgoState(0, se2(30.0, -20.0, yaw), 0.0)
    half_m = vehicle.box.length_m / 2 + 0.3 + MARGIN_M
    ends = [vehicle.rear_axle_to_centre_m + sign * half_m for sign in (-1.0, 1.0)]
    for at_m, waits in (
        (ends[0] - 0.1, False),
        (ends[0] + 0.1, True),
        (ends[1] - 0.1, True),
        (ends[1] + 0.1, False),
    ):
        # Across the ego's way, from 5 m on its left to 5 m on its right, at 5 m/s.
        across_m = np.linspace(5.0, -5.0, 21)
        in_rig = np.column_stack([np.full(21, at_m), across_m, np.zeros(21), np.ones(21)])
        xyz = (in_rig @ ego.T_world_rig.T)[:, :3]
        track = Trajectory(
            np.arange(21) * 100_000, xyz, quat_from_yaw(np.full(21, yaw - np.pi / 2))
        )
        walker = Walker(Actor("p", "person", Box(0.6, 0.6, 1.8), track))
        walker.step(0, 100_000, ego, vehicle)
        assert (walker.rate < 1.0) == waits
        assert walker.lag_us == pytest.approx(10_000 if waits else 0)
