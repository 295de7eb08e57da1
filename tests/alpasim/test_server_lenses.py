"""Every lens of the wire: the picture through it shows each direction at the pixel where the lens
model puts it.
"""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from alpasim_plugin.alpasim.server import caches, views
from alpasim_plugin.alpasim.server.assembly import Settings, assemble
from alpasim_plugin.alpasim.server.lens_cache import LensCache
from alpasim_plugin.alpasim.server.status import CallTime
from alpasim_plugin.alpasim.server.views import read_sides, straight_of
from alpasim_plugin.cameras.lens import joined_image
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.schema import wire_render_request
from alpasim_plugin.log.wire import sensorsim_pb2
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.renderer import make_renderer
from scenarios.load import load_scenario
from tests.alpasim.service_cases import pinhole
from tests.alpasim.wire_lenses import distorted, fisheye, ftheta

RAYS = np.array([[0.0, 0.0], [0.3, -0.1], [-0.5, 0.2], [0.6, 0.3], [-0.2, -0.35]])  # x / z, y / z


def shown_at(sides, pixel):
    """Return the direction x/z, y/z that a place of the picture shows, read off the pinhole that
    shows it.
    """
    column, row = pixel - 0.5
    for side in sides:
        if side.resample is None:
            return (pixel - side.K[:2, 2]) / side.K[[0, 1], [0, 1]]
        within = np.float32([[column - side.first_column]]), np.float32([[row]])
        if (
            side.weight is not None
            and cv2.remap(side.weight, *within, cv2.INTER_NEAREST)[0, 0] == 0
        ):
            continue
        place = cv2.remap(side.resample, *within, cv2.INTER_LINEAR)[0, 0]
        ray = side.T_lens_pinhole[:3, :3] @ np.linalg.inv(side.K) @ [*(place + 0.5), 1]
        return ray[:2] / ray[2]
    raise AssertionError("no pinhole shows the place")


def rays_and_matrix(p):
    """Return RAYS ``(N, 3)`` and the matrix of a lens."""
    fx, fy = p.focal_length_x, p.focal_length_y
    K = np.array([[fx, 0, p.principal_point_x], [0, fy, p.principal_point_y], [0, 0, 1]])
    return np.column_stack([RAYS, np.ones(len(RAYS))]), K


def by_opencv(spec):
    p = spec.opencv_pinhole_param
    rays, K = rays_and_matrix(p)
    k = list(p.radial_coeffs)
    bent = np.array([*k[:2], *p.tangential_coeffs, *k[2:], *p.thin_prism_coeffs])
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, bent)[0][:, 0]


def by_opencv_fisheye(spec):
    p = spec.opencv_fisheye_param
    rays, K = rays_and_matrix(p)
    bent = np.array(p.radial_coeffs)
    return cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), K, bent)[0][:, 0]


def by_ftheta(spec):
    """The overlay's formula: theta = atan2(|xy|, z); pixel = [[c, d], [e, 1]] (r(theta) xy / |xy|)
    + principal point.
    """
    p = spec.ftheta_param
    rho = np.linalg.norm(RAYS, axis=1)
    theta = np.arctan2(rho, 1.0)
    if p.reference_poly == sensorsim_pb2.FthetaCameraParam.ANGLE_TO_PIXELDIST:
        r = np.polynomial.polynomial.polyval(theta, np.array(p.angle_to_pixeldist_poly))
    else:
        radii = np.linspace(0, 400, 400_001)
        r = np.interp(
            theta,
            np.polynomial.polynomial.polyval(radii, np.array(p.pixeldist_to_angle_poly)),
            radii,
        )
    flat = RAYS / np.maximum(rho, 1e-12)[:, None] * r[:, None]
    c = p.linear_cde
    return flat @ np.array([[c.linear_c, c.linear_d], [c.linear_e, 1.0]]).T + [
        p.principal_point_x,
        p.principal_point_y,
    ]


LENSES = [(distorted(), by_opencv), (fisheye(), by_opencv_fisheye), (ftheta(False), by_ftheta)]


@pytest.mark.parametrize(("spec", "project"), [*LENSES, (ftheta(True), by_ftheta)])
def test_each_direction_is_shown_where_the_lens_puts_it(spec, project):
    sides = read_sides(spec, 320, 180)
    for ray, pixel in zip(RAYS, project(spec), strict=True):
        assert 1 < pixel[0] < 319
        assert 1 < pixel[1] < 179
        assert_allclose(shown_at(sides, pixel), ray, atol=2e-4)


@pytest.mark.parametrize("size", [(320, 180), (640, 360)])
@pytest.mark.parametrize(("spec", "project"), LENSES)
def test_the_pinhole_of_a_lens_takes_each_direction_from_where_the_lens_puts_it(
    spec, project, size
):
    straight = straight_of(spec, *size)
    assert straight.place is not None
    assert straight.size[0] == size[0]
    for (x, y), pixel in zip(RAYS, project(spec) * size[0] / 320, strict=True):
        column = straight.K[0] @ [x, y, 1] - 0.5
        row = straight.K[1] @ [x, y, 1] - 0.5
        found = cv2.remap(
            straight.place, np.float32([[column]]), np.float32([[row]]), cv2.INTER_LINEAR
        )[0, 0]
        assert_allclose(found + 0.5, pixel, atol=0.05)


def test_a_pinhole_is_its_own_and_what_a_lens_does_not_see_is_black():
    assert straight_of(pinhole(64, 32), 64, 32).place is None
    picture = straight_of(ftheta(False), 320, 180).image(
        np.full((180, 320, 3), 200, dtype=np.uint8)
    )
    assert picture[0, 0].tolist() == [0, 0, 0]  # beyond the picture's curved edge
    assert picture[picture.shape[0] // 2, 160].tolist() == [200, 200, 200]


@pytest.mark.parametrize("backward", [False, True])
def test_the_pinhole_of_a_lens_that_sees_100_degrees_shows_80(backward):
    spec = ftheta(backward)
    p = spec.ftheta_param
    del p.angle_to_pixeldist_poly[:], p.pixeldist_to_angle_poly[:]
    (p.pixeldist_to_angle_poly if backward else p.angle_to_pixeldist_poly).extend(
        [0.0, np.deg2rad(100) / 185] if backward else [0.0, 185 / np.deg2rad(100)]
    )
    assert len(read_sides(spec, 320, 180)) > 1
    straight = straight_of(spec, 320, 180)
    half_rad = np.arctan(straight.size[0] / 2 / straight.K[0, 0])
    assert np.rad2deg(half_rad) < 81


def test_a_picture_through_a_lens_is_the_scene_and_black_beyond_it():
    spec = fisheye()
    spec.opencv_fisheye_param.max_angle = 0.6
    (lens,) = sides = read_sides(spec, 320, 180)
    width, height = lens.cover
    x, y = np.meshgrid(
        (np.arange(width) + 0.5 - lens.K[0, 2]) / lens.K[0, 0],
        (np.arange(height) + 0.5 - lens.K[1, 2]) / lens.K[1, 1],
    )
    covering = (
        np.stack([128 + 100 * x, 128 + 100 * y, 0 * x], axis=-1).clip(0, 255).astype(np.uint8)
    )
    image = joined_image(sides, [covering])
    assert_allclose(image[90, 160, :2].astype(int), 128, atol=1)
    assert image[0, 0].tolist() == [0, 0, 0]
    assert joined_image(sides, [np.zeros((height, width), dtype=np.float32)], 1)[0, 0] == 1.0


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda s: s.ClearField("ftheta_param"), "no intrinsics"),
        (lambda s: s.ClearField("resolution_w"), "no calibrated resolution"),
        (lambda s: s.ftheta_param.ClearField("angle_to_pixeldist_poly"), "no polynomial"),
        (lambda s: s.ftheta_param.angle_to_pixeldist_poly.__setitem__(1, -190.0), "does not grow"),
        (
            lambda s: s.ftheta_param.angle_to_pixeldist_poly.__setitem__(1, 75.0),
            "degrees from the axis",
        ),
        (
            lambda s: s.ftheta_param.angle_to_pixeldist_poly.__setitem__(1, float("nan")),
            "not finite",
        ),
        (lambda s: s.bivariate_windshield_model_param.horizontal_poly.append(1.0), "windshield"),
    ],
)
def test_intrinsics_that_are_no_lens_are_refused(change, found):
    spec = ftheta(False)
    change(spec)
    with pytest.raises(InputError, match=found):
        read_sides(spec, 320, 180)


def test_what_is_kept_of_lenses_has_an_end(monkeypatch):
    few = LensCache(8 << 20)
    monkeypatch.setattr(views, "lenses", few)
    for i in range(12):
        spec = fisheye()
        spec.opencv_fisheye_param.principal_point_x += i
        assert straight_of(spec, 320, 180) is straight_of(spec, 320, 180)
        assert few.held <= 8 << 20
    for i in range(200):  # pinholes, which hold no arrays
        read_sides(pinhole(320 + i, 180), 320 + i, 180)
        assert few.held <= 8 << 20
    assert len(few) < 200


def test_the_asked_size_scales_a_pinhole_per_axis_and_an_ftheta_lens_by_the_mean():
    (only,) = read_sides(pinhole(64, 32), 32, 32)
    assert_allclose(only.K, [[20, 0, 16], [0, 40, 16], [0, 0, 1]])
    spec = ftheta(False)
    whole = read_sides(spec, 320, 180)
    half = read_sides(spec, 160, 90)
    assert_allclose(
        shown_at(half, np.array([60.0, 30.0])), shown_at(whole, np.array([120.0, 60.0])), atol=1e-4
    )


STREET = """
version: 1
scene_id: lenses
road: {segments: [{kind: straight, length_m: 80}]}
ego: {speed_mps: 10}
timing: {duration_us: 1_500_000}
actors: [{kind: idm, id: ahead, s_m: 30, speed_mps: 9}]
cameras:
- {name: opencv, width: 96, height: 64, lens: opencv, hfov_deg: 80, coefficients: [-0.2, 0.05]}
- {name: fisheye, width: 96, height: 64, lens: fisheye, hfov_deg: 150, yaw_deg: 90, y_m: 0.95}
- {name: ftheta, width: 96, height: 64, lens: ftheta, hfov_deg: 110}
environment: {buildings: 0.0, trees_per_100m: 0.0, poles_spacing_m: 0}
degradation: {share: 0.004}
"""


def test_a_server_shows_through_a_foreign_lens_what_a_run_shows(tmp_path, monkeypatch):
    drawn = []
    draw = caches.checked_frames

    def counted(renderer, requests, on_device):
        drawn.append(len(requests))
        return draw(renderer, requests, on_device)

    monkeypatch.setattr(caches, "checked_frames", counted)
    path = tmp_path / "street.yaml"
    path.write_text(STREET)
    scenario = load_scenario(path)
    run = make_renderer("3dgs", scenario)
    service = assemble(Settings("3dgs", scenes=[str(path)])).service
    for asked in recorded_requests(scenario, scenario.start_us + 1_000_000):
        wire = wire_render_request("lenses", asked, "png")
        seen = decode_image(service.frames.answers([wire], CallTime())[0])
        assert seen.std() > 20
        # intrinsics and poses are of single precision on the wire: a pixel may round the other way
        assert_allclose(seen.astype(int), run.render(asked).rgb, atol=2)
    assert drawn == [1, 1, 1]  # each lens in one pass
