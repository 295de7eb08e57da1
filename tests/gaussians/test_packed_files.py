"""Compressed PLY, .splat and SPZ: real files against each other, made-up ones against hand-worked
bytes.
"""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import matrix_from_quat, unit
from alpasim_plugin.gaussians import read_ply
from alpasim_plugin.gaussians.cloud import GaussianArrays, quat_multiply
from alpasim_plugin.gaussians.files import read_gaussians
from alpasim_plugin.gaussians.files.packed import (
    DIRECTIONS,
    in_ply_axes,
    read_compressed_ply,
    read_splat,
    read_spz,
    unpack_rotation,
    unpack_smallest_three,
)
from alpasim_plugin.gaussians.files.ply import read_ply_header
from alpasim_plugin.gaussians.sh import C0, rotate_sh
from tests.examples import examples
from tests.gaussians.packed_writers import body_streams, write_compressed, write_spz


@pytest.fixture
def biker(shared_data):
    return shared_data / "gaussians"


def as_stored(arrays):
    """Turn a model that was read from SPZ back into the axes of its file."""
    return arrays._replace(
        means=arrays.means * np.array([1, -1, -1]),
        quats=quat_multiply(np.array([0.0, -1.0, 0.0, 0.0]), arrays.quats),
        sh=rotate_sh(arrays.sh, np.diag([1.0, -1.0, -1.0])),
    )


# --- one model in two files


def test_both_bikers_have_the_published_facts(biker):
    ply = read_compressed_ply(biker / "biker.compressed.ply")
    spz = as_stored(read_spz(biker / "biker.spz"))
    assert len(ply.means) == len(spz.means) == 152746
    assert read_ply_header(biker / "biker.compressed.ply").element("chunk").count == 597
    low = (-0.62126, -3.18008, -0.53226)
    high = (0.41440, 0.0, 0.61328)
    assert_allclose(ply.means.min(axis=0), low, atol=6e-6)
    assert_allclose(ply.means.max(axis=0), high, atol=6e-6)
    assert f"{ply.opacities.mean():.10f}" == f"{spz.opacities.mean():.10f}" == "0.2966253344"


def test_plain_reader_points_to_the_right_one_for_a_compressed_ply(biker):
    with pytest.raises(InputError) as caught:
        read_ply(biker / "biker.compressed.ply")
    assert "read_gaussians" in caught.value.hint


# --- compressed PLY, worked by hand


def test_packed_bits_are_spread_over_the_chunk(tmp_path):
    position = 2047 << 21 | 0 << 11 | 2047
    colour = 255 << 24 | 0 << 16 | 51 << 8 | 102
    path = write_compressed(
        tmp_path / "a.compressed.ply", 1, 1, (position, 511 << 20 | 511 << 10 | 511, 0, colour)
    )
    raw = read_compressed_ply(path)
    assert_allclose(raw.means, [[2, 10, 22]])
    assert_allclose(raw.scales, np.exp([[-3, -3, -3]]))
    assert_allclose(raw.sh[0, 0], (np.array([1, 0, 0.2]) - 0.5) / C0, rtol=1e-6)
    assert raw.opacities[0] == pytest.approx(0.4)
    assert_allclose(raw.quats[0], [1, 0, 0, 0], atol=1e-3)


def test_harmonics_element_is_channel_major(tmp_path):
    table = np.full(9, 128, dtype=np.uint8)
    table[1] = 255  # red, second coefficient
    raw = read_compressed_ply(
        write_compressed(tmp_path / "a.compressed.ply", 1, 1, (0, 0, 0, 0), table.tobytes(), 9)
    )
    assert raw.sh.shape == (1, 4, 3)
    assert raw.sh[0, 2, 0] == 4
    assert_allclose(np.delete(raw.sh[0, 1:].ravel(), 3), 0.5 / 256 * 8)


@pytest.mark.parametrize("largest", range(4))
def test_left_out_component_is_restored_in_its_place(largest):
    quat = np.array([0.1, -0.2, 0.3, 0.15])
    quat[largest] = 0
    quat[largest] = np.sqrt(1 - quat @ quat)
    others = [round((q / np.sqrt(2) + 0.5) * 1023) for i, q in enumerate(quat) if i != largest]
    packed = largest << 30 | others[0] << 20 | others[1] << 10 | others[2]
    assert_allclose(unpack_rotation(np.array([packed], dtype=np.uint32))[0], quat, atol=1e-3)


# --- .splat


def test_splat_bytes_worked_by_hand(tmp_path):
    row = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 128, 192, 128, 64, 128)
    (tmp_path / "a.splat").write_bytes(row)
    raw = read_splat(tmp_path / "a.splat")
    assert_array_equal(raw.quats, [[0.5, 0, -0.5, 0]])
    assert_allclose(0.5 + C0 * raw.sh[0, 0], [1, 0, 0.2], atol=1e-6)
    assert raw.opacities[0] == 128 / 255


@pytest.mark.parametrize("size", [0, 1, 31, 33, 63])
def test_splat_of_broken_size_is_refused(tmp_path, size):
    (tmp_path / "a.splat").write_bytes(bytes(size))
    with pytest.raises(InputError):
        read_splat(tmp_path / "a.splat")


# --- SPZ, worked by hand


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_every_version_unpacks_to_the_same_numbers(tmp_path, version, degree):
    streams = body_streams(version, 6, degree)
    streams[0] = b"".join(int(v).to_bytes(3, "little", signed=True) for v in range(-9, 9))
    raw = as_stored(read_spz(write_spz(tmp_path / "a.spz", version, 6, degree, streams)))
    assert_array_equal(raw.means, np.arange(-9, 9).reshape(6, 3) / 4096)
    assert_array_equal(raw.opacities, np.frombuffer(streams[1], dtype=np.uint8) / 255)
    colour, scale = (np.frombuffer(s, dtype=np.uint8).reshape(6, 3) for s in streams[2:4])
    assert_allclose(raw.sh[:, 0], (colour / 255 - 0.5) / 0.15, rtol=1e-6, atol=1e-7)
    assert_allclose(raw.scales, np.exp(scale / 16 - 10))
    harmonics = np.frombuffer(streams[5], dtype=np.uint8).reshape(6, -1, 3)
    assert_allclose(raw.sh[:, 1:], (harmonics - 128.0) / 128, atol=1e-6)
    cloud, report = read_gaussians(tmp_path / "a.spz")
    assert report.n_kept == len(cloud) == 6


def test_version_2_rotation_is_xyz_bytes(tmp_path):
    streams = body_streams(2, 1, 0)
    streams[4] = bytes([255, 128, 127])
    quat = as_stored(read_spz(write_spz(tmp_path / "a.spz", 2, 1, 0, streams))).quats[0]
    assert_allclose(quat, [0, 1, 1 / 255, -1 / 255], atol=1e-2)


@settings(max_examples=examples(200), deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: max(map(abs, q)) > 0.1))
def test_smallest_three_rotation_is_restored(q):
    xyzw = np.array(q) / np.linalg.norm(q)
    largest = int(np.argmax(np.abs(xyzw)))
    xyzw = xyzw * np.copysign(1, xyzw[largest])
    word = largest
    for i in range(4):
        if i != largest:
            word = word << 10 | (xyzw[i] < 0) << 9 | round(abs(xyzw[i]) * np.sqrt(2) * 511)
    packed = np.frombuffer(struct.pack("<I", word), dtype=np.uint8)
    wxyz = unpack_smallest_three(packed)[0]
    assert abs(np.linalg.norm(wxyz) - 1) < 1e-6
    assert_allclose(wxyz, xyzw[[3, 0, 1, 2]], atol=2.5e-3)


def test_fourth_degree_is_cut_and_noted(tmp_path):
    cloud, report = read_gaussians(write_spz(tmp_path / "a.spz", 4, 2, 4, body_streams(4, 2, 4)))
    assert cloud.sh.shape == (2, 16, 3)
    assert "degree 4" in str(report.notes)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_count_beyond_the_data_is_refused_without_unpacking_it(tmp_path, version):
    path = write_spz(
        tmp_path / "a.spz", version, 2, 0, body_streams(version, 2, 0), claim=100_000_000
    )
    with pytest.raises(InputError):
        read_gaussians(path)


def test_unknown_version_and_wrong_magic_are_refused(tmp_path):
    (tmp_path / "a.spz").write_bytes(b"NGSP" + struct.pack("<II", 9, 1) + bytes(40))
    with pytest.raises(InputError):
        read_spz(tmp_path / "a.spz")
    (tmp_path / "a.spz").write_bytes(b"GLTF" + bytes(60))
    with pytest.raises(InputError):
        read_spz(tmp_path / "a.spz")


# --- dispatch


def test_content_decides_before_the_suffix(tmp_path, biker):
    (tmp_path / "model.bin").write_bytes((biker / "train-1000.ply").read_bytes())
    assert len(read_gaussians(tmp_path / "model.bin")[0]) == 1000


def test_unknown_form_lists_the_known_ones(tmp_path):
    (tmp_path / "a.gltf").write_bytes(b"PK\x03\x04....")
    with pytest.raises(InputError):
        read_gaussians(tmp_path / "a.gltf")


def test_chunks_that_do_not_cover_the_gaussians_are_refused(tmp_path):
    path = write_compressed(tmp_path / "a.compressed.ply", 257, 1, (0, 0, 0, 0))
    with pytest.raises(InputError):
        read_compressed_ply(path)


@pytest.mark.parametrize("system", ["RUB", "LUF", "FLU", "BRU", "RFU"])
def test_an_ellipsoid_in_other_axes_keeps_its_place_and_its_shape(system):
    means = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 2.0]], dtype=np.float32)
    quats = unit(np.array([[0.9, 0.3, -0.2, 0.1], [0.2, -0.6, 0.5, 0.7]])).astype(np.float32)
    scales = np.array([[0.1, 0.2, 0.4], [0.3, 0.05, 0.6]], dtype=np.float32)
    sh = np.zeros((2, 1, 3), dtype=np.float32)
    arrays = GaussianArrays(means, quats, scales, np.ones(2), sh)
    M = np.array([DIRECTIONS[letter] for letter in system], dtype=np.float64).T
    turned = in_ply_axes(arrays, system)
    assert_allclose(turned.means, means @ M.T, atol=1e-6)
    for row in range(2):
        before = matrix_from_quat(quats[row]) * scales[row]
        after = matrix_from_quat(turned.quats[row]) * scales[row]
        assert_allclose(after @ after.T, M @ before @ before.T @ M.T, atol=1e-6)
