"""AlpaSim scenes: what is read, how untrusted archives are refused, and that they can be driven
in.
"""

import json
import warnings
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import yaw_from_quat
from scenarios import usdz_archive
from scenarios.ftheta import rig_cameras
from scenarios.load import load_scenario
from scenarios.usdz import read_usdz, usdz_scene_id
from tests.scenarios.make_usdz import (
    LANE_M,
    START_US,
    key,
    members,
    parquet,
    rail,
    rig,
    sequence,
    tables,
    write,
)
from tests.scenarios.usdz_scene import read_usdz_scene


def changed(**parts):
    """The small scene with members replaced, added, or (None) left out; __ stands for the slash,
    _dot_ for the dot.
    """
    out = members()
    for name, data in parts.items():
        member = name.replace("__", "/").replace("_dot_", ".")
        if data is None:
            del out[member]
        else:
            out[member] = data
    return out


def test_map_drive_traffic_and_vehicle_of_a_scene(tmp_path):
    log = read_usdz(write(tmp_path / "a.usdz"))
    assert (log.scene_id, log.source, usdz_scene_id(tmp_path / "a.usdz")) == (
        "small",
        "usdz",
        "small",
    )
    right = log.lane_map.lanes["L0"]
    left = log.lane_map.lanes["L1"]
    assert right.left_neighbour == "L1"
    assert left.left_neighbour is None
    assert_allclose(right.centre[:, 1], 0.0)
    assert np.diff(right.centre[:, 0]).max() <= 2.0
    assert len(log.lane_map.road_edges) == 2
    assert len(log.lane_map.stop_lines) == 1
    assert len(log.lane_map.signs) == 1
    assert log.ego_log.t_us[0] == START_US
    assert log.ego_log.xyz[-1, 0] == pytest.approx(0.8 * 59)
    assert (log.vehicle.box.length_m, log.vehicle.rear_axle_to_centre_m) == (4.6, 1.4)
    parked, moving = log.actors
    assert (parked.label, parked.is_static, moving.label, moving.is_static) == (
        "truck",
        True,
        "pedestrian",
        False,
    )
    assert abs(yaw_from_quat(moving.track.quat)[-1]) == pytest.approx(
        np.pi
    )  # JSON quaternions are x, y, z, w
    assert any("no reconstruction" in note for note in log.notes)


def test_rails_as_a_struct_of_lists_give_the_same_map(tmp_path):
    one = read_usdz_scene(write(tmp_path / "a.usdz"))
    two = read_usdz_scene(write(tmp_path / "b.usdz", members() | tables(as_struct=True)))
    assert_array_equal(one.lane_map.lanes["L0"].left, two.lane_map.lanes["L0"].left)


def test_a_missing_map_is_refused_for_driving_and_left_empty_for_scoring(tmp_path):
    path = write(
        tmp_path / "a.usdz", {k: v for k, v in members().items() if not k.startswith("clipgt")}
    )
    with pytest.raises(InputError, match="a scene without a map"):
        read_usdz(path)
    assert not read_usdz_scene(path).lane_map.lanes


def test_an_unusable_folder_of_tables_passes_the_turn_to_the_next_source(tmp_path):
    content = changed(clipgt__association_dot_parquet=None)
    content |= {name.replace("clipgt", "fastmap"): data for name, data in tables().items()}
    log = read_usdz(write(tmp_path / "a.usdz", content))
    assert len(log.lane_map.lanes) == 2
    assert any("passed over: no association" in note for note in log.notes)


def test_map_data_comes_before_clipgt(tmp_path):
    content = members() | {
        name.replace("clipgt", "map_data"): data for name, data in tables().items()
    }
    rows = [{"key": key("other"), "lane": {"left_rail": rail(1.0), "right_rail": rail(-1.0)}}]
    content["map_data/lane.parquet"] = parquet(rows)
    assert list(read_usdz_scene(write(tmp_path / "a.usdz", content)).lane_map.lanes) == ["other"]


@pytest.mark.parametrize(
    "content",
    [
        changed(
            clipgt__lane_dot_parquet=parquet(
                [{"key": key("L"), "lane": {"center_line": rail(0.0)}}]
            )
        ),
        changed(
            clipgt__lane_dot_parquet=parquet(
                [
                    {
                        "key": key("L"),
                        "lane": {"left_rail": rail(1.0, 4), "right_rail": rail(0.0)},
                    }
                ]
            )
        ),
        changed(clipgt__lane_dot_parquet=b"PAR1 no"),
        changed(clipgt__road_boundary_dot_parquet=parquet([{"key": 3.0, "road_boundary": None}])),
        changed(
            clipgt__road_boundary_dot_parquet=parquet(
                [
                    {
                        "key": key("E"),
                        "road_boundary": {
                            "location": [{"x": 0, "y": 0, "z": 1e300}, {"x": 1, "y": 0, "z": 0}]
                        },
                    }
                ]
            )
        ),
        changed(metadata_dot_yaml=b"scene_id: [1"),
        changed(metadata_dot_yaml=b"!!python/object/apply:os.system ['true']"),
        changed(rig_trajectories_dot_json=json.dumps(rig() | {"rig_trajectories": []}).encode()),
        changed(rig_trajectories_dot_json=json.dumps(rig(1)).encode()),
        changed(sequence_tracks_dot_json=json.dumps(sequence() | {"t": {}}).encode()),
        changed(sequence_tracks_dot_json=None),
        changed(
            sequence_tracks_dot_json=json.dumps(sequence())
            .replace('"CONTROLLABLE"', "7")
            .encode()
            .replace(b"[7]", b"7")
        ),
    ],
)
def test_damaged_content_is_refused_with_its_place(tmp_path, content):
    with pytest.raises(InputError) as error:
        read_usdz(write(tmp_path / "a.usdz", content))
    assert "a.usdz" in error.value.message


@pytest.mark.parametrize("name", ["../evil", "/etc/x", "a/../../b", "C:\\x"])
def test_names_that_leave_the_archive_are_refused(tmp_path, name):
    with pytest.raises(InputError, match="outside the archive"):
        read_usdz(write(tmp_path / "a.usdz", members() | {name: b"x"}))
    assert [p.name for p in tmp_path.rglob("*")] == ["a.usdz"]


def test_a_member_that_stands_twice_is_refused(tmp_path):
    path = write(tmp_path / "a.usdz")
    with zipfile.ZipFile(path, "a") as z, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        z.writestr("metadata.yaml", b"scene_id: other")
    with pytest.raises(InputError):
        read_usdz(path)


@pytest.mark.parametrize(
    ("member", "limit"),
    [("metadata_dot_yaml", "YAML_BYTES"), ("rig_trajectories_dot_json", "JSON_BYTES")],
)
def test_a_member_that_is_parsed_has_the_limit_of_its_format(tmp_path, monkeypatch, member, limit):
    small = replace(getattr(usdz_archive, limit), high=20_000)
    monkeypatch.setattr(usdz_archive, limit, small)
    read_usdz(write(tmp_path / "a.usdz"))
    large = write(tmp_path / "b.usdz", changed(**{member: b" " * 20_001}))
    with pytest.raises(InputError, match="20001 bytes"):
        read_usdz(large)


def test_a_member_that_swells_beyond_the_limit_is_refused(tmp_path, monkeypatch):
    path = write(tmp_path / "a.usdz", changed(rig_trajectories_dot_json=b" " * 300_000))
    assert path.stat().st_size < 20_000
    monkeypatch.setattr(usdz_archive, "JSON_BYTES", replace(usdz_archive.JSON_BYTES, high=100_000))
    with pytest.raises(InputError, match="300000 bytes"):
        read_usdz(path)
    data = bytearray(path.read_bytes())
    at = (
        data.rindex(b"rig_trajectories.json") - 46
    )  # the central directory's entry: its stated size is a lie
    data[at + 24 : at + 28] = (1000).to_bytes(4, "little")
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"more than 100000 bytes|cannot be read"):
        read_usdz(path)


def test_checkpoints_are_named_and_never_opened(tmp_path):
    log = read_usdz(
        write(tmp_path / "a.usdz", members() | {"checkpoint.ckpt": b"\x80\x04cos\nsystem\n"})
    )
    assert any("checkpoint.ckpt (13 bytes)" in note and "not read" in note for note in log.notes)


def test_the_front_wide_camera_of_a_calibration_table(tmp_path):
    properties = {"Model": "ftheta", "width": "3848", "height": "2168", "cx": "1924", "cy": "1084"}
    properties |= {"polynomial": "0.0 0.00053 0 0 0", "polynomial-type": "pixeldistance-to-angle"}
    nominal = {"roll-pitch-yaw": [0.0, 0.0, 0.0], "t": [1.7, 0.1, 1.4]}
    sensor = {
        "name": "camera:front:wide:120fov",
        "properties": properties,
        "nominalSensor2Rig_FLU": nominal,
    }
    sensor["correction_sensor_R_FLU"] = {"roll-pitch-yaw": [0.0, 0.0, 90.0]}
    row = {"calibration_estimate": {"rig_json": json.dumps({"rig": {"sensors": [sensor]}})}}
    content = members() | {"clipgt/calibration_estimate.parquet": parquet([row])}
    (camera,) = read_usdz(write(tmp_path / "a.usdz", content)).cameras
    assert camera.name == "camera_front_wide_120fov"
    assert_allclose(camera.T_rig_camera[:3, 3], [1.7, 0.1, 1.4])
    assert_allclose(
        camera.T_rig_camera[:3, 2], [0.0, 1.0, 0.0], atol=1e-12
    )  # turned left by the correction: looks along y


FTHETA = {
    "Model": "ftheta",
    **{"width": "3848", "height": "2168", "cx": "1924", "cy": "1084"},
    **{"polynomial": "0.0 0.00053 0 0 0", "polynomial-type": "pixeldistance-to-angle"},
}


@pytest.mark.parametrize(
    ("properties", "sensor", "problem"),
    [
        ({}, {"car-mask": {}, "parameter": "", "protocol": "camera.virtual"}, ""),
        ({"windshield": "0.1 0.2"}, {}, "properties/windshield"),
        ({}, {"correction_rig_R": [0.0, 0.0, 90.0]}, "sensor/correction_rig_R"),
        ({"polynomial-type": "pixel-to-tangent"}, {}, "of type 'pixel-to-tangent'"),
    ],
)
def test_a_field_of_a_camera_that_is_not_read_is_refused_by_every_reader_of_rigs(
    tmp_path, properties, sensor, problem
):
    mount = {"roll-pitch-yaw": [0.0, 0.0, 0.0], "t": [1.7, 0.1, 1.4]}
    camera = {"name": "camera:front:wide:120fov", "nominalSensor2Rig_FLU": mount, **sensor}
    rig_json = json.dumps({"rig": {"sensors": [{**camera, "properties": FTHETA | properties}]}})
    row = {"calibration_estimate": {"rig_json": rig_json}}
    content = members() | {"clipgt/calibration_estimate.parquet": parquet([row])}
    path = write(tmp_path / "a.usdz", content)
    for cameras_of in (rig_cameras, lambda path: read_usdz(path).cameras):
        if problem:
            with pytest.raises(InputError, match=problem):
                cameras_of(path)
        else:
            (front,) = cameras_of(path)
            assert front.name == "camera_front_wide_120fov"


def test_a_scene_is_a_scenario_and_keeps_its_coordinates(tmp_path):
    scenario = load_scenario(write(tmp_path / "a.usdz"))
    assert scenario.scene_id == "small"
    assert scenario.source == "usdz"
    assert scenario.world_origin == (0.0, 0.0, 0.0)
    assert scenario.lane_map.lanes["L1"].centre[0, 1] == pytest.approx(LANE_M)
    assert len(scenario.actors) == 2


def test_golden_scenes_are_read(shared_data):
    folder = shared_data / "alpasim-golden"
    paths = sorted(folder.glob("scenes/*.usdz"))
    assert len(paths) >= 23
    for path in paths[::4]:
        scene = read_usdz_scene(path)
        assert scene.scene_id == path.stem
        assert scene.lane_map.lanes
    with pytest.raises(InputError, match="left_rail"):
        read_usdz_scene(next(folder.glob("cases/lane-without-rail-columns/scenes/*.usdz")))
    assert not read_usdz_scene(next(folder.glob("cases/no-map/scenes/*.usdz"))).lane_map.lanes


def test_a_segment_of_exactly_two_metres_is_split_as_in_alpasims_loader(tmp_path):
    rows = [{"key": key("L"), "lane": {"left_rail": rail(1.0, 61), "right_rail": rail(-1.0, 61)}}]
    scene = read_usdz_scene(
        write(tmp_path / "a.usdz", changed(clipgt__lane_dot_parquet=parquet(rows)))
    )
    assert len(scene.lane_map.lanes["L"].centre) == 121


def test_what_is_not_read_of_a_scene_is_named(tmp_path):
    assert "not read are" not in str(read_usdz(write(tmp_path / "a.usdz")).notes)
    lanes = [
        {"key": key("L0"), "lane": {"left_rail": rail(1.8), "right_rail": rail(-1.8), "speed": 9.0}}
    ]
    drive = rig()
    drive["rig_trajectories"][0]["T_rig_worlds_smoothed"] = []
    content = changed(
        clipgt__lane_dot_parquet=parquet(lanes),
        clipgt__crosswalk_dot_parquet=parquet([{"key": key("c")}]),
        rig_trajectories_dot_json=json.dumps(drive).encode(),
        mesh_ground_dot_ply=b"ply",
    )
    notes = str(read_usdz(write(tmp_path / "b.usdz", content)).notes)
    for name in (
        "lane/speed",
        "tables/crosswalk",
        "rig_trajectory/T_rig_worlds_smoothed",
        "archive/mesh_ground.ply",
    ):
        assert f"{name} (1)" in notes


def test_a_body_that_is_turned_against_the_rig_is_refused(tmp_path):
    drive = rig()
    drive["rig_trajectories"][0]["rig_bbox"]["rot"] = [0.0, 0.0, 0.1]
    content = changed(rig_trajectories_dot_json=json.dumps(drive).encode())
    with pytest.raises(InputError, match="turned against the rig"):
        read_usdz(write(tmp_path / "a.usdz", content))
