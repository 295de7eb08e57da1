import io
import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose

from alpasim_plugin.core.geometry import intrinsics
from alpasim_plugin.core.types import CameraSpec, LensModel
from scenarios.ftheta import calibration_table, front_camera, sensor_lens
from tests.camera_builders import ahead
from tests.scenarios.ftheta_projection import lens_of, project_ftheta

WIDE = [960.0, 740.0, 1920.0, 1080.0, 0.0, 1.0576e-3, 8.2e-9, -3.4e-11, 8.1e-14, -2.9e-17, 1.0]


def test_every_rendered_pixel_was_recorded():
    lens = lens_of(np.array(WIDE))
    camera = front_camera(np.array(WIDE), np.eye(4))
    u, v = np.meshgrid(np.arange(camera.width + 1.0), np.arange(camera.height + 1.0))
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ np.linalg.inv(camera.K).T
    pixels = project_ftheta(lens, rays)
    assert (pixels >= 0).all()
    assert (pixels <= [lens.width, lens.height]).all()
    assert np.degrees(2 * np.arctan(camera.width / 2 / camera.K[0, 0])) == pytest.approx(90.0)


@pytest.mark.parametrize(
    "values", [WIDE, [970.0, 600.0, 1920.0, 1080.0, 0.0, 3675.7, 178.8, -387.4, -11.4, 18.0, 0.0]]
)
def test_both_directions_of_a_lens_undo_each_other(values):
    camera = lens_of(np.array(values))
    polynomial = np.polynomial.polynomial.polyval
    theta = np.linspace(0, camera.lens.max_angle_rad, 200)
    assert_allclose(
        polynomial(polynomial(theta, camera.lens.angle_to_pixel), camera.lens.pixel_to_angle),
        theta,
        atol=1e-4,
    )
    # The projection itself is as exact as the calibrated polynomial.
    rays = np.column_stack([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)])
    radius = np.linalg.norm(project_ftheta(camera, rays) - (camera.cx, camera.cy), axis=1)
    back = polynomial(radius, camera.lens.pixel_to_angle)
    assert_allclose(back, theta, atol=1e-9 if camera.backward_given else 1e-4)


def test_the_matrix_of_a_lens_is_read_and_written():
    lens = LensModel("ftheta", (), (0.0, 1 / 190, 0.0, 1e-9), (1.05, 0.002, -0.001))
    K = intrinsics(190, 190, 165, 88)
    camera = CameraSpec("wide", 320, 180, K, ahead(), lens=lens)
    table = pq.read_table(io.BytesIO(calibration_table({"camera_wide": camera}, "clip")))
    text = table.to_pylist()[0]["calibration_estimate"]["rig_json"]
    (sensor,) = json.loads(text)["rig"]["sensors"]
    read = sensor_lens(sensor["properties"])
    assert read.linear == lens.linear
    radius = np.linspace(0, 180, 20)
    polynomial = np.polynomial.polynomial.polyval
    given = polynomial(radius, np.array(lens.pixel_to_angle))
    assert_allclose(polynomial(radius, np.array(read.pixel_to_angle)), given, atol=1e-6)
