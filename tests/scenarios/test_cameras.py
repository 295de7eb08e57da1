"""The cameras of a scenario file: sections, shipped rigs, calibrations, and what is refused."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.cameras.lens import rays_of, sides_of
from alpasim_plugin.cli.output import size_lines
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import resolve_renderer
from alpasim_plugin.core.types import LensModel
from alpasim_plugin.runs.lenses import drawn_pixels
from scenarios.load import load_scenario
from scenarios.usdz_write import write_usdz

ROAD = "version: 1\nroad: {segments: [{kind: straight, length_m: 200}]}\n"


def written(folder, cameras, more=""):
    path = folder / "scene.yaml"
    path.write_text(f"{ROAD}{more}cameras: {cameras}\n")
    return path


def test_lens_shutter_and_rate_of_a_section_are_the_cameras(tmp_path):
    text = "[{name: a, lens: fisheye, width: 200, height: 160, hfov_deg: 190, shutter_us: 30000, interval_us: 200000, max_angle_deg: 100}]"
    (camera,) = load_scenario(written(tmp_path, text)).cameras
    assert (camera.shutter_us, camera.interval_us) == (30_000, 200_000)
    rays = rays_of(camera)
    middle = rays.ray.reshape(160, 200, 3)[80, [0, 199]]
    angle = np.rad2deg(np.arctan2(np.abs(middle[:, 0]), middle[:, 2]))
    assert_allclose(angle, 95 * 199 / 200, atol=0.1)
    assert len(sides_of(camera)) == 5


def test_the_order_of_listing_changes_no_scenario(tmp_path):
    text = ["{name: b, yaw_deg: 90}", "{name: a}", "{name: c, hfov_deg: 100}"]
    one = load_scenario(written(tmp_path, f"[{', '.join(text)}]"))
    other = load_scenario(written(tmp_path, f"[{', '.join(text[::-1])}]"))
    assert [camera.name for camera in one.cameras] == ["c", "a", "b"]
    assert [camera.name for camera in other.cameras] == ["c", "a", "b"]
    assert one.content_hash == other.content_hash


@pytest.mark.parametrize(
    ("rig", "count", "pinholes"),
    [
        ("front", 1, 1),
        ("alpasim-4", 4, 10),
        ("alpasim-4-and-front", 5, 11),
        ("alpasim-6", 6, 12),
        ("surround-6", 6, 6),
    ],
)
def test_a_shipped_rig_is_read_and_scaled(tmp_path, rig, count, pinholes):
    cameras = load_scenario(written(tmp_path, f"{{rig: {rig}, width: 192}}")).cameras
    assert [camera.width for camera in cameras] == [192] * count
    assert cameras[0].T_rig_camera[0, 2] > 0.99
    count, drawn = drawn_pixels(cameras)
    assert count == pinholes
    assert drawn < 1.6 * sum(camera.width * camera.height for camera in cameras)


def test_a_run_says_before_the_first_frame_what_large_cameras_cost(tmp_path):
    scenarios = [
        load_scenario(written(tmp_path, f"{{rig: alpasim-4, width: {w}}}")) for w in (192, 1900)
    ]
    renderers = [resolve_renderer("onefixer")]
    small, large = (
        size_lines(SimpleNamespace(scenarios={"a": one}, renderers=renderers)) for one in scenarios
    )
    assert small == []
    assert "8.2 megapixels" in large[0]
    assert "1.6 CPU seconds" in large[0]
    assert "CPU minutes to fit" in large[0]


def test_cameras_of_a_usdz_have_its_lenses(tmp_path):
    write_usdz(tmp_path / "s.usdz", load_scenario(written(tmp_path, "{rig: surround-6}")))
    cameras = load_scenario(written(tmp_path, "{from: s.usdz, shutter_us: 20000}")).cameras
    assert len(cameras) == 6
    assert all(camera.lens and camera.shutter_us == 20_000 for camera in cameras)
    rays = rays_of(cameras[0])
    across = rays.ray.reshape(288, 512, 3)[144, [0, -1]]
    assert_allclose(across[:, 0] / across[:, 2], [-0.7, 0.7], atol=0.005)


def test_cameras_of_an_argoverse_log_have_its_distortion(shared_data, tmp_path):
    (log,) = (p.parent.parent for p in shared_data.glob("av2/*/calibration/intrinsics.feather"))
    text = f"{{from: {log}, width: 205, names: [ring_side_left, ring_front_center]}}"
    cameras = load_scenario(written(tmp_path, text)).cameras
    assert [camera.name for camera in cameras] == ["ring_front_center", "ring_side_left"]
    assert all(camera.lens and camera.lens.kind == "opencv" for camera in cameras)


RIG = """{"axes": "%s", "w": 640, "h": 480, "fl_x": 500, "fl_y": 510.0, "cx": 320.5, "cy": 240, "frames": [
{"camera": "left", "k1": -0.1, "p2": 0.01, "transform_matrix": [[0, 0, 1, 1.5], [-1, 0, 0, 0.2], [0, -1, 0, 1.6], [0, 0, 0, 1]]},
{"camera": "%s", "camera_model": "OPENCV_FISHEYE", "transform_matrix": [[0, 0, %s, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]]}]}"""


def test_cameras_of_a_transforms_json_stand_where_its_poses_say(tmp_path):
    (tmp_path / "rig.json").write_text(RIG % ("opencv", "round", 1))
    cameras = load_scenario(written(tmp_path, "{from: rig.json, width: 320}")).cameras
    left, fisheye = sorted(cameras, key=lambda camera: camera.name)
    assert left.lens == LensModel("opencv", (-0.1, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0))
    assert fisheye.lens == LensModel("fisheye", (0.0,) * 4)
    assert_allclose(left.K[[0, 1, 0], [0, 1, 2]], [250, 255, 160.25])
    assert_allclose(left.T_rig_camera[:3, 2:].T, [[1, 0, 0], [1.5, 0.2, 1.6]])
    turned = (RIG % ("opengl", "round", 1)).replace("[0, 0, 1, 1.5]", "[0, 0, -1, 1.5]")
    (tmp_path / "rig.json").write_text(turned.replace("[0, -1, 0, 1.6]", "[0, 1, 0, 1.6]"))
    same = load_scenario(written(tmp_path, "{from: rig.json, width: 320}")).cameras
    assert_array_equal(same[0].T_rig_camera, cameras[0].T_rig_camera)


@pytest.mark.parametrize(
    ("axes", "name", "forward", "named"),
    [("nerf", "round", 1, "axes"), ("opencv", "left", 1, "'left'"), ("opencv", "a", 2, "rotation")],
)
def test_a_transforms_json_that_is_no_calibration_is_refused(tmp_path, axes, name, forward, named):
    (tmp_path / "rig.json").write_text(RIG % (axes, name, forward))
    with pytest.raises(InputError) as error:
        load_scenario(written(tmp_path, "{from: rig.json, width: 320}"))
    assert named in error.value.message


@pytest.mark.parametrize(
    ("key", "problem"),
    [
        ('"is_fisheye": true', "frame/is_fisheye"),
        ('"rolling_shutter": [0, 0, 1, 0]', "frame/rolling_shutter"),
        ('"camera_model": "OPENCV_FISHEYE", "k5": 0.1', "k5, p2, which a fisheye lens"),
    ],
)
def test_keys_of_a_rig_that_are_not_read_are_refused(tmp_path, key, problem):
    harmless = '"file_path": "a.png", "is_fisheye": false, "camera_angle_x": 1.1'
    rig = RIG % ("opencv", "round", 1)
    (tmp_path / "rig.json").write_text(rig.replace('"k1": -0.1', f'"k1": -0.1, {harmless}'))
    assert len(load_scenario(written(tmp_path, "{from: rig.json, width: 320}")).cameras) == 2
    (tmp_path / "rig.json").write_text(rig.replace('"k1": -0.1', f'"k1": -0.1, {key}'))
    with pytest.raises(InputError, match=problem):
        load_scenario(written(tmp_path, "{from: rig.json, width: 320}"))


@pytest.mark.parametrize(
    ("cameras", "named"),
    [
        ("[{hfov_deg: 165}]", "hfov_deg"),
        ("[{focal_px: [30, 30]}]", "hfov_deg"),
        ("[{coefficients: [0.1]}]", "pinhole"),
        ("[{lens: fisheye, coefficients: [-0.9]}]", "turns back"),
        ("[{lens: ftheta, hfov_deg: 220}]", "degrees from the axis"),
        ("[{name: a}, {name: a}]", "'a'"),
        ("[{interval_us: 150000}]", "150000"),
        ("[{shutter_us: 200000}]", "200000"),
        ("[{x_m: 1.4, z_m: 0.8}]", "inside the car's body"),
        ("[{x_m: 8}]", "away from the car's body"),
        ("[{name: a, width: 8192, height: 8192}, {name: b, width: 8}]", "67,110,016"),
        ("{rig: alpasim-5}", "alpasim-5"),
        ("{rig: front, wdth: 64}", "wdth"),
        ("{rig: front, from: x.usdz}", "rig and from"),
        ("{from: none.usdz}", "none.usdz"),
        ("{from: scene.yaml}", "calibration"),
        ("{from: .}", "a folder with scene.yaml"),
    ],
)
def test_cameras_that_cannot_be_drawn_are_refused_before_the_road_is_built(
    tmp_path, cameras, named, monkeypatch
):
    if "body" not in named:
        monkeypatch.setattr("scenarios.load.built_drive", None)
    with pytest.raises(InputError) as error:
        load_scenario(written(tmp_path, cameras))
    assert named in error.value.message
