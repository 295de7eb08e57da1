"""Argoverse 2 folders that are no log: each is refused with its file and what was found."""

from __future__ import annotations

from pathlib import Path

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
)


def refused(folder):
    with pytest.raises(InputError) as caught:
        read_argoverse(folder)
    error = caught.value
    assert error.exit_code == 2
    return error


@pytest.mark.parametrize(
    "name",
    [
        "city_SE3_egovehicle.feather",
        "map/log_map_archive_x____PIT_city_1.json",
        "map/x___img_Sim2_city.json",
    ],
)
def test_missing_file_is_named_by_its_pattern(tmp_path, name):
    folder = write_argoverse(tmp_path / "x")
    (folder / name).unlink()
    error = refused(folder)
    assert "no file " in error.message
    assert Path(name).stem.split("_x_")[0].removeprefix("x___") in error.message


@pytest.mark.parametrize("name", ["city_SE3_egovehicle.feather", "annotations.feather"])
@pytest.mark.parametrize("keep", [0, 5, 1000, -10])
def test_truncated_feather(tmp_path, name, keep):
    path = write_argoverse(tmp_path / "x") / name
    path.write_bytes(path.read_bytes()[:keep])
    error = refused(path.parent)
    assert str(path) in error.message
    assert "empty file" in error.message or "no readable Arrow IPC file" in error.message
    assert "fetch the file again" in error.hint


def test_truncated_map(tmp_path):
    folder = write_argoverse(tmp_path / "x")
    path = next(folder.glob("map/log_map_archive_*.json"))
    path.write_bytes(path.read_bytes()[:500])
    error = refused(folder)
    assert str(path) in error.message
    assert "broken JSON" in error.message


def test_truncated_raster(tmp_path):
    folder = write_argoverse(tmp_path / "x")
    path = next(folder.glob("map/*.npy"))
    path.write_bytes(path.read_bytes()[:4000])
    assert "no readable NumPy array" in refused(folder).message


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999999,), }",
        b"{'descr': (((",
        b"[]",
    ],
)
def test_raster_with_a_broken_header(tmp_path, header):
    folder = write_argoverse(tmp_path / "x")
    path = next(folder.glob("map/*.npy"))
    path.write_bytes(
        b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n"
    )
    error = refused(folder)
    assert str(path) in error.message
    assert "no readable NumPy array" in error.message


def test_one_point_on_another_continent(tmp_path):
    error = refused(
        write_argoverse(
            tmp_path / "x", document=vector_map() | {"lane_segments": {"1": lane(1, 0, 4e6, 0)}}
        )
    )
    assert "a point 4000.0 km from the drive" in error.message
    assert "lane 1" in error.message


def test_two_maps_are_ambiguous(tmp_path):
    folder = write_argoverse(tmp_path / "x")
    (folder / "map" / "log_map_archive_y____PIT_city_2.json").write_text("{}")
    assert "2 files match" in refused(folder).message


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
        (
            without(vector_map(), "lane_segments", "left_lane_boundary"),
            "no usable left_lane_boundary",
        ),
        ({"lane_segments": {}}, "no object 'drivable_areas'"),
        ([], "no object 'lane_segments'"),
        (
            vector_map() | {"lane_segments": {"1": lane(1, 0, 10, 0, lane_type="RIVER")}},
            "lane type 'RIVER'",
        ),
        (
            vector_map()
            | {"lane_segments": {"1": lane(1, 0, 10, 0, left_lane_boundary=line((0, 2)))}},
            "boundary with 1 finite points",
        ),
        (vector_map() | {"lane_segments": {"1": lane(1, 0, float("nan"), 0)}}, "broken JSON"),
    ],
)
def test_map_without_what_every_map_has(tmp_path, document, found):
    error = refused(write_argoverse(tmp_path / "x", document=document))
    assert found in error.message
    assert "log_map_archive" in error.message


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
        (
            poses() | {"timestamp_ns": poses()["timestamp_ns"].astype(float)},
            "column 'timestamp_ns' of double",
        ),
        ({k: v for k, v in poses().items() if k != "qz"}, "no column 'qz'"),
    ],
)
def test_poses_that_are_no_drive(tmp_path, ego, found):
    error = refused(write_argoverse(tmp_path / "x", ego=ego, annotations=cuboids(TRACKS)))
    assert found in error.message
    assert "city_SE3_egovehicle.feather" in error.message


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
    assert found in error.message
    assert "annotations.feather" in error.message


def test_log_without_calibration(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_calibration(tmp_path)
