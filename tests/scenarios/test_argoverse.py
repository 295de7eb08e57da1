"""Argoverse 2 logs made by hand: every part of a log arrives where it belongs."""

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.geometry import inverse, yaw_from_quat
from scenarios.argoverse import read_argoverse, read_calibration
from tests.scenarios.make_argoverse import (
    CAR,
    ORIGIN,
    STEP_NS,
    T0_NS,
    TRACKS,
    cuboids,
    lane,
    line,
    place,
    poses,
    vector_map,
    write_argoverse,
    write_feather,
)


@pytest.fixture
def log(tmp_path):
    return read_argoverse(write_argoverse(tmp_path / "x"))


def test_world_is_local_and_keeps_centimetres_of_utm_sized_coordinates(log):
    assert log.world_origin == tuple(ORIGIN)
    assert_allclose(
        log.ego_log.xyz, np.column_stack([np.arange(21.0), np.zeros(21), np.zeros(21)]), atol=2e-9
    )
    assert_allclose(log.lane_map.lanes["1"].left, [[-20, 2, 0], [40, 2, 0]], atol=2e-9)


def test_time_is_whole_microseconds(log):
    assert log.ego_log.t_us[0] == T0_NS // 1000
    assert log.ego_log.t_us.dtype == np.int64
    assert (np.diff(log.ego_log.t_us) == STEP_NS // 1000).all()


def test_cuboids_of_a_moving_ego_frame_stand_still_in_the_world(log):
    parked, walker = log.actors
    assert_allclose(parked.track.xyz, np.broadcast_to([30.0, -6.0, 0.75], (21, 3)), atol=1e-8)
    assert (parked.label, parked.is_static, parked.box.length_m) == ("car", True, 4.5)
    assert (walker.label, walker.is_static, len(walker.track)) == ("pedestrian", False, 11)
    assert walker.track.t_us[0] == (T0_NS + 5 * STEP_NS) // 1000
    assert_allclose(walker.track.xyz[[0, -1], 1], [-5, 5], atol=1e-8)


def test_track_with_a_hole_becomes_two_actors(tmp_path):
    frames = [0, 1, 2, 7, 8, 9, 15]
    rows = cuboids([("a", "TRUCK", (8.0, 2.5, 3.0), frames, place(30.0, 5.0, 1.5))])
    log = read_argoverse(write_argoverse(tmp_path / "x", annotations=rows))
    assert [(a.actor_id, len(a.track)) for a in log.actors] == [("a", 6), ("a~2", 1)]
    assert any("holes longer than 0.5 s" in note for note in log.notes)


def test_poses_that_share_a_microsecond_are_dropped_and_counted(tmp_path):
    ego = {k: np.insert(v, 1, v[0]) for k, v in poses().items()}
    ego["timestamp_ns"][1] += 2
    log = read_argoverse(write_argoverse(tmp_path / "x", ego=ego))
    assert len(log.ego_log) == 21
    assert "1 ego poses share their microsecond" in log.notes[0]


def test_map_layers_arrive(log):
    lanes = log.lane_map.lanes
    assert lanes["1"].successors == ("2", "999")
    assert [k.kind for k in lanes.values()] == ["vehicle", "vehicle", "bike"]
    assert (lanes["1"].left_mark_type, lanes["1"].right_mark_type) == (
        "dashed_white",
        "solid_white",
    )
    assert len(log.lane_map.crosswalks[0]) == 5
    assert shapely.Polygon(log.lane_map.crosswalks[0][:, :2]).area == pytest.approx(4 * 16)


def test_road_edge_runs_round_the_union_of_areas_and_not_through_its_seam(log):
    (edge,) = log.lane_map.road_edges
    inside = np.abs(edge[:, 1]) < 7.99
    assert set(np.round(edge[inside, 0]).tolist()) == {-20.0, 200.0}
    assert np.linalg.norm(np.diff(edge[:, :2], axis=0), axis=1).max() <= 2.0 + 1e-9
    assert_array_equal(edge[0], edge[-1])


def test_hole_in_the_drivable_area_is_an_edge_of_its_own(tmp_path):
    document = vector_map()
    document["drivable_areas"] = {
        str(i): {"id": i, "area_boundary": line(*corners)}
        for i, corners in enumerate(
            [
                [(-20, -8), (50, -8), (50, 8), (-20, 8)],
                [(60, -8), (200, -8), (200, 8), (60, 8)],
                [(50, -8), (60, -8), (60, -3), (50, -3)],
                [(50, 3), (60, 3), (60, 8), (50, 8)],
            ]
        )
    }
    edges = read_argoverse(write_argoverse(tmp_path / "x", document=document)).lane_map.road_edges
    assert len(edges) == 2
    assert shapely.Polygon(edges[1][:, :2]).area == pytest.approx(60.0)


def test_unknown_mark_type_and_category_are_noted(tmp_path):
    document = vector_map()
    document["lane_segments"]["1"]["left_lane_mark_type"] = "ZIGZAG"
    rows = cuboids([("a", "UNICORN", CAR, range(3), place(30.0, 5.0, 1.5))])
    log = read_argoverse(write_argoverse(tmp_path / "x", annotations=rows, document=document))
    assert log.lane_map.lanes["1"].left_mark_type == "unknown"
    assert log.actors[0].label == "other"
    assert "1 lane edges have the mark type 'ZIGZAG': taken as unknown lane markings" in log.notes
    assert "1 tracks of the unknown category 'UNICORN' are labelled 'other'" in log.notes


def test_opposite_neighbour_is_no_neighbour(tmp_path):
    document = vector_map()
    back = lane(4, 200, -20, -4, left_neighbor_id=1)
    back["left_lane_boundary"], back["right_lane_boundary"] = (
        line((200, -6), (-20, -6)),
        line((200, -2), (-20, -2)),
    )
    document["lane_segments"]["4"] = back
    document["lane_segments"]["1"] |= {"right_neighbor_id": 4, "left_neighbor_id": 3}
    lanes = read_argoverse(write_argoverse(tmp_path / "x", document=document)).lane_map.lanes
    assert (lanes["1"].left_neighbour, lanes["1"].right_neighbour, lanes["4"].left_neighbour) == (
        "3",
        None,
        None,
    )


def test_cuboids_turn_with_the_ego(tmp_path):
    ego = poses()
    half = np.radians(90) / 2
    ego["qw"][:], ego["qz"][:] = np.cos(half), np.sin(half)
    rows = cuboids([("a", "BUS", (12.0, 2.5, 3.0), [3], place(0.0, 0.0, 1.5))], ego)
    rows["tx_m"], rows["ty_m"], rows["tz_m"] = [7.0], [2.0], [1.0]
    actor = read_argoverse(write_argoverse(tmp_path / "x", ego=ego, annotations=rows)).actors[0]
    assert_allclose(actor.track.xyz[0], [3.0 - 2.0, 7.0, 1.33], atol=1e-8)
    assert yaw_from_quat(actor.track.quat[0]) == pytest.approx(np.pi / 2)


def test_a_camera_of_a_log_sees_a_point_where_its_files_say(tmp_path):
    """The files count pixels from the middle of the first one, and heights from the rear axle."""
    inner = {"sensor_name": ["left"], "fx_px": [400.0], "fy_px": [300.0], "k1": [0.0]}
    inner |= {"k2": [0.0], "k3": [0.0], "cx_px": [99.5], "cy_px": [49.5]}
    inner |= {"width_px": [200.0], "height_px": [100.0]}
    half = np.radians(-90) / 2  # about the ego's x: the camera looks to its left
    outer = {"sensor_name": ["left"], "qw": [np.cos(half)], "qx": [np.sin(half)], "qy": [0.0]}
    outer |= {"qz": [0.0], "tx_m": [1.5], "ty_m": [0.2], "tz_m": [1.4]}
    (tmp_path / "calibration").mkdir()
    write_feather(tmp_path / "calibration/intrinsics.feather", inner)
    write_feather(tmp_path / "calibration/egovehicle_SE3_sensor.feather", outer)
    (camera,) = read_calibration(tmp_path)
    above_ground_m = 0.33 + 1.4
    points_rig = [[1.5, 8.2, above_ground_m, 1.0], [3.5, 8.2, above_ground_m - 1.0, 1.0]]
    local = (inverse(camera.T_rig_camera) @ np.transpose(points_rig))[:3]
    pixels = camera.K @ local / local[2]
    assert_allclose(pixels[:2].T, [[100.0, 50.0], [200.0, 87.5]])


def test_rows_of_the_ego_are_no_actor(tmp_path):
    rows = cuboids([*TRACKS, ("ego", "EGO_VEHICLE", (4.877, 2.0, 1.473), range(21), ORIGIN)])
    assert [
        a.actor_id for a in read_argoverse(write_argoverse(tmp_path / "x", annotations=rows)).actors
    ] == ["parked", "walker"]


def test_what_is_not_read_of_a_log_is_named(tmp_path):
    vector = vector_map()
    vector["lane_segments"]["1"]["speed_limit_mph"] = 25
    vector["traffic_lights"] = {}
    folder = write_argoverse(tmp_path / "x", document=vector)
    (folder / "odometry.feather").write_bytes(b"")
    notes = str(read_argoverse(folder).notes)
    for name in ("lane_segment/speed_limit_mph", "map/traffic_lights", "log/odometry.feather"):
        assert f"{name} (1)" in notes
