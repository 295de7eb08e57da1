"""Lenses against their equations, to 100 degrees from the axis."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.cameras.lens import check_lens, joined, pixels_of, rays_of, resized, sides_of
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import CameraSpec, Frame, LensModel

W = 320
H = 240
K = np.array([[100.0, 0.0, 158.0], [0.0, 102.0, 121.0], [0.0, 0.0, 1.0]])
OPENCV = LensModel("opencv", (-0.25, 0.08, 0.002, -0.003, 0.01, 0.02, 0.0, 0.0, 0.001, 0.0, -0.001))
FISHEYE = LensModel("fisheye", (0.02, -0.01, 0.001), max_angle_rad=np.deg2rad(100))
FTHETA = LensModel("ftheta", (0.0, 92.0, 0.0, -1.5), (), (1.01, 0.002, -0.001), np.deg2rad(100))
BACKWARD = LensModel("ftheta", (), (0.0, 1 / 90, 0.0, 1e-9), max_angle_rad=np.deg2rad(100))


def camera(lens):
    focal = 2.0 if lens and lens.kind == "opencv" else 1.0
    return CameraSpec("c", W, H, np.diag([focal, focal, 1.0]) @ K, np.eye(4), lens=lens)


def colours(ray):
    """A smooth colour for every direction."""
    unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    return 127.5 + 100 * np.sin(2.5 * unit + [0.0, 1.0, 2.0])


def by_equations(spec, ray):
    """Where a lens shows rays ``(N, 3)``, by OpenCV and by the equation of f-theta lenses."""
    lens = spec.lens
    none = np.zeros(3)
    from_corner = spec.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    given = np.array(lens.coefficients)
    if lens.kind == "opencv":
        return (
            cv2.projectPoints(ray, none, none, from_corner, np.array([*given, 0.0]))[0][:, 0] + 0.5
        )
    angle = np.arctan2(np.linalg.norm(ray[:, :2], axis=1), ray[:, 2])
    across = ray[:, :2]
    if lens.kind == "fisheye":
        k = np.array([*given, 0.0])
        radius = angle * (1 + (angle[:, None] ** [2, 4, 6, 8]) @ k)
        scale = np.diag(spec.K)[:2]
    else:
        forward = given
        if lens.pixel_to_angle:
            r = np.linspace(0, 400, 200_001)
            radius = np.interp(angle, np.polynomial.polynomial.polyval(r, lens.pixel_to_angle), r)
        else:
            radius = np.polynomial.polynomial.polyval(angle, forward)
        scale = np.ones(2)
    plane = across / np.linalg.norm(across, axis=1, keepdims=True) * radius[:, None]
    c, d, e = lens.linear
    return plane @ np.array([[c, d], [e, 1.0]]).T * scale + spec.K[:2, 2]


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE, FTHETA, BACKWARD])
def test_the_ray_of_a_pixel_is_shown_at_that_pixel(lens):
    spec = camera(lens)
    rays = rays_of(spec)
    pixel = np.stack(np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5), axis=-1).reshape(-1, 2)
    seen = rays.visible & (np.linalg.norm(pixel - spec.K[:2, 2], axis=1) > 1)
    assert seen.sum() > 0.8 * len(seen)
    assert_allclose(by_equations(spec, rays.ray[seen]), pixel[seen], atol=0.06)
    shown, good = pixels_of(spec, rays.ray[seen])
    assert good.all()
    assert_allclose(shown, pixel[seen], atol=0.06)


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE, FTHETA, BACKWARD])
def test_a_lens_joined_of_pinholes_shows_the_colours_of_its_rays(lens):
    spec = camera(lens)
    sides = sides_of(spec)
    frames = []
    for side in sides:
        w, h = side.cover
        x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        ray = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(side.K).T
        rgb = colours(ray @ side.T_lens_pinhole[:3, :3].T).round().astype(np.uint8)
        held = np.dstack([rgb, np.full((h, w), 255, dtype=np.uint8)])
        if not frames:  # holds nowhere: its neighbours' references count
            held[:] = 7, 7, 7, 0
        frames.append(Frame(0, "x", rgb, np.zeros((h, w), dtype=np.float32), references=(held,)))
    out = joined("lens", sides, frames)
    rays = rays_of(spec)
    off = np.abs(out.rgb.reshape(-1, 3) - colours(rays.ray)).max(axis=1)
    assert (off[rays.visible] <= 2).mean() > 0.995
    assert (out.rgb.reshape(-1, 3)[~rays.visible] == 0).all()
    assert_array_equal(out.alpha.ravel() > 0.5, ~rays.visible)
    (reference,) = out.references
    holds = reference[..., 3] > 252
    assert np.abs(reference[..., :3].astype(int) - out.rgb)[holds].max() <= 3
    assert (holds == (reference[..., 3] > 0)).mean() > 0.95
    assert rays.visible[holds.ravel()].all()
    assert holds.mean() > 0.2
    assert len(sides) == (3 if lens.kind == "opencv" else 5)
    assert rays.widest_rad > np.deg2rad(40 if lens.kind == "opencv" else 99)


@pytest.mark.parametrize(
    "lens",
    [
        replace(FISHEYE, coefficients=(-0.5,)),
        replace(FTHETA, coefficients=(0.0, 90.0, 0.0, -20.0)),
        replace(BACKWARD, pixel_to_angle=(0.0, 1 / 90, -3e-5)),
        LensModel("opencv", (-2.0,)),
        LensModel("ftheta", (0.0, -90.0)),
        LensModel("ftheta"),
        LensModel("fisheye", (0.1,) * 5),
        LensModel("fisheye", (float("nan"),)),
        LensModel("ftheta", (0.0, 60.0)),
    ],
    ids=["fisheye", "ftheta", "backward", "opencv", "falls", "none", "many", "nan", "wide"],
)
def test_a_lens_that_cannot_be_drawn_whole_is_refused(lens):
    with pytest.raises(InputError):
        check_lens(camera(lens))


def test_a_camera_of_another_size_sees_the_same_at_its_corners():
    for lens in (OPENCV, FISHEYE, FTHETA, BACKWARD):
        spec = camera(lens)
        ray = np.array([[0.3, -0.2, 1.0], [-0.5, 0.1, 1.0]])
        whole, _ = pixels_of(spec, ray)
        half, _ = pixels_of(resized(spec, W // 2, H // 2), ray)
        assert_allclose(half, whole / 2, atol=1e-6)
