"""Argoverse 2 folders that are no log: each is refused with its file and what was found."""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from scenarios.argoverse import read_argoverse, read_calibration
from tests.scenarios.make_argoverse import (
    STEP_NS,
    T0_NS,
    TRACKS,
    cuboids,
    lane,
    line,
    poses,
    vector_map,
    write_argoverse,
    write_feather,
)


def refused(folder):
    with pytest.raises(InputError) as caught:
        read_argoverse(folder)
    error = caught.value
    assert error.exit_code == 2
    return error


def damaged(name, change):
    """Change the bytes of a file; None removes it."""

    def make(folder):
        path = next(write_argoverse(folder).glob(name))
        data = path.read_bytes()
        path.unlink()
        if change is not None:
            path.write_bytes(change(data))

    return make


def header(text):
    return lambda _: b"\x93NUMPY\x01\x00" + (len(text) + 1).to_bytes(2, "little") + text + b"\n"


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("city_SE3_egovehicle.feather", None),
        ("map/log_map_archive_*.json", None),
        ("map/*___img_Sim2_city.json", None),
        *[
            (name, lambda data, keep=keep: data[:keep])
            for name in ("city_SE3_egovehicle.feather", "annotations.feather")
            for keep in (0, 5, 1000, -10)
        ],
        ("map/log_map_archive_*.json", lambda data: data[:500]),
        ("map/*.npy", lambda data: data[:4000]),
        ("map/*.npy", header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (9**9,), }")),
        ("map/*.npy", header(b"[]")),
    ],
)
def test_a_missing_or_damaged_file_is_named(tmp_path, name, change):
    damaged(name, change)(tmp_path / "x")
    assert name.split("*")[0].rpartition("/")[0] in refused(tmp_path / "x").message


def test_two_maps_are_ambiguous(tmp_path):
    folder = write_argoverse(tmp_path / "x")
    (folder / "map" / "log_map_archive_y____PIT_city_2.json").write_text("{}")
    refused(folder)


def without(layer, key=None):
    document = vector_map()
    if key is None:
        document[layer] = {}
    else:
        del document[layer]["1"][key]
    return document


def with_lane(length_m=10, **changed):
    return vector_map() | {"lane_segments": {"1": lane(1, 0, length_m, 0, **changed)}}


@pytest.mark.parametrize(
    "document",
    [
        without("lane_segments"),
        without("drivable_areas"),
        without("lane_segments", "left_lane_boundary"),
        {"lane_segments": {}},
        [],
        with_lane(lane_type="RIVER"),
        with_lane(left_lane_boundary=line((0, 2))),
        with_lane(float("nan")),
        with_lane(4e6),
    ],
)
def test_map_without_what_every_map_has(tmp_path, document):
    assert "log_map_archive" in refused(write_argoverse(tmp_path / "x", document=document)).message


def bad_poses(name, row, value):
    ego = poses()
    ego[name][row] = value
    return ego


@pytest.mark.parametrize(
    ("ego", "found"),
    [
        (bad_poses("timestamp_ns", 5, T0_NS), "row 5"),
        (bad_poses("timestamp_ns", 5, T0_NS + 4 * STEP_NS), "row 5"),
        (bad_poses("qw", 3, 0.0), "row 3"),
        (bad_poses("qw", 3, 2.0), "row 3"),
        (bad_poses("tx_m", 4, np.nan), "row 4"),
        (poses() | {"timestamp_ns": poses()["timestamp_ns"].astype(float)}, "timestamp_ns"),
        ({k: v for k, v in poses().items() if k != "qz"}, "qz"),
    ],
)
def test_poses_that_are_no_drive(tmp_path, ego, found):
    error = refused(write_argoverse(tmp_path / "x", ego=ego, annotations=cuboids(TRACKS)))
    assert found in error.message
    assert "city_SE3_egovehicle.feather" in error.message


@pytest.mark.parametrize(
    ("name", "value"),
    [("timestamp_ns", T0_NS + 7), ("timestamp_ns", T0_NS), ("qw", 0.0), ("tx_m", np.inf)],
)
def test_cuboids_that_are_no_tracks(tmp_path, name, value):
    rows = {k: np.array(v) for k, v in cuboids(TRACKS).items()}
    rows[name][2] = value
    error = refused(write_argoverse(tmp_path / "x", annotations=rows))
    assert "annotations.feather" in error.message


def test_a_coefficient_of_a_calibration_that_is_not_read_is_refused(tmp_path):
    inner = {"sensor_name": ["front"]}
    for name in ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px"):
        inner[name] = [100.0]
    outer = {"sensor_name": ["front"], "qw": [1.0]}
    outer |= {name: [0.0] for name in ("qx", "qy", "qz", "tx_m", "ty_m", "tz_m")}
    (tmp_path / "calibration").mkdir()
    write_feather(tmp_path / "calibration/egovehicle_SE3_sensor.feather", outer)
    write_feather(tmp_path / "calibration/intrinsics.feather", inner)
    (camera,) = read_calibration(tmp_path)
    assert camera.lens.coefficients == (100.0, 100.0, 0.0, 0.0, 100.0)
    write_feather(tmp_path / "calibration/intrinsics.feather", inner | {"p1": [0.1]})
    with pytest.raises(InputError, match="intrinsics/p1"):
        read_calibration(tmp_path)


def test_log_without_calibration(tmp_path):
    with pytest.raises(InputError):
        read_calibration(tmp_path)
