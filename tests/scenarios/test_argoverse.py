from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from alpasim_plugin.errors import InputError
from alpasim_plugin.geometry import interpolate, matrix_from_quat, se3, wrap_angle, yaw_from_quat
from alpasim_plugin.geometry_lanes import lane_polygon
from alpasim_plugin.types import Vehicle
from alpasim_plugin.world.ground import height_at
from alpasim_plugin.world.lane_map import LaneIndex
from alpasim_plugin.world.route import route_from_log
from scenarios.argoverse import LABELS, read_argoverse, read_calibration, read_ego_poses
from scenarios.argoverse_map import PAINTS
from scenarios.reading import SourceFiles
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
)
from tests.scenarios.real_drive import boxes_at, footprint, ruling

# --- small logs made by hand ------------------------------------------------------------------------------------------


@pytest.fixture
def log(tmp_path):
    return read_argoverse(write_argoverse(tmp_path / "x"))


def refused(folder):
    with pytest.raises(InputError) as caught:
        read_argoverse(folder)
    error = caught.value
    assert error.exit_code == 2
    assert error.doing == "reading an Argoverse 2 log"
    return error


def test_world_is_local_and_keeps_centimetres_of_utm_sized_coordinates(log):
    assert log.world_origin == tuple(ORIGIN)
    np.testing.assert_allclose(log.ego_log.xyz, np.column_stack([np.arange(21.0), np.zeros(21), np.zeros(21)]), atol=2e-9)
    np.testing.assert_allclose(log.lane_map.lanes["1"].left, [[-20, 2, 0], [40, 2, 0]], atol=2e-9)


def test_time_is_whole_microseconds(log):
    assert log.ego_log.t_us[0] == T0_NS // 1000
    assert log.ego_log.t_us.dtype == np.int64
    assert (np.diff(log.ego_log.t_us) == STEP_NS // 1000).all()


def test_cuboids_of_a_moving_ego_frame_stand_still_in_the_world(log):
    parked, walker = log.actors
    np.testing.assert_allclose(parked.track.xyz, np.broadcast_to([30.0, -6.0, 0.75], (21, 3)), atol=1e-8)
    assert (parked.label, parked.is_static, parked.box.length_m) == ("car", True, 4.5)
    assert (walker.label, walker.is_static, len(walker.track)) == ("pedestrian", False, 11)
    assert walker.track.t_us[0] == (T0_NS + 5 * STEP_NS) // 1000
    np.testing.assert_allclose(walker.track.xyz[[0, -1], 1], [-5, 5], atol=1e-8)


def test_cuboids_turn_with_the_ego(tmp_path):
    ego = poses()
    half = np.radians(90) / 2
    ego["qw"][:], ego["qz"][:] = np.cos(half), np.sin(half)
    rows = cuboids([("a", "BUS", (12.0, 2.5, 3.0), [3], place(0.0, 0.0, 1.5))], ego)
    rows["tx_m"], rows["ty_m"], rows["tz_m"] = [7.0], [2.0], [1.0]
    actor = read_argoverse(write_argoverse(tmp_path / "x", ego=ego, annotations=rows)).actors[0]
    np.testing.assert_allclose(actor.track.xyz[0], [3.0 - 2.0, 7.0, 1.33], atol=1e-8)
    assert yaw_from_quat(actor.track.quat[0]) == pytest.approx(np.pi / 2)


def test_rows_of_the_ego_are_no_actor(tmp_path):
    rows = cuboids([*TRACKS, ("ego", "EGO_VEHICLE", (4.877, 2.0, 1.473), range(21), ORIGIN)])
    assert [a.actor_id for a in read_argoverse(write_argoverse(tmp_path / "x", annotations=rows)).actors] == ["parked", "walker"]


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
    assert (lanes["1"].left_paint, lanes["1"].right_paint) == ("dashed_white", "solid_white")
    assert len(log.lane_map.crosswalks[0]) == 5
    assert shapely.Polygon(log.lane_map.crosswalks[0][:, :2]).area == pytest.approx(4 * 16)


def test_road_edge_runs_round_the_union_of_areas_and_not_through_its_seam(log):
    (edge,) = log.lane_map.road_edges
    inside = np.abs(edge[:, 1]) < 7.99
    assert set(np.round(edge[inside, 0]).tolist()) == {-20.0, 200.0}
    assert np.linalg.norm(np.diff(edge[:, :2], axis=0), axis=1).max() <= 2.0 + 1e-9
    np.testing.assert_array_equal(edge[0], edge[-1])


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


def test_every_mark_type_and_category_has_its_place():
    assert set(PAINTS.values()) <= {"none", "solid_white", "dashed_white", "solid_yellow", "dashed_yellow", "double_yellow", "unknown"}
    assert len(PAINTS) == 15
    assert set(LABELS.values()) == {"car", "truck", "bus", "pedestrian", "cyclist", "motorcycle", "other"}
    assert len(LABELS) == 30


def test_unknown_mark_type_and_category_are_noted(tmp_path):
    document = vector_map()
    document["lane_segments"]["1"]["left_lane_mark_type"] = "ZIGZAG"
    rows = cuboids([("a", "UNICORN", CAR, range(3), place(30.0, 5.0, 1.5))])
    log = read_argoverse(write_argoverse(tmp_path / "x", annotations=rows, document=document))
    assert log.lane_map.lanes["1"].left_paint == "unknown"
    assert log.actors[0].label == "other"
    assert "1 lane edges have the mark type 'ZIGZAG': taken as paint 'unknown'" in log.notes
    assert "1 tracks of the unknown category 'UNICORN' are labelled 'other'" in log.notes


def test_same_bytes_give_the_same_hash_and_other_bytes_another(tmp_path):
    one, two = (read_argoverse(write_argoverse(tmp_path / name)) for name in "ab")
    other = read_argoverse(write_argoverse(tmp_path / "c", ego=poses(speed_mps=9.0)))
    assert one.content_hash == two.content_hash != other.content_hash


def test_opposite_neighbour_is_no_neighbour(tmp_path):
    document = vector_map()
    back = lane(4, 200, -20, -4, left_neighbor_id=1)
    back["left_lane_boundary"], back["right_lane_boundary"] = line((200, -6), (-20, -6)), line((200, -2), (-20, -2))
    document["lane_segments"]["4"] = back
    document["lane_segments"]["1"] |= {"right_neighbor_id": 4, "left_neighbor_id": 3}
    lanes = read_argoverse(write_argoverse(tmp_path / "x", document=document)).lane_map.lanes
    assert (lanes["1"].left_neighbour, lanes["1"].right_neighbour, lanes["4"].left_neighbour) == ("3", None, None)


# --- bad input --------------------------------------------------------------------------------------------------------


def test_folder_that_is_not_there(tmp_path):
    assert refused(tmp_path / "nowhere").found == "no such folder"


@pytest.mark.parametrize(
    "name", ["city_SE3_egovehicle.feather", "annotations.feather", "map/log_map_archive_x____PIT_city_1.json", "map/x___img_Sim2_city.json"]
)
def test_missing_file_is_named_by_its_pattern(tmp_path, name):
    folder = write_argoverse(tmp_path / "x")
    (folder / name).unlink()
    error = refused(folder)
    assert error.found.startswith("no file ")
    assert Path(name).stem.split("_x_")[0].removeprefix("x___") in error.found


@pytest.mark.parametrize("name", ["city_SE3_egovehicle.feather", "annotations.feather"])
@pytest.mark.parametrize("keep", [0, 5, 1000, -10])
def test_truncated_feather(tmp_path, name, keep):
    path = write_argoverse(tmp_path / "x") / name
    path.write_bytes(path.read_bytes()[:keep])
    error = refused(path.parent)
    assert error.with_what == str(path)
    assert "empty file" in error.found or "no readable Arrow IPC file" in error.found
    assert "fetch the file again" in error.do_this


def test_truncated_map(tmp_path):
    folder = write_argoverse(tmp_path / "x")
    path = next(folder.glob("map/log_map_archive_*.json"))
    path.write_bytes(path.read_bytes()[:500])
    error = refused(folder)
    assert error.with_what == str(path)
    assert "broken JSON" in error.found


def test_truncated_raster(tmp_path):
    folder = write_argoverse(tmp_path / "x")
    path = next(folder.glob("map/*.npy"))
    path.write_bytes(path.read_bytes()[:4000])
    assert "no readable NumPy array" in refused(folder).found


def test_text_that_is_no_utf_8_in_a_feather(tmp_path):
    path = write_argoverse(tmp_path / "x") / "annotations.feather"
    path.write_bytes(path.read_bytes().replace(b"REGULAR", b"REG\xff\xfeAR", 1))
    error = refused(path.parent)
    assert error.with_what == str(path)
    assert "no readable Arrow IPC file" in error.found


@pytest.mark.parametrize("header", [b"{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999999,), }", b"{'descr': (((", b"[]"])
def test_raster_with_a_broken_header(tmp_path, header):
    folder = write_argoverse(tmp_path / "x")
    path = next(folder.glob("map/*.npy"))
    path.write_bytes(b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n")
    error = refused(folder)
    assert error.with_what == str(path)
    assert "no readable NumPy array" in error.found


def test_one_point_on_another_continent(tmp_path):
    error = refused(write_argoverse(tmp_path / "x", document=vector_map() | {"lane_segments": {"1": lane(1, 0, 4e6, 0)}}))
    assert error.found == "a point 4000.0 km from the drive"
    assert "lane 1" in error.with_what


def test_drive_that_jumps_across_the_world(tmp_path):
    assert "km from the drive" in refused(write_argoverse(tmp_path / "x", ego=bad_poses("tx_m", 4, 9e6), annotations=cuboids(TRACKS))).found


def test_two_maps_are_ambiguous(tmp_path):
    folder = write_argoverse(tmp_path / "x")
    (folder / "map" / "log_map_archive_y____PIT_city_2.json").write_text("{}")
    assert refused(folder).found.startswith("2 files match")


def without(document, layer, key=None):
    if key is None:
        document[layer] = {}
    else:
        del document[layer]["1"][key]
    return document


@pytest.mark.parametrize(
    ("document", "found"),
    [
        (without(vector_map(), "lane_segments"), "a map without lanes"),
        (without(vector_map(), "drivable_areas"), "without road edges"),
        (without(vector_map(), "lane_segments", "left_lane_boundary"), "no usable left_lane_boundary"),
        ({"lane_segments": {}}, "no object 'drivable_areas'"),
        ([], "no object 'lane_segments'"),
        (vector_map() | {"lane_segments": {"1": lane(1, 0, 10, 0, lane_type="RIVER")}}, "lane type 'RIVER'"),
        (vector_map() | {"lane_segments": {"1": lane(1, 0, 10, 0, left_lane_boundary=line((0, 2)))}}, "boundary with 1 finite points"),
        (vector_map() | {"lane_segments": {"1": lane(1, 0, float("nan"), 0)}}, "left_lane_boundary with 2 finite points"),
    ],
)
def test_map_without_what_every_map_has(tmp_path, document, found):
    error = refused(write_argoverse(tmp_path / "x", document=document))
    assert found in error.found
    assert "log_map_archive" in error.with_what


def test_log_without_cuboids(tmp_path):
    empty = {k: np.array(v)[:0] for k, v in cuboids(TRACKS).items()}
    error = refused(write_argoverse(tmp_path / "x", annotations=empty))
    assert error.found == "no cuboids of other road users"
    assert error.with_what.endswith("annotations.feather")


def test_log_of_one_pose(tmp_path):
    assert refused(write_argoverse(tmp_path / "x", ego=poses(1), annotations=cuboids(TRACKS))).found == "1 pose"


def bad_poses(name, row, value):
    ego = poses()
    ego[name][row] = value
    return ego


@pytest.mark.parametrize(
    ("ego", "found"),
    [
        (bad_poses("timestamp_ns", 5, T0_NS), "in row 5"),
        (bad_poses("timestamp_ns", 5, T0_NS + 4 * STEP_NS), "in row 5"),
        (bad_poses("qw", 3, 0.0), "a quaternion of length 0 in row 3"),
        (bad_poses("qw", 3, 2.0), "a quaternion of length 2 in row 3"),
        (bad_poses("tx_m", 4, np.nan), "positions that are not finite, first in row 4"),
        (poses() | {"timestamp_ns": poses()["timestamp_ns"].astype(float)}, "timestamp_ns of type float64"),
        ({k: v for k, v in poses().items() if k != "qz"}, "no column 'qz'"),
    ],
)
def test_poses_that_are_no_drive(tmp_path, ego, found):
    error = refused(write_argoverse(tmp_path / "x", ego=ego, annotations=cuboids(TRACKS)))
    assert found in error.found
    assert error.with_what.endswith("city_SE3_egovehicle.feather")


def bad_cuboids(name, row, value):
    rows = {k: np.array(v) for k, v in cuboids(TRACKS).items()}
    rows[name][row] = value
    return rows


@pytest.mark.parametrize(
    ("rows", "found"),
    [
        (bad_cuboids("timestamp_ns", 2, T0_NS + 7), "without an ego pose at that time"),
        (bad_cuboids("timestamp_ns", 2, T0_NS), "after"),
        (bad_cuboids("qw", 2, 0.0), "a quaternion of length 0"),
        (bad_cuboids("tx_m", 2, np.inf), "a cuboid pose that is not finite in row 2"),
        (bad_cuboids("length_m", slice(0, 21), 0.0), "a size of 0.0 x 1.9 x 1.5 m"),
    ],
)
def test_cuboids_that_are_no_tracks(tmp_path, rows, found):
    error = refused(write_argoverse(tmp_path / "x", annotations=rows))
    assert found in error.found
    assert "annotations.feather" in error.with_what


# --- the facts of three recorded logs ---------------------------------------------------------------------------------

FACTS = {
    "7fab2350": {
        "poses": 2706, "duration_s": 15.950, "path_m": 75.04, "tracks": 114, "boxes": 11364, "lanes": 183, "intersection": 73,
        "crossings": 11, "areas": 13,
        "gap_m": 0.521, "world_gap_m": 0.521, "gap_s": 11.90, "turn_deg": 62.6, "resolved": 205, "links": 226, "mirrored": 205,
        "lane_ids": ("38133154", "38133156", "38114426"), "kinds": (163, 20, 0),
    },
    "adcf7d18": {
        "poses": 2637, "duration_s": 15.943, "path_m": 40.41, "tracks": 146, "boxes": 12078, "lanes": 199, "intersection": 61,
        "crossings": 11, "areas": 8,
        "gap_m": 0.385, "world_gap_m": 0.388, "gap_s": 4.90, "turn_deg": 0.6, "resolved": 199, "links": 230, "mirrored": 92,
        "lane_ids": ("42811487", "42811322", "42809424"), "kinds": (166, 19, 14),
    },
    "3bffdcff": {
        "poses": 2692, "duration_s": 15.955, "path_m": 88.43, "tracks": 116, "boxes": 12342, "lanes": 211, "intersection": 67,
        "crossings": 14, "areas": 15,
        "gap_m": 0.190, "world_gap_m": 0.177, "gap_s": 14.00, "turn_deg": -50.3, "resolved": 238, "links": 259, "mirrored": 121,
        "lane_ids": ("56224493", "56225812", "56226203"), "kinds": (173, 37, 1),
    },
}  # fmt: skip


@pytest.fixture(scope="module", params=FACTS)
def real(request, shared_data):
    """One recorded log: (facts, folder, raw poses, what the reader made of it)."""
    folder = shared_data / "av2" / request.param
    raw = read_ego_poses(SourceFiles("testing"), folder / "city_SE3_egovehicle.feather")
    return FACTS[request.param], folder, raw, read_argoverse(folder)


def sweeps_us(log):
    """Times of the annotation frames."""
    return np.unique(np.concatenate([a.track.t_us for a in log.actors]))


def test_real_poses(real):
    facts, _, raw, log = real
    assert len(raw.t_ns) == facts["poses"]
    assert (raw.t_ns[-1] - raw.t_ns[0]) * 1e-9 == pytest.approx(facts["duration_s"], abs=5e-4)
    assert np.linalg.norm(np.diff(raw.xyz, axis=0), axis=1).sum() == pytest.approx(facts["path_m"], abs=5e-3)
    assert np.median(np.diff(raw.t_ns)) * 1e-6 == pytest.approx(5.07, abs=5e-3)
    assert np.degrees(wrap_angle(yaw_from_quat(raw.quat[-1]) - yaw_from_quat(raw.quat[0]))) == pytest.approx(facts["turn_deg"], abs=0.05)
    assert (log.ego_log.t_us[-1] - log.ego_log.t_us[0]) * 1e-6 == pytest.approx(facts["duration_s"], abs=5e-4)
    assert np.linalg.norm(np.diff(log.ego_log.xyz, axis=0), axis=1).sum() == pytest.approx(facts["path_m"], abs=0.15)  # 0.33 m lower


def test_real_annotations(real):
    facts, folder, _, log = real
    own = 156 if folder.name == "3bffdcff" else 0  # rows of the ego itself, one track
    assert len({a.actor_id for a in log.actors}) + (own > 0) == facts["tracks"]
    assert sum(len(a.track) for a in log.actors) + own == facts["boxes"]
    assert len(sweeps_us(log)) == 156
    assert np.diff(sweeps_us(log)) == pytest.approx(1e5, abs=4e3)


def test_real_map(real):
    facts, folder, _, log = real
    lanes = log.lane_map.lanes
    assert (len(lanes), sum(k.is_intersection for k in lanes.values())) == (facts["lanes"], facts["intersection"])
    assert (len(log.lane_map.crosswalks), len(log.lane_map.drivable_areas)) == (facts["crossings"], facts["areas"])
    assert tuple(sum(k.kind == kind for k in lanes.values()) for kind in ("vehicle", "bike", "bus")) == facts["kinds"]
    assert sum(len(k.successors) for k in lanes.values()) == facts["links"]
    assert sum(s in lanes for k in lanes.values() for s in k.successors) == facts["resolved"]
    assert all(lane_polygon(k).is_valid and lane_polygon(k).geom_type == "Polygon" for k in lanes.values())
    raw = json.loads(next(folder.glob("map/log_map_archive_*.json")).read_bytes())["lane_segments"]
    mirrored = sum(int(k) in raw[s]["predecessors"] for k, lane in lanes.items() for s in lane.successors if s in raw)
    assert mirrored == facts["mirrored"]


def test_real_human_is_inside_the_drivable_areas_in_every_frame(real):
    _, _, _, log = real
    surface = shapely.union_all([shapely.Polygon(a[:, :2]) for a in log.lane_map.drivable_areas])
    poses_ = interpolate(log.ego_log, sweeps_us(log))
    assert shapely.contains(surface, footprint(poses_, log.vehicle)).sum() == 156
    assert shapely.contains_xy(surface, poses_[:, :2, 3]).sum() == 156


def test_real_least_gap_in_the_plane_of_the_ego(real):
    """The published figures are taken in the ego's own xy plane; nobody touches the ego."""
    facts, _, _, log = real
    times = sweeps_us(log)
    own = footprint(np.eye(4)[None], log.vehicle)[0]
    gaps = np.array([shapely.distance(own, boxes_at(log.actors, t, frame=interpolate(log.ego_log, t))).min() for t in times])
    assert gaps.min() == pytest.approx(facts["gap_m"], abs=5e-4)
    assert (times[gaps.argmin()] - times[0]) * 1e-6 == pytest.approx(facts["gap_s"], abs=0.05)


def test_real_least_gap_in_the_world_plane(real):
    """In the world's xy plane the tilt of the road moves the box centre, half a height above it, by millimetres."""
    facts, _, _, log = real
    times = sweeps_us(log)
    ego = footprint(interpolate(log.ego_log, times), log.vehicle)
    gaps = np.array([shapely.distance(shape, boxes_at(log.actors, t)).min() for shape, t in zip(ego, times, strict=True)])
    assert gaps.min() == pytest.approx(facts["world_gap_m"], abs=5e-4)


def test_real_ego_is_in_a_lane_in_every_frame_and_in_at_most_four(real):
    _, _, _, log = real
    inside = LaneIndex(log.lane_map).containing_many(interpolate(log.ego_log, sweeps_us(log))[:, :3, 3])
    assert min(map(len, inside)) >= 1
    assert max(map(len, inside)) <= 4


def test_real_route_names_the_lanes_passed(real):
    facts, _, _, log = real
    route = route_from_log(log.lane_map, log.ego_log)
    assert route.lane_ids[:3] == facts["lane_ids"]
    lanes = log.lane_map.lanes
    assert all(b in lanes[a].successors for a, b in zip(route.lane_ids[:-1], route.lane_ids[1:], strict=True))


def test_real_wheels_stand_on_the_ground(real):
    _, _, raw, log = real
    above = log.ego_log.xyz[:, 2] - height_at(log.ground, log.ego_log.xyz)
    assert np.abs(above).max() < 0.06
    assert np.abs(np.median(above)) < 0.01
    np.testing.assert_allclose(np.linalg.norm(raw.quat, axis=1), 1.0, atol=1e-12)


def test_real_vehicle_is_the_annotated_one(real):
    _, _, _, log = real
    box = log.vehicle.box
    assert (box.length_m, box.width_m, log.vehicle.rear_axle_to_centre_m) == (4.877, 2.0, 1.422)
    assert log.vehicle.wheelbase_m == Vehicle().wheelbase_m


# Frames at 10 Hz by the paper's rule: held by one lane, held by the union of nearby lanes, held by neither, off-road.
RULINGS = {"7fab2350": (62, 88, 10, 0), "adcf7d18": (135, 25, 0, 0), "3bffdcff": (125, 35, 0, 0)}


def test_rule_of_the_paper_calls_no_frame_off_road(real):
    """On leaving its junction 7fab2350 cuts a corner that the turning lanes do not cover: there the road edges, 1.4 m away, decide."""
    _, folder, _, log = real
    times = np.arange(log.ego_log.t_us[0], log.ego_log.t_us[-1], 100_000)
    parts = ruling(log, times)
    assert tuple(map(len, parts)) == RULINGS[folder.name]
    if folder.name == "7fab2350":
        assert parts[2] == list(range(150, 160))


def test_real_calibration(shared_data):
    folder = shared_data / "av2" / "7fab2350"
    cameras = {c.name: c for c in read_calibration(folder)}
    assert len(cameras) == 9
    front = cameras["ring_front_center"]
    assert (front.width, front.height) == (1550, 2048)
    np.testing.assert_allclose(front.K, [[1776.041484, 0, 777.990573], [0, 1776.041484, 1013.524325], [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(front.T_rig_camera[:3, 2], [1, 0, 0], atol=0.01)  # looks ahead
    np.testing.assert_allclose(front.T_rig_camera[:3, 1], [0, 0, -1], atol=0.01)  # image down is world down
    assert front.T_rig_camera[2, 3] == pytest.approx(1.398 + 0.33, abs=1e-3)
    sweep = folder / "sensors" / "lidar" / "315966265259836000.feather"
    assert len(SourceFiles("testing").read_feather(sweep, ("x",))["x"]) == 99229


def test_log_without_calibration(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_calibration(tmp_path)


def test_rotations_stay_rigid(real):
    _, _, _, log = real
    for actor in log.actors[:20]:
        matrices = se3(actor.track.xyz, actor.track.quat)[:, :3, :3]
        np.testing.assert_allclose(matrices @ np.swapaxes(matrices, 1, 2), np.broadcast_to(np.eye(3), matrices.shape), atol=1e-12)
    assert matrix_from_quat(log.ego_log.quat)[:, 2, 2].min() > 0.99
