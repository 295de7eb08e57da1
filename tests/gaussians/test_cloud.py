"""Build, clean, move and join clouds."""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians import GaussianCloud
from alpasim_plugin.gaussians.cloud import all_rigid, placed_cloud, require_rigid
from tests.gaussians.gaussian_scenes import covariances, random_cloud, random_rigid


def arrays(n=8):
    cloud = random_cloud(n)
    return {f: getattr(cloud, f).copy() for f in ("means", "quats", "scales", "opacities", "sh")}


@pytest.mark.parametrize(
    ("field", "row", "value", "cause"),
    [
        ("means", 2, np.nan, "non-finite mean"),
        ("means", 2, -np.inf, "non-finite mean"),
        ("opacities", 3, np.nan, "non-finite opacity"),
        ("sh", 1, np.inf, "non-finite colour"),
        ("scales", 4, np.nan, "NaN or negative scale"),
        ("scales", 4, -0.1, "NaN or negative scale"),
        ("scales", 5, np.inf, "overflowing scale"),
        ("scales", 5, np.exp(20.1), "overflowing scale"),
        ("quats", 6, 0.0, "zero quaternion"),
        ("quats", 6, np.nan, "non-finite quaternion"),
    ],
)
def test_each_cause_is_dropped_and_counted_under_its_name(field, row, value, cause):
    data = arrays()
    GaussianCloud(**data).require_drawable()
    data[field][row] = value
    with pytest.raises(InputError):
        GaussianCloud(**data).require_drawable()
    cloud, report = GaussianCloud.cleaned(**data)
    assert report.dropped == {**dict.fromkeys(report.dropped, 0), cause: 1}
    assert (report.n_input, report.n_kept, len(cloud)) == (8, 7, 7)
    assert f"dropped: 1 {cause}" in str(report)
    assert np.array_equal(cloud.means, np.delete(data["means"], row, axis=0))


@pytest.mark.parametrize("length", [1e-30, 7.0, 1e30])
def test_quaternions_of_any_length_are_normalised_in_float64(length):
    data = arrays()
    want = data["quats"] / np.linalg.norm(data["quats"], axis=1, keepdims=True)
    data["quats"] = (want * length).astype(np.float32)
    cloud, report = GaussianCloud.cleaned(**data)
    assert report.n_kept == 8
    assert np.abs(cloud.quats - want).max() < 1e-6


def test_tiny_scales_and_odd_opacities_are_repaired_and_counted():
    data = arrays()
    data["scales"][1] = 0.0
    data["opacities"][2], data["opacities"][3] = 1.2, -0.1
    cloud, report = GaussianCloud.cleaned(**data)
    assert report.repaired == {"scale raised to exp(-20) m": 1, "opacity clipped to [0, 1]": 2}
    assert cloud.scales.min() == pytest.approx(np.exp(-20))
    assert "repaired" in str(report)


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh"])
def test_shapes_that_disagree_are_an_error(field):
    data = arrays()
    data[field] = data[field][:-1]
    with pytest.raises(InputError):
        GaussianCloud(**data)


def test_moving_turns_covariances_and_leaves_scales_alone():
    cloud = random_cloud(30)
    T = random_rigid(6)
    moved = cloud.transformed(T)
    R = T[:3, :3]
    assert np.abs(covariances(moved) - R @ covariances(cloud) @ R.T).max() < 1e-12
    assert np.shares_memory(moved.scales, cloud.scales)


def test_moving_by_something_that_is_not_rigid_is_an_error():
    with pytest.raises(InputError):
        random_cloud(3).transformed(np.diag([2.0, 1, 1, 1]))


def test_joining_pads_lower_degrees_and_keeps_order():
    joined = GaussianCloud.concatenate(
        [random_cloud(3, 1, degree=0), random_cloud(2, 2, degree=2), GaussianCloud.empty()]
    )
    assert joined.sh.shape == (5, 9, 3)
    assert not joined.sh[:3, 1:].any()
    assert np.array_equal(joined.means[3:], random_cloud(2, 2).means)
    assert len(GaussianCloud.concatenate([])) == 0


def test_whole_numbers_become_floats_and_single_precision_stays():
    data = arrays()
    cloud = GaussianCloud(
        np.arange(24).reshape(8, 3),
        data["quats"].astype(np.float32),
        data["scales"],
        data["opacities"],
        data["sh"],
    )
    assert cloud.means.dtype == np.float64
    assert cloud.quats.dtype == np.float32


def test_arrays_of_a_cloud_cannot_be_written_and_those_given_stay_writable():
    data = arrays()
    cloud = GaussianCloud(**data)
    with pytest.raises(ValueError, match="read-only"):
        cloud.means[0] = 0.0
    data["means"][0] = 0.0


@pytest.mark.parametrize("entry", [(0, 0), (1, 2), (2, 1), (3, 1), (3, 3)])
@pytest.mark.parametrize("by", [3e-6, -3e-5, 0.1, np.nan])
def test_one_transform_is_rigid_where_many_are(entry, by):
    T = random_rigid(7)
    T[entry] += by
    many = np.stack([T, *[np.eye(4)] * 4])
    assert all_rigid(T[None]) == all_rigid(many)
    if all_rigid(many):
        require_rigid(T, "testing")
    else:
        with pytest.raises(InputError):
            require_rigid(T, "testing")
    mirrored = random_rigid(7)
    far = random_rigid(7)
    mirrored[:3, 0] *= -1
    far[0, 3] = np.inf
    assert not all_rigid(mirrored[None])
    assert not all_rigid(far[None])


def test_a_gaussian_with_two_faults_is_counted_once():
    data = arrays()
    data["means"][0] = np.nan
    data["quats"][0] = 0
    _, report = GaussianCloud.cleaned(**data)
    assert sum(report.dropped.values()) == 1


def test_a_model_in_other_units_is_placed_with_its_splats_scaled_and_turned():
    cloud = random_cloud(8)
    T = random_rigid(3)
    T[:3, :3] *= 2.5
    placed = placed_cloud(cloud, T)
    np.testing.assert_allclose(placed.means, cloud.means @ T[:3, :3].T + T[:3, 3], atol=1e-4)
    expected = T[:3, :3] @ covariances(cloud) @ T[:3, :3].T
    np.testing.assert_allclose(covariances(placed), expected, atol=1e-4)
