"""Gaussian models as other tools write them: what changes the drawing is applied, noted or refused
by name.

Every file is made here.
"""

import gzip
import itertools
import json
import struct

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianArrays, build_cloud
from alpasim_plugin.gaussians.constants import EPS2D_PX2, MIP_PX2
from alpasim_plugin.gaussians.files import read_gaussians
from alpasim_plugin.gaussians.files.packed import in_ply_axes
from alpasim_plugin.gaussians.files.ply import ply_rows, read_ply_arrays, write_ply
from alpasim_plugin.gaussians.fit.photographs import read_points
from alpasim_plugin.gaussians.raster.rasterize import rasterize
from alpasim_plugin.gaussians.sh import sh_basis
from tests.gaussians.gaussian_scenes import covariances
from tests.gaussians.packed_writers import body_streams, write_compressed
from tests.gaussians.packed_writers import write_spz as plain_spz
from tests.gaussians.ply_writers import NAMES, element, make_cloud, write_elements
from tests.gaussians.sog_writer import write_sog


def model(path, more=None, comments="", without=""):
    """Write five Gaussians with further properties and comments."""
    rows = ply_rows(make_cloud(k=1))
    names = [name for name in rows.dtype.names or () if name != without]
    columns = [rows[name] for name in names] + [np.full(5, v) for v in (more or {}).values()]
    part = element("vertex", [*names, *(more or {})], np.stack(columns, axis=1))
    write_elements(path, part)
    path.write_bytes(path.read_bytes().replace(b"comment made by a test\n", comments.encode()))
    return path


def opened(path):
    return read_gaussians(path)


@pytest.mark.parametrize(
    "name",
    [
        *("trbf_center", "trbf_scale", "motion_0", "omega_0"),  # spacetime Gaussians
        *("t", "scale_t", "rot_r_0", "f_t_0", "f_dc_3"),  # four-dimensional ones
        *("sg_axis_0", "beta", "metallic", "scale_3"),
        *("object_motion_0", "instance_opacity", "label_scale", "identity", "red_0"),
    ],
)
def test_a_property_that_changes_the_drawing_is_refused_by_name(tmp_path, name):
    with pytest.raises(InputError, match=name):
        opened(model(tmp_path / "a.ply", {name: 0.5}))


@pytest.mark.parametrize(
    "name", ["red", "obj_dc_0", "semantic_12", "label", "instance_id", "ins_feat_r2"]
)
def test_a_property_of_which_nothing_is_drawn_is_skipped(tmp_path, name):
    plain, _ = opened(model(tmp_path / "a.ply"))
    cloud, report = opened(model(tmp_path / "b.ply", {name: 0.5}))
    assert np.array_equal(cloud.scales, plain.scales)
    assert not report.notes


def test_a_property_that_is_neutral_in_every_row_changes_nothing(tmp_path):
    plain, _ = opened(model(tmp_path / "a.ply"))
    for name in ("transform", "motion_0"):
        same, report = opened(model(tmp_path / "b.ply", {name: 0.0}))
        assert np.array_equal(same.means, plain.means)
        assert any(name in note for note in report.notes)
        with pytest.raises(InputError, match=name):
            opened(model(tmp_path / "c.ply", {name: 1.0}))


@pytest.mark.parametrize("name", ["opacity", "scale_2"])
def test_whole_numbers_are_no_logit_and_no_logarithm(tmp_path, name):
    path = model(tmp_path / "a.ply", {name: 0.5}, without=name)
    path.write_bytes(path.read_bytes().replace(b"float " + name.encode(), b"int " + name.encode()))
    with pytest.raises(InputError, match=name):
        opened(path)


@pytest.mark.parametrize("name", ["filter_3D", "filter_3d"])
def test_the_3d_filter_is_applied_as_published(tmp_path, name):
    plain = read_ply_arrays(model(tmp_path / "a.ply"))
    cloud, report = opened(model(tmp_path / "b.ply", {name: 0.05}))
    wider = np.sqrt(plain.scales**2 + np.float64(np.float32(0.05)) ** 2)
    assert np.allclose(cloud.scales, wider, rtol=1e-12)
    fainter = plain.opacities * (plain.scales / wider).prod(axis=1)
    assert np.allclose(cloud.opacities, fainter, rtol=1e-12)
    assert "filter" in str(report.notes)
    assert cloud.antialias_px2 == MIP_PX2


def test_2d_gaussians_are_drawn_flat(tmp_path):
    plain, _ = opened(model(tmp_path / "a.ply"))
    cloud, report = opened(model(tmp_path / "b.ply", without="scale_2"))
    assert np.array_equal(cloud.scales[:, :2], plain.scales[:, :2])
    assert (cloud.scales[:, 2] < 0.01 * cloud.scales[:, :2].min(axis=1)).all()
    assert "2D" in str(report.notes)
    camera = PinholeCamera.from_pose(32, 32, np.diag([20.0, 20.0, 1.0]), np.eye(4))
    assert np.isfinite(rasterize(cloud, camera).rgb).all()


@pytest.mark.parametrize(
    ("comments", "noted"),
    [
        ("comment SplatRenderMode: default\n", "SplatRenderMode: default"),
        ("comment Vertical Axis: z\n", "Vertical Axis: z"),
        ("obj_info coordinate_system RUB\n", "coordinate_system RUB"),
    ],
)
def test_what_comments_state_of_the_drawing_is_noted(tmp_path, comments, noted):
    _, report = opened(model(tmp_path / "a.ply", comments=comments))
    assert any(noted in note for note in report.notes)
    _, plain = opened(model(tmp_path / "b.ply", comments="comment Generated by a tool\n"))
    assert not plain.notes


@pytest.mark.parametrize(
    ("comments", "antialias_px2"),
    [
        ("comment Exported from Brush\ncomment SplatRenderMode: mip\n", MIP_PX2),
        ("comment splatrendermode: MIP\n", MIP_PX2),
        ("comment antialiased 1\n", EPS2D_PX2),
        ("comment antialiased 0\n", 0.0),
        ("comment antialiased 1\ncomment SplatRenderMode: default\n", 0.0),
    ],
)
def test_antialiasing_that_comments_state_is_drawn_and_written(tmp_path, comments, antialias_px2):
    cloud, report = opened(model(tmp_path / "a.ply", comments=comments))
    assert cloud.antialias_px2 == antialias_px2
    assert ("antialiasing" in str(report.notes)) == (antialias_px2 > 0)
    write_ply(tmp_path / "b.ply", cloud.take([2, 0]))
    assert opened(tmp_path / "b.ply")[0].antialias_px2 == antialias_px2


def test_elements_of_sharp_are_known_and_its_linear_colours_refused(tmp_path):
    rows = ply_rows(make_cloud(k=1))
    table = np.stack([rows[name] for name in NAMES], axis=1)
    vertex = element("vertex", NAMES, table)
    beside = element("extrinsic", ["extrinsic"], np.zeros((16, 1)))
    for space, rest in ((0.0, None), (1.0, "color_space")):
        colours = element("color_space", ["color_space"], np.full((1, 1), space))
        path = write_elements(tmp_path / "a.ply", vertex, beside, colours)
        if rest is None:
            assert len(opened(path)[0]) == 5
        else:
            with pytest.raises(InputError, match=rest):
                opened(path)
    odd = element("lens", ["k1"], np.zeros((1, 1)))
    with pytest.raises(InputError, match="lens"):
        opened(write_elements(tmp_path / "b.ply", vertex, odd))


def test_a_text_ply_is_the_same_model_and_the_same_points(tmp_path):
    cloud = make_cloud(k=4)
    write_ply(tmp_path / "a.ply", cloud)
    rows = ply_rows(cloud)
    names = rows.dtype.names or ()
    head = "".join(f"property float {name}\n" for name in names)
    body = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in rows)
    count = f"element camera 1\nproperty float f\nelement vertex {len(rows)}\n"
    text = f"ply\nformat ascii 1.0\n{count}{head}end_header\n5\n{body}"
    (tmp_path / "b.ply").write_text(text)
    with pytest.raises(InputError, match="camera"):
        opened(tmp_path / "b.ply")
    text = text.replace("element camera 1\nproperty float f\n", "").replace("\n5\n", "\n")
    (tmp_path / "b.ply").write_text(text)
    one = opened(tmp_path / "a.ply")[0]
    two = opened(tmp_path / "b.ply")[0]
    assert all(
        np.array_equal(x, y) for x, y in zip(vars(one).values(), vars(two).values(), strict=True)
    )
    (tmp_path / "b.ply").write_text(text.rsplit("\n", 2)[0] + "\n")
    with pytest.raises(InputError, match="4 of 5"):
        opened(tmp_path / "b.ply")
    points = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    points += "property float z\nproperty uint8 red\nproperty uint8 green\nproperty uint8 blue\n"
    (tmp_path / "points.ply").write_text(points + "end_header\n1 2 3 255 0 0\n4 5 6 0 0 255\n")
    cloud = read_points(tmp_path / "points.ply")
    assert cloud.means.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.sh[0, 0, 0] > 0 > cloud.sh[0, 0, 2]


def test_a_compressed_ply_without_harmonics_has_constant_colours(tmp_path):
    path = write_compressed(tmp_path / "a.compressed.ply", 3, 1, (0, 0, 0, 0))
    plain, _ = opened(path)
    for more, found in ((b"element sh 3\n", None), (b"element sg 3\nproperty float a\n", "sg")):
        odd = tmp_path / "b.compressed.ply"
        odd.write_bytes(path.read_bytes().replace(b"end_header", more + b"end_header") + bytes(12))
        if found is None:
            cloud, _ = opened(odd)
            assert cloud.sh.shape == (3, 1, 3)
            assert np.array_equal(cloud.means, plain.means)
        else:
            with pytest.raises(InputError, match=found):
                opened(odd)


def test_keys_of_sog_are_known_noted_or_refused(tmp_path):
    write_sog(tmp_path / "model")
    file = tmp_path / "model/meta.json"
    plain = json.loads(file.read_text())
    for more, found in (
        ({"asset": {"generator": "a tool"}}, 0.0),
        ({"antialias": True}, EPS2D_PX2),
        ({"model": "antialiased"}, EPS2D_PX2),
    ):
        file.write_text(json.dumps(plain | more))
        assert opened(file)[0].antialias_px2 == found
    for more, found in (({"motion": {}}, "motion"), ({"model": "4dgs"}, "4dgs")):
        file.write_text(json.dumps(plain | more))
        with pytest.raises(InputError, match=found):
            opened(file)


# --- SPZ


def write_spz(path, version, flags, extensions=b"", reserved=0):
    """Write six Gaussians of degree 2 with flags, extensions and a number in a reserved place."""
    plain_spz(path, version, 6, 2, body_streams(version, 6, 2))
    data = path.read_bytes()
    if version == 4:
        table = 32 + len(extensions)
        head = data[:14] + bytes([flags, data[15]]) + struct.pack("<IB11x", table, reserved)
        path.write_bytes(head + extensions + data[32:])
    else:
        body = gzip.decompress(data)
        body = body[:14] + bytes([flags, reserved]) + body[16:] + extensions
        path.write_bytes(gzip.compress(body))
    return path


def record(kind, *values):
    return struct.pack(f"<II{len(values)}I", kind, 4 * len(values), *values)


AXES = {
    "R": np.array([1.0, 0, 0]),
    "D": np.array([0, 1.0, 0]),
    "F": np.array([0, 0, 1.0]),
}
AXES |= {"L": -AXES["R"], "U": -AXES["D"], "B": -AXES["F"]}


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(
    ("number", "system"),
    [(1, "LDB"), (4, "RUB"), (6, "RDF"), (7, "LUF"), (8, "RUF"), (12, "RFU"), (14, "RBD")],
)
def test_axes_that_an_spz_states_are_turned_into_those_of_a_ply(tmp_path, version, number, system):
    stored, _ = opened(write_spz(tmp_path / "a.spz", version, 2, record(0xADBE0003, 6)))
    turned, report = opened(write_spz(tmp_path / "b.spz", version, 2, record(0xADBE0003, number)))
    M = np.stack([AXES[letter] for letter in system], axis=1)
    assert np.allclose(turned.means, stored.means @ M.T, atol=1e-5)
    assert np.allclose(covariances(turned), M @ covariances(stored) @ M.T, rtol=1e-4, atol=1e-9)
    rays = np.random.default_rng(1).normal(size=(20, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->dnc", sh_basis(rays, 9), stored.sh)
    after = np.einsum("dk,nkc->dnc", sh_basis(rays @ M.T, 9), turned.sh)
    assert np.allclose(after, before, atol=1e-5)
    assert any(system in note for note in report.notes) == (number != 4)


SYSTEMS_48 = [
    "".join(letters)
    for axes in itertools.permutations(("RL", "DU", "FB"))
    for letters in itertools.product(*axes)
]


def test_all_48_systems_of_axes_are_one_matrix_of_letters(tmp_path):
    assert len(SYSTEMS_48) == 48
    plain_spz(tmp_path / "a.spz", 3, 6, 2, body_streams(3, 6, 2))
    cloud, _ = opened(tmp_path / "a.spz")
    columns = (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh)
    stored = GaussianArrays(*(np.asarray(column) for column in columns))
    rays = np.random.default_rng(1).normal(size=(20, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->dnc", sh_basis(rays, 9), stored.sh)
    for system in SYSTEMS_48:
        M = np.stack([AXES[letter] for letter in system], axis=1)
        turned = in_ply_axes(stored, system)
        assert np.allclose(turned.means, stored.means @ M.T, atol=1e-5)
        turned_cloud, _ = build_cloud(turned)
        expected = M @ covariances(cloud) @ M.T
        assert np.allclose(covariances(turned_cloud), expected, rtol=1e-4, atol=1e-9)
        after = np.einsum("dk,nkc->dnc", sh_basis(rays @ M.T, 9), turned.sh)
        assert np.allclose(after, before, atol=1e-5)


@pytest.mark.parametrize(("number", "system"), [(9, "LFD"), (10, "RFD"), (15, "LBU"), (16, "RBU")])
def test_axes_that_the_library_of_spz_takes_otherwise_are_refused(tmp_path, number, system):
    with pytest.raises(InputError, match=system):
        opened(write_spz(tmp_path / "a.spz", 3, 2, record(0xADBE0003, number)))


@pytest.mark.parametrize("version", [2, 3, 4])
def test_flags_and_extensions_of_an_spz(tmp_path, version):
    path = tmp_path / "a.spz"
    assert opened(write_spz(path, version, 1))[0].antialias_px2 == EPS2D_PX2
    assert not opened(write_spz(path, version, 0))[1].notes
    assert not opened(write_spz(path, version, 2, record(0xADBE0002, 0, 0, 0)))[1].notes
    for flags, extensions, found in (
        (4, b"", "flags/bit_2"),
        (2, record(0xADBE0001, 1), "0xadbe0001"),
        (2, record(0xADBE0003, 99), "damaged"),
        (2, record(0xADBE0003, 6)[:-3], "damaged"),
    ):
        with pytest.raises(InputError, match=found):
            opened(write_spz(path, version, flags, extensions))


def test_what_mesh_and_point_editors_write_is_read(tmp_path):
    plain, _ = opened(model(tmp_path / "a.ply"))
    file = model(tmp_path / "b.ply")
    faces = b"element face 0\nproperty list uchar int vertex_indices\nend_header"
    data = file.read_bytes().replace(b"end_header", faces)
    for name in (b"opacity", b"f_dc_", b"scale_", b"rot_"):  # as CloudCompare names them
        data = data.replace(b"property float " + name, b"property float scalar_" + name)
    file.write_bytes(data)
    cloud, report = opened(file)
    assert np.array_equal(cloud.scales, plain.scales)
    assert not report.notes


def with_bound(path, name):
    """Write a compressed PLY whose chunks have one more number."""
    write_compressed(path, 3, 1, (0, 0, 0, 0))
    head, _, body = path.read_bytes().partition(b"end_header\n")
    head = head.replace(b"element vertex", f"property float {name}\nelement vertex".encode())
    rows = body[: 4 * 12] + struct.pack("<f", 2.0) + body[4 * 12 :]
    path.write_bytes(head + b"end_header\n" + rows)
    return path


def with_keys(folder, **keys):
    """Write a SOG with more keys in its document, or in those of its planes."""
    write_sog(folder)
    meta = json.loads((folder / "meta.json").read_text())
    for name, value in keys.items():
        meta[name] = {**meta[name], **value} if isinstance(meta.get(name), dict) else value
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (lambda path: with_bound(path, "min_w"), "chunk/min_w"),
        (lambda path: write_spz(path, 3, 0, reserved=1), "header/reserved"),
        (lambda path: write_spz(path, 4, 0, reserved=1), "header/reserved"),
        (lambda path: with_keys(path, means={"unit": "mm"}), "means/unit"),
        (lambda path: with_keys(path, shN={"palette_size": 64}), "shN/palette_size"),
        (lambda path: with_keys(path, up=[0, 0, 1]), "meta.json/up"),
    ],
)
def test_a_field_that_a_reader_of_models_does_not_know_is_refused_by_name(tmp_path, write, name):
    with pytest.raises(InputError, match=name):
        opened(write(tmp_path / "model"))


def test_the_size_of_planes_that_lichtfeld_studio_states_changes_nothing(tmp_path):
    plain, _ = opened(with_keys(tmp_path / "a"))
    cloud, report = opened(with_keys(tmp_path / "b", width=10, height=10))
    assert np.array_equal(cloud.means, plain.means)
    assert not report.notes


def test_bytes_behind_an_spz_that_its_header_does_not_announce_are_said(tmp_path):
    _, report = opened(write_spz(tmp_path / "a.spz", 3, 0, record(0xADBE0003, 6)))
    assert "12 bytes" in str(report.notes)
