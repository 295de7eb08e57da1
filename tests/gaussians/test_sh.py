"""Check the harmonics: orthonormality, signs, and rotation by sampled directions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import sph_harm_y

from alpasim_plugin.gaussians.sh import (
    C0,
    dc_from_rgb,
    rotate_sh,
    sh_basis,
    sh_colours,
    sh_rotation,
)
from tests.examples import examples
from tests.gaussians.gaussian_scenes import random_rigid


def directions(n=200, seed=0):
    d = np.random.default_rng(seed).normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_basis_equals_real_harmonics_of_scipy_with_the_3dgs_signs():
    d = directions()
    theta = np.arccos(d[:, 2])
    phi = np.arctan2(d[:, 1], d[:, 0])
    basis = sh_basis(d)
    for degree in range(4):
        for m in range(-degree, degree + 1):
            y = sph_harm_y(
                degree, abs(m), theta, phi
            )  # with the Condon-Shortley phase, whose sign 3DGS keeps
            real = y.real if m == 0 else np.sqrt(2) * (y.imag if m < 0 else y.real)
            assert np.abs(basis[:, degree * degree + degree + m] - real).max() < 1e-12, (degree, m)


def test_colours_are_clamped_below_and_not_above():
    sh = np.array([[[-5.0, 5.0, 0.0]]])
    assert sh_colours(sh, [[0, 0, 1.0]])[0].tolist() == pytest.approx([0.0, 0.5 + 5 * C0, 0.5])


@settings(max_examples=examples(25), deadline=None)
@given(seed=st.integers(0, 10_000), size=st.sampled_from([1, 4, 9, 16]))
def test_rotated_coefficients_show_the_colour_of_the_turned_back_direction(seed, size):
    R = random_rigid(seed)[:3, :3]
    sh = np.random.default_rng(seed).normal(size=(5, size, 3))
    d = directions(60, seed)
    turned = rotate_sh(sh, R)
    original = sh
    for i in range(5):
        seen = sh_basis(d, size) @ turned[i]
        assert np.abs(seen - sh_basis(d @ R, size) @ original[i]).max() < 1e-12


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotation_matrices_are_orthogonal_and_compose(degree):
    A = random_rigid(1)[:3, :3]
    B = random_rigid(2)[:3, :3]
    a, b, ab = (sh_rotation(R, degree) for R in (A, B, A @ B))
    assert np.abs(a @ a.T - np.eye(2 * degree + 1)).max() < 1e-12
    assert np.abs(a @ b - ab).max() < 1e-12


def test_constant_coefficients_show_one_colour_from_everywhere():
    rgb = np.array([0.2, 0.5, 0.9])
    sh = np.broadcast_to(dc_from_rgb(rgb), (50, 1, 3))
    assert np.abs(sh_colours(sh, directions(50)) - rgb).max() < 1e-12
    assert dc_from_rgb([1.0])[0] == pytest.approx(0.5 / C0)
