"""PLY reading and writing, on a trained model and on small made-up ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.gaussians import GaussianCloud, read_ply, write_ply
from alpasim_plugin.gaussians.files import read_gaussians
from alpasim_plugin.gaussians.files.ply import (
    ply_rows,
    read_ply_arrays,
    read_ply_element,
    read_ply_header,
)
from tests.gaussians.ply_writers import NAMES, element, make_cloud, write_elements

# --- a trained model


@pytest.fixture
def train(shared_data):
    return shared_data / "gaussians" / "train-1000.ply"


def test_trained_model_has_the_published_facts(train):
    raw = read_ply_arrays(train)
    header = read_ply_header(train)
    rows = read_ply_element(header, "vertex")
    assert len(header.element("vertex").properties) == 62
    assert all(np.isfinite(rows[name]).all() for name in rows.dtype.names)
    assert all((rows[name] == 0).all() for name in ("nx", "ny", "nz"))
    assert_allclose(raw.means.min(axis=0), (-13.0210, -3.9220, -3.8217), atol=5e-5)
    assert_allclose(raw.means.max(axis=0), (10.2932, 1.9683, 13.8217), atol=5e-5)
    assert raw.opacities.mean() == pytest.approx(0.2467, abs=5e-5)
    assert np.median(raw.scales) == pytest.approx(0.01177, abs=5e-6)
    assert raw.scales.max() == pytest.approx(0.5667, abs=5e-5)
    norms = np.linalg.norm(raw.quats, axis=1)
    assert (norms.min(), norms.max()) == (
        pytest.approx(0.642, abs=5e-4),
        pytest.approx(1.319, abs=5e-4),
    )
    assert_allclose(raw.sh[:, 0].mean(axis=0), (0.1658, 0.2361, 0.0812), atol=5e-5)


def test_trained_model_comes_back_byte_for_byte(train, tmp_path):
    write_ply(tmp_path / "copy.ply", GaussianCloud(*read_ply_arrays(train)[:5]))
    body = 1000 * 62 * 4
    assert (tmp_path / "copy.ply").read_bytes()[-body:] == train.read_bytes()[-body:]


# --- round trips


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_every_degree_survives_a_round_trip(tmp_path, k):
    cloud = make_cloud(k=k)
    write_ply(tmp_path / "a.ply", cloud)
    back = read_ply_arrays(tmp_path / "a.ply")
    for name in ("means", "quats", "sh"):
        assert_array_equal(getattr(back, name), getattr(cloud, name))
    assert_allclose(back.scales, cloud.scales, rtol=5e-7)
    assert_allclose(back.opacities, cloud.opacities, rtol=5e-7)


def test_red_only_coefficient_in_a_foreign_file_is_read_as_red(tmp_path):
    names = [*NAMES, *(f"f_rest_{i}" for i in range(9))]
    row = np.zeros((1, len(names)))
    row[0, names.index("rot_0")] = 1
    row[0, names.index("f_rest_1")] = 0.5
    path = write_elements(tmp_path / "a.ply", element("vertex", names, row))
    sh = read_ply(path).sh
    assert sh.shape == (1, 4, 3)
    assert sh[0, 2, 0] == np.float32(0.5)
    assert np.count_nonzero(sh) == 1


def test_property_order_and_extra_properties_do_not_matter(tmp_path):
    cloud = make_cloud(n=4, k=4)
    rows = ply_rows(cloud)
    names = [*reversed(rows.dtype.names), "semantic_0"]
    table = np.stack([rows[n] if n != "semantic_0" else np.full(4, 7.0) for n in names], axis=1)
    path = write_elements(tmp_path / "a.ply", element("vertex", names, table))
    assert_array_equal(read_ply_arrays(path).sh, cloud.sh)


def test_big_endian_doubles_are_read(tmp_path):
    header = "element vertex 1\n" + "".join(f"property double {n}\n" for n in NAMES)
    row = (np.arange(1, len(NAMES) + 1) / 100).astype(">f8")
    path = write_elements(tmp_path / "a.ply", (header, row.tobytes()), fmt="binary_big_endian")
    raw = read_ply_arrays(path)
    assert_array_equal(raw.means, [[0.01, 0.02, 0.03]])
    assert_allclose(raw.scales[0], np.exp([0.08, 0.09, 0.10]), rtol=1e-15)


# --- several models in one file


@pytest.fixture
def street(tmp_path):
    background = np.zeros((3, len(NAMES)))
    actor = np.zeros((2, len(NAMES)))
    background[:, NAMES.index("rot_0")] = actor[:, NAMES.index("rot_0")] = 1
    actor[:, 0] = 5
    return write_elements(
        tmp_path / "street.ply",
        element("vertex_background", NAMES, background),
        element("vertex_obj_000", NAMES, actor),
    )


def test_street_model_asks_which_part(street):
    with pytest.raises(
        InputError, match=r"2 models in one file: \['vertex_background', 'vertex_obj_000'\]"
    ) as caught:
        read_ply(street)
    assert "element='vertex_background'" in caught.value.hint


def test_street_model_gives_the_named_part(street):
    assert len(read_ply(street, element="vertex_background")) == 3
    actor, _ = read_gaussians(street, element="vertex_obj_000")
    assert len(actor) == 2
    assert (actor.means[:, 0] == 5).all()


# --- what is refused


def test_absurd_count_is_refused_without_allocating(tmp_path):
    header = "element vertex 99999999999999\n" + "".join(f"property float {n}\n" for n in NAMES)
    path = write_elements(tmp_path / "a.ply", (header, bytes(560)))
    with pytest.raises(InputError):
        read_ply(path)


@pytest.mark.parametrize(
    "line",
    ["element vertex -5", "element vertex many", "element vertex", "property quark x", "hello"],
)
def test_broken_header_line_is_named(tmp_path, line):
    path = write_elements(tmp_path / "a.ply", (line + "\n", b""))
    with pytest.raises(InputError):
        read_ply_header(path)


def test_incomplete_band_of_harmonics_is_refused(tmp_path):
    names = [*NAMES, *(f"f_rest_{i}" for i in range(10))]
    path = write_elements(tmp_path / "a.ply", element("vertex", names, np.zeros((1, len(names)))))
    with pytest.raises(InputError):
        read_ply(path)


def test_fourth_degree_is_cut_to_the_third_and_noted(tmp_path):
    names = [*NAMES, *(f"f_rest_{i}" for i in range(72))]
    rows = np.zeros((2, len(names)))
    rows[:, names.index("rot_0")] = 1
    cloud, report = read_gaussians(
        write_elements(tmp_path / "a.ply", element("vertex", names, rows))
    )
    assert cloud.sh.shape == (2, 16, 3)
    assert "degree 4" in str(report.notes)


def test_broken_gaussians_are_dropped_and_counted(tmp_path):
    rows = np.zeros((4, len(NAMES)))
    rows[:, NAMES.index("rot_0")] = 1
    rows[0, 0] = np.nan
    rows[1, NAMES.index("rot_0")] = 0
    rows[2, NAMES.index("scale_1")] = 90
    cloud, report = read_gaussians(
        write_elements(tmp_path / "a.ply", element("vertex", NAMES, rows))
    )
    assert len(cloud) == 1
    assert {k: v for k, v in report.dropped.items() if v} == {
        "non-finite mean": 1,
        "zero quaternion": 1,
        "overflowing scale": 1,
    }


def test_unfinished_file_never_bears_the_name(tmp_path):
    with pytest.raises(InfrastructureError):
        write_ply(tmp_path / "absent" / "a.ply", make_cloud())
    write_ply(tmp_path / "a.ply", make_cloud())
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]
