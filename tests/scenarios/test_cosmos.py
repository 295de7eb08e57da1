from __future__ import annotations

from collections import Counter

import av
import numpy as np
import pytest
import shapely
from scipy import ndimage
from scipy.spatial import KDTree

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import (
    densify,
    inverse,
    se3,
    transform_points,
    wrap_angle,
    yaw_from_quat,
)
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.world.ground import height_at
from alpasim_plugin.world.route import LaneIndex, route_from_log
from scenarios.cosmos import paint_of, read_cosmos, read_layer, read_poses, sign_pose
from scenarios.cosmos_camera import FRONT_WIDE, T_RIG_FRONT_WIDE, front_camera, lens_of, read_lenses
from scenarios.recorded import SourceFiles
from tests.scenarios.ftheta import project_ftheta
from tests.scenarios.make_cosmos import (
    CLIP,
    WIDE,
    cuboid,
    label,
    lane,
    layers,
    polyline,
    poses,
    write_cosmos,
)
from tests.scenarios.real_drive import ruling


@pytest.fixture
def log(tmp_path):
    return read_cosmos(write_cosmos(tmp_path / "x"))


def refused(folder):
    with pytest.raises(InputError) as caught:
        read_cosmos(folder)
    error = caught.value
    assert error.exit_code == 2
    return error


# --- small clips made by hand


def test_drive_has_the_clip_s_own_time(log):
    assert log.ego_log.t_us[:4].tolist() == [1_000_000, 1_033_333, 1_066_667, 1_100_000]
    np.testing.assert_allclose(log.ego_log.xyz[:, 0], np.arange(31) / 3, atol=1e-6)
    assert log.scene_id == "cosmos-0-clip"


def test_map_layers_arrive(log):
    lanes = log.lane_map.lanes
    assert lanes["1"].successors == ("2",)
    assert [k.kind for k in lanes.values()] == ["vehicle", "vehicle", "shoulder"]
    assert (lanes["1"].left_paint, lanes["1"].right_paint) == ("solid_yellow", "dashed_white")
    assert lanes["1"].speed_limit_mps == pytest.approx(29.0576)
    assert lanes["1"].left_neighbour is None
    assert (len(log.lane_map.road_edges), len(log.lane_map.poles), len(log.lane_map.signs)) == (
        2,
        1,
        1,
    )
    assert [m.paint for m in log.lane_map.markings] == ["dashed_white"]
    assert [s[0, 0] for s in log.lane_map.stop_lines] == [58.0]  # the implicit one is no paint
    np.testing.assert_array_equal(log.lane_map.crosswalks[0][0], log.lane_map.crosswalks[0][-1])


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("swapped", [False, True])
def test_left_is_left_in_driving_direction_however_the_edges_are_stored(tmp_path, turned, swapped):
    lanes = [
        lane("1", -20, 50, 0, ("2",), turned, swapped),
        lane("2", 50, 200, 0, (), turned, swapped),
    ]
    log = read_cosmos(write_cosmos(tmp_path / "x", **{"3d_lanes": lanes}))
    for one in log.lane_map.lanes.values():
        assert one.left[0, 0] < one.left[-1, 0]
        assert (one.left[:, 1] == 2).all()
        assert (one.right[:, 1] == -2).all()
    assert any("against their driving direction" in note for note in log.notes) == turned


def test_lane_without_links_takes_the_direction_of_the_drive(tmp_path):
    log = read_cosmos(
        write_cosmos(tmp_path / "x", **{"3d_lanes": [lane("1", -20, 200, 0, turned=True)]})
    )
    assert log.lane_map.lanes["1"].left[0, 0] == -20


def test_oncoming_lane_stays_oncoming(tmp_path):
    lanes = [*layers()["3d_lanes"], lane("8", 100, 50, 4, ("9",)), lane("9", 50, -20, 4)]
    found = read_cosmos(write_cosmos(tmp_path / "x", **{"3d_lanes": lanes})).lane_map.lanes["8"]
    assert found.left[0, 0] == 100
    assert (found.left[:, 1] == 2).all()


def test_second_edge_stored_backwards_is_turned(tmp_path):
    raw = lane("1", -20, 50, 0, ("2",))
    raw["labelData"]["shape3d"]["polylines3d"]["polylines"][1]["vertices"].reverse()
    found = read_cosmos(
        write_cosmos(tmp_path / "x", **{"3d_lanes": [raw, lane("2", 50, 200, 0)]})
    ).lane_map.lanes["1"]
    assert lane_polygon(found).is_valid
    assert lane_polygon(found).area == pytest.approx(280.0)


@pytest.mark.parametrize(
    ("styles", "colours", "paint"),
    [
        (["SOLID_SINGLE"], ["WHITE"], "solid_white"),
        (["LONG_DASHED_SINGLE"], ["YELLOW"], "dashed_yellow"),
        (["SOLID_GROUP"], ["YELLOW"], "double_yellow"),
        (["SOLID_GROUP"], ["WHITE"], "solid_white"),
        (["DASHED_GROUP"], ["WHITE"], "dashed_white"),
        (["TALL_CURB", "TALL_CURB", "VIRTUAL"], ["UNKNOWN"] * 3, "none"),
        (["BARRIER"], ["WHITE"], "none"),
        (["SOLID_SINGLE"], ["UNKNOWN"], "unknown"),
        (["SQUIGGLE"], ["WHITE"], "unknown"),
        ([], [], "unknown"),
        (None, None, "unknown"),
    ],
)
def test_paint_comes_from_style_and_colour(styles, colours, paint):
    assert paint_of(styles, colours) == paint


def test_sign_stands_upright_with_its_thin_side_ahead():
    pose, box = sign_pose(np.array(cuboid((1.0, 2.0, 3.0), 0.01, 0.7, 0.9)["cuboid3d"]["vertices"]))
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(np.abs(pose[:3, :3]), np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert (box.length_m, box.width_m, box.height_m) == pytest.approx((0.01, 0.7, 0.9))


def test_every_rendered_pixel_was_recorded(log):
    camera = log.cameras[0]
    lens = lens_of(np.array(WIDE))
    u, v = np.meshgrid(np.arange(camera.width + 1.0), np.arange(camera.height + 1.0))
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ np.linalg.inv(camera.K).T
    pixels = project_ftheta(lens, rays)
    assert (pixels >= 0).all()
    assert (pixels <= [lens.width, lens.height]).all()
    assert np.degrees(2 * np.arctan(camera.width / 2 / camera.K[0, 0])) == pytest.approx(90.0)


@pytest.mark.parametrize(
    "values", [WIDE, [970.0, 600.0, 1920.0, 1080.0, 0.0, 3675.7, 178.8, -387.4, -11.4, 18.0, 0.0]]
)
def test_both_directions_of_a_lens_undo_each_other(values):
    camera = lens_of(np.array(values))
    polynomial = np.polynomial.polynomial.polyval
    theta = np.linspace(0, camera.lens.max_angle_rad, 200)
    np.testing.assert_allclose(
        polynomial(polynomial(theta, camera.lens.angle_to_pixel), camera.lens.pixel_to_angle),
        theta,
        atol=1e-4,
    )
    # The projection itself is as exact as the calibrated polynomial.
    rays = np.column_stack([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)])
    radius = np.linalg.norm(project_ftheta(camera, rays) - (camera.cx, camera.cy), axis=1)
    back = polynomial(radius, camera.lens.pixel_to_angle)
    np.testing.assert_allclose(back, theta, atol=1e-9 if camera.backward_given else 1e-4)


def test_nothing_is_seen_beyond_the_lens():
    assert np.isnan(project_ftheta(lens_of(np.array(WIDE)), np.array([[1.0, 0.0, -1.0]]))).all()


# --- bad input


def test_folder_that_is_not_there(tmp_path):
    assert refused(tmp_path / "nowhere").do_this == "give the folder that holds 3d_lanes"


@pytest.mark.parametrize("name", [*layers(), "vehicle_pose", "ftheta_intrinsic"])
def test_missing_layer(tmp_path, name):
    folder = write_cosmos(tmp_path / "x")
    (folder / name / f"{CLIP}.tar").unlink()
    error = refused(folder)
    assert error.message == str(folder / name)
    assert error.message == "no file *.tar"


@pytest.mark.parametrize("name", ["3d_lanes", "vehicle_pose", "ftheta_intrinsic"])
@pytest.mark.parametrize("keep", [0, 100, 600, 1200])
def test_truncated_tar(tmp_path, name, keep):
    path = write_cosmos(tmp_path / "x") / name / f"{CLIP}.tar"
    path.write_bytes(path.read_bytes()[:keep])
    error = refused(path.parents[1])
    assert str(path) in error.message
    assert any(
        text in error.message
        for text in ("empty file", "damaged tar", "no readable NumPy array", "broken JSON")
    )


@pytest.mark.parametrize(
    ("matrices", "found"),
    [
        (poses(1), "1 pose"),
        ({}, "a tar without files"),
        ({7: np.eye(4)}, "no frame 000000 among 1 poses"),
        ({0: np.eye(4), 2: np.eye(4)}, "no frame 000001 among 2 poses"),
        ([np.eye(4), np.eye(4) * 2], "not a rigid motion"),
        ([np.eye(4), np.zeros((4, 4))], "not a rigid motion"),
        ([np.eye(4), np.full((4, 4), np.nan)], "not a rigid motion"),
        ([np.eye(3), np.eye(3)], "an array of shape (3, 3)"),
    ],
)
def test_poses_that_are_no_drive(tmp_path, matrices, found):
    error = refused(write_cosmos(tmp_path / "x", matrices=matrices))
    assert found in error.message
    assert "vehicle_pose" in error.message


@pytest.mark.parametrize(
    ("changed", "found"),
    [
        ({"3d_lanes": []}, "a map without lanes"),
        ({"3d_road_boundaries": []}, "a map without road edges"),
        ({"3d_lanes": [label("1", polyline((0, 0, 0), (9, 0, 0)))]}, "1 edges"),
        ({"3d_lanes": [lane("1", 0, 50, 0), lane("1", 50, 90, 0)]}, "lane id 1 twice"),
        ({"3d_lanes": [lane("1", 0, float("nan"), 0)]}, "the number nan"),
        ({"3d_lanes": [label("1", {"sphere3d": {}})]}, "no readable shape"),
        ({"3d_lanes": [{}]}, "no readable shape"),
        ({"3d_poles": 7}, "no list 'labels'"),
    ],
)
def test_maps_that_are_no_map(tmp_path, changed, found):
    error = refused(write_cosmos(tmp_path / "x", **changed))
    assert found in error.message
    assert next(iter(changed)) in error.message


@pytest.mark.parametrize(
    "lens", [[1.0, 2.0], [*WIDE[:10], 3.0], [*WIDE[:2], 0.0, 0.0, *WIDE[4:]], [np.nan] * 11]
)
def test_lens_that_is_none(tmp_path, lens):
    error = refused(write_cosmos(tmp_path / "x", lens=lens))
    assert "not an f-theta lens" in error.message


# --- the facts of the recorded clip


@pytest.fixture(scope="module")
def clip(shared_data):
    return shared_data / "cosmos-drive-dreams" / "example"


@pytest.fixture(scope="module")
def real(clip):
    return read_cosmos(clip)


def test_real_poses(clip, real):
    drive, name = read_poses(SourceFiles(), clip)
    assert (len(drive), name) == (300, "2d23a1f4-c269-46aa-8e7d-1bb595d1e421")
    np.testing.assert_allclose(se3(drive.xyz, drive.quat)[0], np.eye(4), atol=1e-15)
    assert np.linalg.norm(np.diff(drive.xyz, axis=0), axis=1).sum() == pytest.approx(
        103.031, abs=1e-3
    )
    np.testing.assert_allclose(drive.xyz[-1], [102.788, -6.320, -0.379], atol=1e-3)
    assert np.degrees(
        wrap_angle(yaw_from_quat(drive.quat[-1]) - yaw_from_quat(drive.quat[0]))
    ) == pytest.approx(-5.94, abs=5e-3)
    speed = np.linalg.norm(np.diff(drive.xyz, axis=0), axis=1) * 30
    assert 9.0 < speed.min() < speed.max() < 12.0
    assert drive.t_us[0] == 2445376400000
    assert drive.t_us[-1] - drive.t_us[0] == 9_966_667
    np.testing.assert_array_equal(real.ego_log.xyz, drive.xyz)


def test_real_layers(clip, real):
    files = SourceFiles()
    found = {
        name: read_layer(files, clip, f"3d_{name}")
        for name in ("lanes", "lanelines", "road_boundaries", "wait_lines", "poles")
    }
    found |= {
        name: read_layer(files, clip, f"3d_{name}")
        for name in ("traffic_signs", "road_markings", "crosswalks", "traffic_lights")
    }
    assert {name: len(v) for name, v in found.items()} == {
        "lanes": 344,
        "lanelines": 85,
        "road_boundaries": 93,
        "wait_lines": 34,
        "poles": 28,
        "traffic_signs": 29,
        "road_markings": 6,
        "crosswalks": 1,
        "traffic_lights": 0,
    }
    assert sum(len(label.lines[0]) for label in found["lanelines"]) == 869
    assert sum(len(label.lines[0]) for label in found["road_boundaries"]) == 825
    assert Counter(label.attributes["speed_limit"] for label in found["lanes"]) == {
        65.0: 224,
        25.0: 120,
    }
    assert all(len(label.lines) == 2 for label in found["lanes"])
    assert all(label.lines[0].shape == (8, 3) for label in found["traffic_signs"])
    kept = real.lane_map
    assert (
        len(kept.markings),
        len(kept.road_edges),
        len(kept.poles),
        len(kept.signs),
        len(kept.crosswalks),
    ) == (85, 93, 28, 29, 1)
    assert len(kept.stop_lines) == 34 - 27


def test_real_lanes(real):
    lanes = real.lane_map.lanes
    assert len(lanes) == 344
    polygons = [lane_polygon(k) for k in lanes.values()]
    assert all(p.is_valid and p.geom_type == "Polygon" for p in polygons)
    links = [(k, s) for k, lane in lanes.items() for s in lane.successors]
    assert (len(links), sum(s in lanes for _, s in links)) == (336, 336)
    gaps = [np.linalg.norm(lanes[a].centre[-1] - lanes[b].centre[0]) for a, b in links]
    assert max(gaps) < 0.5  # every lane ends where its successor starts
    turn = [
        np.diff(np.concatenate([k.left[[0]], k.centre[[0]], k.right[[0]]])[:, :2], axis=0)
        for k in lanes.values()
    ]
    ahead = [k.centre[1, :2] - k.centre[0, :2] for k in lanes.values()]
    assert all(
        a[0] * t[0, 1] - a[1] * t[0, 0] < 0 for a, t in zip(ahead, turn, strict=True)
    )  # from left to right is rightwards


def test_real_drive_is_in_one_lane_of_its_own_direction_in_every_frame(real):
    index = LaneIndex(real.lane_map)
    inside = index.containing_many(real.ego_log.xyz)
    assert [len(k) for k in inside] == [1] * 300
    assert list(dict.fromkeys(k[0] for k in inside)) == [
        "17632017",
        "17632024",
        "62841330",
        "62844249",
    ]
    for (lane_id,), xyz, yaw in zip(
        inside, real.ego_log.xyz, yaw_from_quat(real.ego_log.quat), strict=True
    ):
        assert abs(wrap_angle(index.heading_rad(lane_id, xyz) - yaw)) < 0.1
    route = route_from_log(real.lane_map, real.ego_log)
    assert route.lane_ids[:4] == ("17632017", "17632024", "62841330", "62844249")


def test_real_reference_point_is_at_ground_level(real):
    vertices = np.concatenate([e for k in real.lane_map.lanes.values() for e in (k.left, k.right)])
    nearest = vertices[KDTree(vertices[:, :2]).query(real.ego_log.xyz[:, :2])[1], 2]
    assert np.median(real.ego_log.xyz[:, 2] - nearest) == pytest.approx(-0.042, abs=5e-4)
    assert np.abs(real.ego_log.xyz[:, 2] - height_at(real.ground, real.ego_log.xyz)).max() < 0.05


def test_real_lenses(clip):
    lenses = read_lenses(SourceFiles(), clip)
    assert len(lenses) == 7
    front = lenses[FRONT_WIDE]
    assert (front.cx, front.cy, front.width, front.height) == (
        pytest.approx(954.2063, abs=1e-4),
        pytest.approx(757.15415),
        1920,
        1080,
    )
    forward = {name for name, lens in lenses.items() if not lens.backward_given}
    assert forward == {
        "camera_front_tele_30fov",
        "camera_rear_left_70fov",
        "camera_rear_right_70fov",
        "camera_rear_tele_30fov",
    }
    spec = front_camera(front)
    assert (spec.width, spec.height) == (512, 288)
    np.testing.assert_allclose(spec.T_rig_camera, T_RIG_FRONT_WIDE, atol=1e-6)


def read_frames(path, wanted):
    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        frames = {
            i: f.to_ndarray(format="rgb24")
            for i, f in enumerate(video.decode(stream))
            if i in wanted or i == 56
        }
        return frames, stream.frames, float(stream.average_rate), (stream.width, stream.height)


def test_map_poses_lens_and_mount_fall_on_the_publisher_s_own_render(clip, real):
    """Lane lines and road boundaries within 40 m ahead land within 3 px of something drawn; few
    pixels are drawn at all.
    """
    path = next(
        (clip.parent / "example_outputs" / "hdmap" / "ftheta_camera_front_wide_120fov").glob(
            "*.mp4"
        )
    )
    frames, count, rate, size = read_frames(path, {0, 28, 56})
    assert (count, rate, size) == (57, 30.0, (1280, 704))
    lens = read_lenses(SourceFiles(), clip)[FRONT_WIDE]
    files = SourceFiles()
    lines = [
        x.lines[0]
        for name in ("3d_lanelines", "3d_road_boundaries")
        for x in read_layer(files, clip, name)
    ]
    points = np.concatenate([densify(line, 0.5) for line in lines])
    poses_ = se3(real.ego_log.xyz, real.ego_log.quat)
    for k, expected in ((0, 0.950), (28, 0.955), (56, 0.967)):
        rig = transform_points(inverse(poses_[k]), points)
        near = rig[(rig[:, 0] > 0) & (rig[:, 0] < 40)]
        pixels = project_ftheta(
            lens, transform_points(inverse(real.cameras[0].T_rig_camera), near)
        ) * (1280 / 1920, 704 / 1080)
        seen = pixels[((pixels >= 0) & (pixels < size)).all(axis=1)].astype(int)
        lit = frames[k].max(axis=2) > 40
        close = ndimage.distance_transform_edt(~lit)[seen[:, 1], seen[:, 0]] <= 3
        assert len(seen) > 300
        assert close.mean() == pytest.approx(expected, abs=0.03)
        assert lit.mean() < 0.2


def test_rule_of_the_paper_calls_the_human_drive_on_road(real):
    """Consecutive lanes leave gaps across the road: there no lane holds the footprint, and the road
    edges, far away, decide.
    """
    times = np.arange(real.ego_log.t_us[0], real.ego_log.t_us[-1], 100_000)
    one, union, neither, off = ruling(real, times)
    assert (len(one), len(union), len(neither), off) == (85, 0, 15, [])
    edges = shapely.multilinestrings(
        [shapely.linestrings(e[:, :2]) for e in real.lane_map.road_edges]
    )
    assert min(shapely.distance(edges, shapely.points(real.ego_log.xyz[:, :2]))) > 3.0
