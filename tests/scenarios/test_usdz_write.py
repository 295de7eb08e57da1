"""Scenarios written as AlpaSim scenes: what is read back is what AlpaSim's loader would see, for
every source.
"""

import io
import itertools
import json
import zipfile
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import Actor, Box, Lane, LaneMap, Trajectory
from scenarios.ftheta import pixel_to_angle
from scenarios.load import load_scenario
from scenarios.map_lines import alpasim_view, rails, with_vertices
from scenarios.usdz import read_usdz
from scenarios.usdz_write import alpasim_cameras, frame_times, write_usdz

TABLES = ("lane", "association", "road_boundary", "clip", "traffic_sign", "wait_line")


@pytest.fixture(scope="module")
def straight():
    return load_scenario("smoke/straight")


@pytest.fixture(scope="module", params=["smoke/lead_car", "real/us101"])
def written(request, tmp_path_factory):
    scenario = load_scenario(request.param)
    path = tmp_path_factory.mktemp("scenes") / "scene.usdz"
    write_usdz(path, scenario)
    return scenario, path


def table(path, name):
    with zipfile.ZipFile(path) as archive:
        return pq.read_table(io.BytesIO(archive.read(f"clipgt/{name}.parquet"))).to_pylist()


def test_what_is_read_back_is_the_map_that_preset_alpasim_scores(
    written,
):
    scenario, path = written
    read = read_usdz(path)
    view = scenario.alpasim_map
    ids = {key: key.replace("-", "~") for key in view.lanes}
    assert list(read.lane_map.lanes) == [ids[key] for key in view.lanes]
    for key, lane in view.lanes.items():
        other = read.lane_map.lanes[ids[key]]
        for name in ("centre", "left", "right"):
            assert_array_equal(getattr(other, name), getattr(lane, name))  # unrounded
        assert other.successors == tuple(ids[s] for s in lane.successors)
        assert other.left_neighbour == ids.get(lane.left_neighbour or "")
    assert len(read.lane_map.road_edges) == len(view.road_edges)
    for one, edge in zip(read.lane_map.road_edges, view.road_edges, strict=True):
        assert_array_equal(one, edge)
    assert read.lane_map.signs == ()  # a row stands in for none, and is no sign
    assert len(read.lane_map.stop_lines) == len(scenario.lane_map.stop_lines)


def test_drive_traffic_and_vehicle_come_back(written):
    scenario, path = written
    read = read_usdz(path)
    assert (read.scene_id, read.vehicle.box) == (scenario.scene_id, scenario.vehicle.box)
    assert read.vehicle.rear_axle_to_centre_m == pytest.approx(
        scenario.vehicle.rear_axle_to_centre_m, abs=1e-6
    )
    assert_array_equal(read.ego_log.t_us, scenario.ego_log.t_us)
    assert_array_equal(read.ego_log.xyz, scenario.ego_log.xyz)
    assert read.first_frame_us == scenario.start_us
    assert [(a.actor_id, a.label, a.box, a.is_static) for a in read.actors] == [
        (a.actor_id, a.label, a.box, a.is_static) for a in scenario.actors
    ]
    for one, other in zip(read.actors, scenario.actors, strict=True):
        assert_array_equal(one.track.xyz, other.track.xyz)
        assert_allclose(np.abs(np.sum(one.track.quat * other.track.quat, axis=1)), 1.0, atol=1e-12)


def test_no_table_is_empty_and_links_go_both_ways(written):
    _, path = written
    rows = {name: table(path, name) for name in TABLES}
    assert all(rows.values())
    lanes = {row["key"]["map_id"] for row in rows["lane"]}
    clip = rows["clip"][0]["key"]["clip_id"]
    assert all(row["key"]["clip_id"] == clip for name in TABLES for row in rows[name])
    links = {
        (r["key"]["kind"], r["association"]["subjects"], o)
        for r in rows["association"]
        for o in r["association"]["objects"]
    }
    forward = {(a, b) for kind, a, b in links if kind == "NEXT_LANE"}
    assert forward == {(b, a) for kind, a, b in links if kind == "PREVIOUS_LANE"}
    assert {end for pair in forward for end in pair} <= lanes
    for row in rows["wait_line"]:
        parts = row["key"]["map_id"].split("-")
        assert len(parts) == 2
        assert parts[1] in lanes
    assert all(len(r["lane"]["left_rail"]) == len(r["lane"]["right_rail"]) for r in rows["lane"])


def test_a_lane_with_unequal_edges_keeps_its_area():
    t = np.linspace(0, np.pi / 2, 40)
    left = np.column_stack([20 * np.cos(t), 20 * np.sin(t), 0.01 * t])
    right = np.column_stack([24 * np.cos(t), 24 * np.sin(t), 0.01 * t])[[0, 3, 9, 10, 25, 39]]
    lane = Lane("a-1", (left[::13] + left[::13]) / 2, left, right)
    view = alpasim_view(
        LaneMap({"a-1": lane, "walk": replace(lane, lane_id="walk", kind="sidewalk")})
    )
    assert list(view.lanes) == ["a-1"]
    one, other = rails(lane)
    assert len(one) == len(other) >= 40
    before = lane_polygon(lane)
    after = lane_polygon(view.lanes["a-1"])
    assert shapely.symmetric_difference(before, after).area < 1e-9 * before.area
    assert np.linalg.norm(np.diff(view.lanes["a-1"].centre, axis=0), axis=1).max() <= 2.0


def test_a_shoulder_is_a_lane_and_a_single_pose_lasts(straight, tmp_path):
    first = next(iter(straight.lane_map.lanes.values()))
    shoulder = replace(
        first,
        lane_id="shoulder",
        kind="shoulder",
        successors=(),
        left_neighbour=None,
        right_neighbour=None,
    )
    pose = Trajectory(np.array([100_000]), np.array([[5.0, 1.0, 0.8]]), np.array([[1.0, 0, 0, 0]]))
    cone = Actor("cone", "other", Box(0.4, 0.4, 0.8), pose, is_static=True)
    scenario = replace(
        straight,
        lane_map=LaneMap({**straight.lane_map.lanes, "shoulder": shoulder}),
        actors=(cone,),
    )
    write_usdz(tmp_path / "s.usdz", scenario)
    read = read_usdz(tmp_path / "s.usdz")
    assert "shoulder" in read.lane_map.lanes
    assert read.lane_map.road_edges == ()  # an empty table of borders, as AlpaSim accepts it
    (actor,) = read.actors
    assert actor.is_static
    assert actor.track.t_us.tolist() == [
        int(scenario.ego_log.t_us[0]),
        int(scenario.ego_log.t_us[-1]),
    ]


def test_the_main_camera_is_called_as_alpasim_expects_and_its_lens_is_the_pinhole(
    straight, tmp_path
):
    (camera,) = straight.cameras
    assert list(alpasim_cameras((replace(camera, name="left"), camera))) == [
        "left",
        "camera_front_wide_120fov",
    ]
    assert list(alpasim_cameras((replace(camera, name="left"),))) == ["camera_front_wide_120fov"]
    radius = np.linspace(0, np.hypot(camera.width, camera.height) / 2, 50)
    angle = np.polynomial.polynomial.polyval(radius, pixel_to_angle(camera))
    focal = float(camera.K[0, 0])
    assert np.abs(focal * np.tan(angle) - radius).max() < 0.05  # pixels
    write_usdz(tmp_path / "s.usdz", straight)
    (read,) = read_usdz(tmp_path / "s.usdz").cameras
    assert_allclose(read.T_rig_camera, camera.T_rig_camera, atol=1e-9)
    with zipfile.ZipFile(tmp_path / "s.usdz") as archive:
        (rig,) = json.loads(archive.read("rig_trajectories.json"))["rig_trajectories"]
        mesh = archive.read("mesh_ground.ply")
    frames = rig["cameras_frame_timestamps_us"]["camera_front_wide_120fov@0"]
    assert frames[0] == [straight.start_us - 30_000, straight.start_us]
    assert all(end - start == 30_000 for start, end in frames)
    assert mesh.startswith(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
    )  # level ground: two triangles


def test_a_scene_that_alpasim_cannot_drive_is_refused(straight, tmp_path):
    with pytest.raises(InputError, match="no lane"):
        write_usdz(tmp_path / "s.usdz", replace(straight, lane_map=LaneMap({})))
    assert not (tmp_path / "s.usdz").exists()


def test_vertices_are_put_in_and_rounded_as_alpasims_loader_does():
    line = np.random.default_rng(3).uniform(-40, 40, (60, 3))
    line[6], line[7] = [1.0, 2.0, 3.0], [1.0, 4.0, 3.0]  # exactly 2 m: split as well
    line[9] = line[8] + [1e-3, 0.0, 0.0]  # shorter: left alone
    want = [line[0]]
    for a, b in itertools.pairwise(line):
        inner = int(np.linalg.norm(b - a) // 2.0)
        want += [a + (b - a) / (inner + 1) * k for k in range(1, inner + 1)] + [b]
    assert_array_equal(
        with_vertices(line), want
    )  # to the bit: it decides whether a union of lanes has cracks


def test_the_time_line_of_alpasim_starts_at_the_first_frame_and_an_offset_later(straight, tmp_path):
    path = tmp_path / "scene.usdz"
    write_usdz(path, straight)
    alpasim = ["timing.timeline=alpasim"]
    plain = load_scenario(path, overrides=alpasim)
    assert (plain.start_us, plain.warmup_us) == (straight.start_us, 1_700_000)
    later = load_scenario(path, overrides=[*alpasim, "timing.start_time_offset_us=1500000"])
    assert (later.start_us - plain.start_us, later.end_us) == (1_500_000, plain.end_us)
    built = [
        load_scenario("smoke/straight", overrides=[*alpasim, f"timing.start_time_offset_us={us}"])
        for us in (0, 700_000)
    ]
    assert built[1].start_us - built[0].start_us == 700_000
    with pytest.raises(InputError, match="timeline: alpasim"):
        load_scenario("smoke/straight", overrides=["timing.start_time_offset_us=700000"])


def test_a_lane_without_edges_is_widened():
    centre = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]])
    left, right = rails(Lane("a", centre, None, None))
    assert_allclose(left[:, 1], 1.85)
    assert_allclose(right[:, 1], -1.85)


def test_a_camera_of_its_own_rate_is_asked_for_frames_at_that_rate(straight):
    slow = replace(straight.cameras[0], interval_us=3 * straight.rates.camera_us)
    ends = [end for _, end in frame_times(straight, slow)]
    assert set(np.diff(ends)) == {3 * straight.rates.camera_us}
