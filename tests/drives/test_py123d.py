"""Logs of py123d give the same street as every other form, with its road users."""

import json
import shutil

import msgpack
import numpy as np
import pyarrow as pa
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.drives.build import import_drive
from alpasim_plugin.drives.opening import read_source
from scenarios.load import load_scenario
from tests.drives.opened_drives import assert_is_the_street, opened
from tests.drives.py123d_log import ORIGIN, TYPES, write_py123d
from tests.drives.street import COUNT, K
from tests.examples import first_of


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_py123d(tmp_path_factory.mktemp("py123d") / "log")


def test_a_log_is_the_street_with_its_vehicle_and_the_car_that_moves(log):
    drive, placed = opened(log)
    assert (drive.kind, drive.scene_id, drive.front) == ("py123d", "street-1", "pcam_f0")
    assert_is_the_street(placed)
    # The log counts pixels from the middle of the first one.
    assert np.allclose(drive.photographs[0].lens.K, K)
    assert placed.mounts["pcam_f0"][:2, 3] == pytest.approx([1.2, 0.1])
    assert (drive.vehicle.box.length_m, drive.vehicle.rear_axle_to_centre_m) == (5.0, 1.5)
    (car,) = placed.actors
    assert (car.actor_id, car.label, car.box.width_m) == ("a1", "car", 1.8)
    way = interpolate(car.track, 1_000_000)[:2, 3] - interpolate(car.track, 0)[:2, 3]
    assert np.linalg.norm(way) == pytest.approx(5.0, rel=0.03)
    assert "lidar.lidar_top" in str(drive.notes)


@pytest.mark.parametrize("codec", first_of(sorted(TYPES)))
def test_images_are_read_however_they_are_kept(tmp_path, log, codec):
    drive = read_source(write_py123d(tmp_path / codec, codec, implicit_poses=True))
    truth = read_source(log)
    assert len(drive.photographs) == COUNT
    one = drive.photographs[5]
    other = truth.photographs[5]
    assert np.abs(one.rgb().astype(float) - other.rgb()).mean() < 12
    assert one.T_world_camera == pytest.approx(other.T_world_camera)
    assert one.T_world_camera[:2, 3] == pytest.approx(ORIGIN[:2] + np.array([3.0, 0.0]), abs=0.1)


def test_photographs_without_a_pose_of_their_own_need_one_of_the_ego_at_their_time(log, tmp_path):
    folder = shutil.copytree(log, tmp_path / "log")
    ego = folder / "ego_state_se3.arrow"
    rewritten(ego, pa.ipc.open_file(pa.BufferReader(ego.read_bytes())).read_all().slice(2, 19))
    camera = folder / "camera.pcam_f0.arrow"
    table = pa.ipc.open_file(pa.BufferReader(camera.read_bytes())).read_all()
    name = "camera.pcam_f0.camera_to_global_se3"
    column = table.schema.get_field_index(name)
    field = table.schema.field(column)
    rewritten(camera, table.set_column(column, field, pa.nulls(COUNT, field.type)))
    drive = read_source(folder)
    assert len(drive.photographs) == 19
    assert "pcam_f0: 5 photographs before or after the ego's poses" in str(drive.notes)


def rewritten(path, table):
    """Write a table over a file, with its schema's metadata."""
    path.unlink()
    with pa.ipc.new_file(str(path), table.schema) as file:
        file.write_table(table)


@pytest.mark.slow
def test_an_imported_log_drives_with_its_road_user(log, tmp_path, quick_fit):
    import_drive(log, tmp_path / "out")
    scenario = load_scenario(tmp_path / "out/scenario.yaml")
    car = next(one for one in scenario.actors if one.actor_id == "a1")
    assert (car.label, car.is_static, len(car.track)) == ("car", False, COUNT)
    assert scenario.vehicle.wheelbase_m == 3.0
    assert "nobody moves" not in str(json.loads((tmp_path / "out/quality.json").read_text()))


@pytest.mark.parametrize("name", ["sync", "ego_state_se3", "camera.pcam_f0", "box_detections_se3"])
@pytest.mark.parametrize("fault", ["of another schema", "without metadata", "cut off"])
def test_a_file_that_is_none_of_py123d_is_named(log, tmp_path, name, fault):
    folder = shutil.copytree(log, tmp_path / "log")
    path = folder / f"{name}.arrow"
    if fault == "cut off":
        path.write_bytes(path.read_bytes()[:-300])
    else:
        facts = {b"metadata": msgpack.packb({"name": 1})} if fault == "of another schema" else {}
        table = pa.table({"a": [1]}).replace_schema_metadata(facts)
        with pa.ipc.new_file(str(path), table.schema) as file:
            file.write_table(table)
    with pytest.raises(InputError) as caught:
        read_source(folder)
    assert f"{name}.arrow" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "fact"),
    [
        ("ego_state_se3", {"center_to_imu_se3": [float("nan"), 0, 0, 1, 0, 0, 0]}),
        ("camera.pcam_f0", {"camera_to_imu_se3": [0.0] * 7}),
        ("camera.pcam_f0", {"first_frame": -1}),
        ("box_detections_se3", {"box_detection_label_class": "WODPerceptionBoxDetectionLabel"}),
    ],
)
def test_facts_that_cannot_be_are_refused(tmp_path, name, fact):
    """A frame before the film's first, a label beyond the last of the classes among them."""
    codec = "mp4" if "first_frame" in fact else "jpeg_binary"
    folder = write_py123d(tmp_path / "log", codec, label=9, first_frame=fact.get("first_frame", 0))
    path = folder / f"{name}.arrow"
    with pa.ipc.open_file(pa.BufferReader(path.read_bytes())) as file:
        table = file.read_all()
    facts = msgpack.unpackb(table.schema.metadata[b"metadata"]) | fact
    table = table.replace_schema_metadata({b"metadata": msgpack.packb(facts)})
    with pa.ipc.new_file(str(path), table.schema) as file:
        file.write_table(table)
    with pytest.raises(InputError) as caught:
        read_source(folder)
    assert f"{name}.arrow" in str(caught.value)


def test_columns_and_facts_that_are_not_read_are_named(tmp_path, log):
    folder = shutil.copytree(log, tmp_path / "log")
    path = folder / "camera.pcam_f0.arrow"
    table = pa.ipc.open_file(str(path)).read_all()
    facts = msgpack.unpackb(table.schema.metadata[b"metadata"])
    packed = msgpack.packb({**facts, "readout_us": 20_000})
    table = table.append_column("camera.pcam_f0.exposure_us", table.column(0))
    table = table.replace_schema_metadata({b"metadata": packed})
    path.unlink()
    with pa.ipc.new_file(str(path), table.schema) as file:
        file.write_table(table)
    notes = str(read_source(folder).notes)
    for name in ("camera@readout_us", "camera/exposure_us", "log/lidar.lidar_top"):
        assert f"{name} (1)" in notes
    assert "camera/data" not in notes


def test_the_box_of_the_ego_itself_is_no_road_user(tmp_path):
    drive = read_source(write_py123d(tmp_path / "log", classes="Default", label=0))
    assert not drive.actors
    assert "track a1, are left out" in str(drive.notes)


@pytest.mark.parametrize(
    ("classes", "label", "expected"),
    [("WODMotion", 3, "cyclist"), ("Griffin", 3, "bus"), ("Nureasoning", 9, "motorcycle")],
)
def test_classes_of_data_sets_that_version_0_7_added(tmp_path, classes, label, expected):
    drive = read_source(write_py123d(tmp_path / "log", classes=classes, label=label))
    assert [actor.label for actor in drive.actors] == [expected]
