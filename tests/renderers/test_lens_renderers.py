"""What lenses show is drawn by one pass along each pixel's ray, and everything that reads the frame
projects through the same lens.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from alpasim_plugin.cameras.lens import rays_of
from alpasim_plugin.cameras.lens_cover import LensCover
from alpasim_plugin.cameras.shutter import rolling
from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.types import CameraSpec, Degradation, Exposure, LensModel
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.scene.log_views import SkyMask, SkyView
from alpasim_plugin.gaussians.scene.sky import HEIGHT, HIGH_RAD, LOW_RAD, WIDTH, make_sky
from alpasim_plugin.renderers import reconstruction
from alpasim_plugin.renderers.built_road import BuiltRoad
from alpasim_plugin.renderers.gaussian import clear_cache, scene_of
from alpasim_plugin.renderers.lights import Spot, in_image
from alpasim_plugin.renderers.reconstruction import Model, ReconstructionRenderer
from alpasim_plugin.renderers.view import depths_of, shown_at, view_of
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.world.ground import flat
from tests.gaussians.scene_maps import camera_spec, parked, straight
from tests.renderers import requests

FISHEYE = LensModel("fisheye", (0.01,), max_angle_rad=np.deg2rad(95))
FTHETA = LensModel("ftheta", (0.0, 60.0, 0.0, -1.0))
OPENCV = LensModel("opencv", (-0.2, 0.03, 1e-3, -1e-3))


def lens_spec(lens=FISHEYE, focal=40.0, width=160, height=120, name="side"):
    K = np.array([[focal, 0, width / 2 + 1], [0, focal, height / 2 - 2], [0, 0, 1.0]])
    return CameraSpec(name, width, height, K, camera_spec().T_rig_camera, 0, lens)


SPECS = [lens_spec(), lens_spec(FTHETA), lens_spec(OPENCV, 90.0)]
NAMES = ["fisheye", "ftheta", "opencv"]


@pytest.fixture(scope="module")
def scenario():
    made = straight(actors=(parked("car", 27.0, 1.8),))
    yield replace(made, cameras=(camera_spec(96, 54), lens_spec()))
    clear_cache()


def ask(scenario, name):
    (camera,) = (camera for camera in scenario.cameras if camera.name == name)
    return replace(requests.request(scenario), camera=camera)


def test_a_pinhole_beside_a_lens_has_the_bits_of_the_scene_drawn_without_either(scenario):
    asked = ask(scenario, "front")
    spec = asked.camera
    frame = make_renderer("clean", scenario, threads=1).render(asked)
    camera = PinholeCamera.from_pose(spec.width, spec.height, spec.K, asked.T_world_camera[1])
    plain = scene_of(scenario).render(camera, asked.actors, 1)
    np.testing.assert_array_equal(frame.rgb, plain.to_uint8())
    np.testing.assert_array_equal(frame.depth, plain.surface().depth)


def test_a_lens_is_drawn_in_one_pass_and_its_depth_is_the_distance(scenario):
    asked = ask(scenario, "side")
    renderer = make_renderer("clean", scenario, threads=1)
    assert renderer.draws_lenses
    frame = renderer.render(asked)
    camera = LensCamera.from_pose(asked.camera, asked.T_world_camera[1])
    plain = scene_of(scenario).render(camera, asked.actors, 1)
    np.testing.assert_array_equal(frame.rgb, plain.to_uint8())
    assert (frame.rgb[~camera.visible] == 0).all()
    assert (frame.alpha == 1).all()
    points = camera.rays() * frame.depth[..., None]
    height_m = points @ camera.T_camera_world[:3, 2] + camera.centre_world[2]
    below = camera.visible & (camera.rays() @ camera.T_camera_world[:3, 2] < -0.3)
    below &= np.abs(camera.rays() @ camera.T_camera_world[:3, 0]) > 0.3  # the lane ahead of it
    assert abs(float(np.median(height_m[below]))) < 0.2


@pytest.mark.parametrize("spec", SPECS, ids=NAMES)
def test_no_sphere_that_a_ray_of_the_lens_meets_is_left_out(spec):
    rng = np.random.default_rng(3)
    camera = LensCamera(spec, inverse(camera_spec().T_rig_camera))
    ray = camera.rays()[camera.visible]
    ray = ray[rng.integers(len(ray), size=2000)] @ camera.T_camera_world[:3, :3]
    radius = rng.uniform(0.01, 8, 2000)
    off = rng.normal(size=(2000, 3))
    off *= (0.999 * radius / np.linalg.norm(off, axis=1))[:, None]
    centre = camera.centre_world + ray * rng.uniform(0.1, 60, (2000, 1)) + off
    assert camera.in_view(centre, radius).all()
    behind = camera.centre_world - 30 * camera.T_camera_world[2, :3]
    assert not camera.in_view(behind[None], np.array([1.0])).any()


@pytest.mark.parametrize("pitch_deg", [0, 60, 90])
@pytest.mark.parametrize("spec", SPECS, ids=NAMES)
def test_the_sky_through_a_lens_is_the_panorama_in_each_direction(spec, pitch_deg):
    sky = make_sky("clear", np.random.default_rng(0))
    turn = cv2.Rodrigues(np.array([np.deg2rad(pitch_deg), 0.0, 0.0]))[0]
    T = camera_spec().T_rig_camera.copy()
    T[:3, :3] = T[:3, :3] @ turn
    camera = LensCamera(spec, inverse(T))
    ray = camera.rays() @ camera.T_camera_world[:3, :3]
    azimuth = np.arctan2(ray[..., 1], ray[..., 0])
    elevation = np.arctan2(ray[..., 2], np.hypot(ray[..., 0], ray[..., 1]))
    columns = azimuth / (2 * np.pi) * WIDTH % WIDTH
    rows = np.clip((HIGH_RAD - elevation) * (HEIGHT - 1) / (HIGH_RAD - LOW_RAD), 0, HEIGHT - 1)
    wide = np.concatenate([sky.panorama, sky.panorama[:, :1]], axis=1)
    exact = cv2.remap(wide, np.float32(columns), np.float32(rows), cv2.INTER_LINEAR)
    apart = 255 * np.abs(sky.image(camera) - exact).max(axis=2)[camera.visible]
    assert np.mean(apart <= 2) > 0.99
    assert np.mean(apart <= 8) > 0.999


def test_the_sky_of_a_lens_is_asked_of_views_that_saw_its_directions():
    view_camera = PinholeCamera(
        64, 36, np.array([[40.0, 0, 32], [0, 40, 18], [0, 0, 1]]), np.eye(4)
    )
    left_sky = np.zeros((36, 64), dtype=np.float32)
    left_sky[:, :32] = 1.0
    camera = LensCamera(replace(lens_spec(), T_rig_camera=np.eye(4)), np.eye(4))
    share = SkyMask([SkyView(view_camera, left_sky)]).share(camera)
    ray = camera.rays()
    with np.errstate(divide="ignore"):
        slope = ray[..., :2] / ray[..., 2:]
    seen = (ray[..., 2] > 0) & (np.abs(slope) < [0.78, 0.43]).all(axis=2)
    assert (share[seen & (slope[..., 0] < -0.03)] == 1).all()
    assert (share[seen & (slope[..., 0] > 0.03)] == 0).all()
    outside = (ray[..., 2] <= 0) | (np.abs(slope) > [0.83, 0.48]).any(axis=2)
    assert (share[outside] == 0).all()


@pytest.mark.parametrize("spec", SPECS, ids=NAMES)
def test_a_view_through_a_lens_places_its_depth_along_the_rays(spec):
    T = camera_spec().T_rig_camera
    distance = np.full((spec.height, spec.width), 7.0, dtype=np.float32)
    seen = view_of(distance, spec, T, flat())
    camera = LensCamera(spec, inverse(T))
    rays = camera.rays() @ T[:3, :3].T
    np.testing.assert_allclose(seen.rays, rays, atol=1e-5)
    np.testing.assert_allclose(seen.distance_m, 7.0)
    rng = np.random.default_rng(0)
    rows, columns = np.nonzero(camera.visible)
    chosen = rng.integers(len(rows), size=50)
    points = 9.0 * camera.rays()[rows[chosen], columns[chosen]]
    pixels, can_be_seen = shown_at(spec, points)
    assert can_be_seen.all()
    expected = np.stack([columns[chosen], rows[chosen]], axis=1) + 0.5
    np.testing.assert_allclose(pixels, expected, atol=0.06)
    np.testing.assert_allclose(depths_of(spec, points), 9.0)


def test_a_lamp_is_drawn_where_the_lens_shows_it():
    spec = lens_spec()
    T = camera_spec().T_rig_camera
    ray = rays_of(spec).ray.reshape(spec.height, spec.width, 3)[30, 140]
    middle = T[:3, 3] + T[:3, :3] @ (20 * ray)
    (spot,) = in_image([Spot(middle, np.zeros(3), 0.2, (1.0, 0.0, 0.0))], spec, T)
    assert spot.depth_m == pytest.approx(20.0)
    np.testing.assert_allclose((np.array(spot.low) + spot.high) / 32, [140, 30], atol=0.1)


def test_a_frame_through_a_lens_without_the_street_is_refused(scenario):
    asked = ask(scenario, "side")
    frame = make_renderer("clean", scenario, threads=1).render(asked)
    road = BuiltRoad(scenario)
    road.check(asked, frame)
    empty = replace(frame, depth=np.zeros_like(frame.depth))
    with pytest.raises(RendererError, match="built road"):
        road.check(asked, empty)


def test_weather_leaves_what_the_lens_does_not_see_black(scenario):
    foggy = replace(scenario, environment=replace(scenario.environment, fog_visibility_m=60.0))
    asked = ask(scenario, "side")
    frame = make_renderer("clean", foggy, threads=1).render(asked)
    clear = make_renderer("clean", scenario, threads=1).render(asked)
    sees = LensCamera.from_pose(asked.camera, asked.T_world_camera[1]).visible
    assert (frame.rgb[~sees] == 0).all()
    assert np.abs(frame.rgb[sees].astype(int) - clear.rgb[sees]).mean() > 5


def test_a_rolling_shutter_of_a_lens_shows_each_row_from_its_own_pose(scenario):
    asked = ask(scenario, "side")
    spec = asked.camera
    end = asked.T_world_camera[1]
    start = end.copy()
    start[:3, 3] -= 0.4 * end[:3, 2]
    share = rolling(spec.width, spec.height, "rows", backwards=False)
    poses = np.stack([start, end])
    exposed = replace(asked, T_world_camera=poses, exposure=Exposure(share, dict(asked.actors)))
    renderer = make_renderer("clean", scenario, threads=1)
    rolled = renderer.render(exposed)
    for row in (20, 60, 100):
        T = start.copy()
        T[:3, 3] += row / (spec.height - 1) * (end[:3, 3] - start[:3, 3])
        still = renderer.render(replace(asked, T_world_camera=np.stack([T, T])))
        apart = np.abs(rolled.rgb[row].astype(int) - still.rgb[row])
        assert np.mean(apart) < 1.5
        assert np.quantile(apart, 0.98) <= 8


def test_3dgs_declares_what_lenses_recorded_where_registration_believes_their_pinholes(
    scenario, monkeypatch
):
    monkeypatch.setattr(
        reconstruction, "model_of", lambda made, *_: Model(scene_of(made), SkyMask([]))
    )
    cover = LensCover(scenario.cameras)
    fitted = replace(cover.drawn(scenario), degradation=Degradation(pose_error_m=0.1))
    poses = {}
    for cameras in (None, scenario.cameras):
        renderer = ReconstructionRenderer(fitted, "cpu", 1, cameras)
        for frame in renderer.recorded():
            poses[frame.t_us, frame.camera] = frame
    frames = [frame for frame in poses.values() if frame.camera == "side"]
    assert len(frames) > 1
    assert {frame.lens for frame in frames} == {FISHEYE}
    for frame in frames:
        true = interpolate(scenario.ego_log, frame.t_us) @ lens_spec().T_rig_camera
        assert np.linalg.norm(frame.T_world_camera[:3, 3] - true[:3, 3]) > 1e-3
        for side in cover.sides["side"]:
            pinhole = poses[frame.t_us, f"side.{side.side}"]
            believed = frame.T_world_camera @ side.T_lens_pinhole
            np.testing.assert_allclose(pinhole.T_world_camera, believed, atol=1e-9)
    rgb, distance = frames[0].read()
    assert rgb.shape == (120, 160, 3)
    assert np.median(distance[90, 40:120]) < 10
