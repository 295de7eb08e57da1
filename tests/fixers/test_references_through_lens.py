"""Recorded frames carried into the image of a lens, and those that a lens recorded, against the point
that each pixel sees.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.cameras.lens import intrinsics_on_axis, projected
from alpasim_plugin.cameras.shutter import rolling
from alpasim_plugin.core.geometry import inverse, se2
from alpasim_plugin.core.types import Box, CameraSpec, Exposure, Frame, LensModel, RenderRequest
from alpasim_plugin.fixers.ground import FARTHEST_M, carry, ground_hypothesis, with_users
from alpasim_plugin.fixers.references import ReferenceSession
from alpasim_plugin.fixers.warp import (
    TAPS,
    VALID,
    RecordedImage,
    WarpTarget,
    boxes_on_rays,
    on_boxes,
    recorded_lens,
    warp,
)
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.scene.scene_graph import posed
from alpasim_plugin.renderers.gaussian import clear_cache, scene_of
from alpasim_plugin.renderers.recorded import built_recording
from alpasim_plugin.runs.renderer import make_renderer
from tests.camera_builders import ahead
from tests.gaussians.scene_maps import camera_spec, parked, straight
from tests.renderers import requests

W, H = 160, 120
FORWARD = ahead()
BALL_M = 8.0  # the radius of a ball from within which all cameras look
NOBODY = {}


def spec_of(lens, focal=44.0, name="side"):
    K = np.array([[focal, 0, W / 2 + 1.5], [0, focal, H / 2 - 2], [0, 0, 1.0]])
    return CameraSpec(name, W, H, K, np.eye(4), 0, lens)


SPECS = {
    "pinhole": spec_of(None, 70.0),
    "opencv": spec_of(LensModel("opencv", (-0.2, 0.03, 2e-3, -1e-3)), 80.0),
    "fisheye": spec_of(LensModel("fisheye", (0.01,), max_angle_rad=np.deg2rad(98))),
    "ftheta": spec_of(LensModel("ftheta", (0.0, 60.0, 0.0, -1.0), (), (1.01, 0.01, -0.02))),
}
LENSES = ["opencv", "fisheye", "ftheta"]
FISHEYE_AND_SLOW_OTHERS = [
    "fisheye",
    *(pytest.param(name, marks=pytest.mark.slow) for name in LENSES if name != "fisheye"),
]


def at(x, y=0.0, yaw=0.0, z=0.0):
    return se2(x, y, yaw, z) @ FORWARD


def sights(spec, T_world_camera):
    """What each pixel sees at depth 1, in the camera's axes, and where it sees anything."""
    camera = posed(spec, T_world_camera)
    if isinstance(camera, LensCamera):
        return camera.rays(), camera.visible
    u, v = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    plane = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(spec.K).T
    return plane, np.ones((H, W), dtype=bool)


def ball_depth(spec, T):
    """The depth of the ball about the world's origin."""
    ray = sights(spec, T)[0] @ T[:3, :3].T
    a = (ray**2).sum(axis=-1)
    b = ray @ T[:3, 3]
    return (-b + np.sqrt(b**2 - a * (T[:3, 3] @ T[:3, 3] - BALL_M**2))) / a


def points_of(spec, T, depth):
    return (sights(spec, T)[0] * depth[..., None]) @ T[:3, :3].T + T[:3, 3]


def painted(points):
    return np.round(127.5 + 127 * points / BALL_M).astype(np.uint8)


def recorded(spec, T, rgb, depth, actors=NOBODY):
    lens = recorded_lens(spec)
    return RecordedImage(spec.K, T, rgb, depth.astype(np.float32), actors, lens=lens)


def target(spec, T, depth, actors=NOBODY, boxes=NOBODY):
    rays = None if spec.lens is None else sights(spec, T)[0]
    return WarpTarget(spec.K, T, depth.astype(np.float32), actors, boxes, rays=rays)


def place_in(spec, T, points):
    """Return the pixels at which a camera shows points of the world, and which its image shows."""
    local = (points.reshape(-1, 3) - T[:3, 3]) @ T[:3, :3]
    if spec.lens is None:
        pixel = local @ spec.K.T
        pixel, good = pixel[:, :2] / pixel[:, 2:], local[:, 2] > 0.3
    else:
        pixel, good = projected(spec, local)
    inside = good & ((pixel >= 0) & (pixel < [W, H])).all(axis=1)
    return pixel.reshape(H, W, 2), inside.reshape(H, W)


PAIRS = [
    ("fisheye", "fisheye"),
    ("ftheta", "opencv"),
    ("pinhole", "fisheye"),
    ("fisheye", "pinhole"),
]


@pytest.mark.parametrize(("then", "now"), PAIRS)
def test_each_pixel_of_a_lens_shows_the_point_that_it_sees_where_that_was_recorded(then, now):
    """Also beside and behind the camera and up to the edges; elsewhere nothing is shown."""
    there, here = at(1.0, -0.5, 0.5, 0.2), at(-0.8, 0.4, 0.0)
    view, source = SPECS[now], SPECS[then]
    depth = ball_depth(view, here)
    depth_then = ball_depth(source, there)
    rgb = painted(points_of(source, there, depth_then))
    rgb[~sights(source, there)[1]] = 0
    out = warp(recorded(source, there, rgb, depth_then), target(view, here, depth))
    points = points_of(view, here, depth)
    pixel, inside = place_in(source, there, points)
    visible = sights(source, there)[1]
    at_pixel = np.where(inside[..., None], pixel, 0).astype(int)
    row, column = at_pixel[..., 1], at_pixel[..., 0]
    padded = np.pad(visible, TAPS, constant_values=True)
    sides = range(2 * TAPS + 1)
    whole = np.all([padded[row + i, column + j] for i in sides for j in sides], axis=0) & inside
    held = out[..., 3] > 0
    assert np.mean(held == whole) > 0.999  # a pixel at an edge may fall to either side
    assert (out[held, 3] == VALID).mean() > 0.999
    off = np.abs(out[..., :3].astype(int) - painted(points)).max(axis=-1)[held & whole]
    assert off.max() <= 4
    assert off.mean() < 0.6
    assert held.mean() > 0.15
    behind = sights(view, here)[0][..., 2] < 0
    if then == now == "fisheye":
        assert (held & behind).sum() > 50


@pytest.mark.parametrize(("then", "now"), PAIRS)
def test_a_card_carries_frames_from_lens_to_lens_as_the_cpu_does(then, now):
    """Beside a frame of another camera, and with a road user that has moved."""
    pytest.importorskip("torch")
    import torch

    from alpasim_plugin.fixers.device_carry import CarriedView, carry_on_device, upload_image

    boxes = {"car": Box(4.0, 2.0, 1.6)}
    here = at(-0.8, 0.4, 0.0)
    below = se2(0.0, 0.0, 0.0, -1.5)
    frames = []
    for name, there in ((then, at(1.0, -0.5, 0.5, 0.2)), ("pinhole", at(0.4, 0.2, -0.2))):
        depth_then = ball_depth(SPECS[name], there)
        rgb = painted(points_of(SPECS[name], there, depth_then))
        actors = {"car": se2(4.0, 2.5, 0.2)}
        frames.append(with_users(recorded(SPECS[name], there, rgb, depth_then, actors), boxes))
    view = target(SPECS[now], here, ball_depth(SPECS[now], here), {"car": se2(3, 3, 0.3)}, boxes)
    wanted = carry(frames, view, below)
    rays = view.rays if view.rays is None else torch.tensor(view.rays.transpose(2, 0, 1))
    there = replace(view, depth=torch.from_numpy(view.depth), rays_on_device=rays)
    uploaded = [upload_image(frame, torch.device("cpu")) for frame in frames]
    (images,) = carry_on_device([CarriedView(uploaded, there, below)])
    for image, due in zip(images.numpy(), wanted, strict=True):
        apart = np.abs(image.astype(int) - due).max(axis=-1)
        assert (due[..., 3] > 0).mean() > 0.1
        # A window at the first row of the ground ends at another row than the processor's.
        assert (apart > 1).mean() < 0.01


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(("then", "now"), [*PAIRS, ("opencv", "fisheye")])
def test_views_through_lenses_are_carried_while_their_memory_holds_them(
    then, now, count, monkeypatch
):
    pytest.importorskip("torch")
    import torch

    from alpasim_plugin.fixers import device_carry
    from tests.fixers.memory import Memory

    here = at(-0.8, 0.4, 0.0)
    images = []
    for i in range(count):
        there = at(1.0 + 0.1 * i, -0.5, 0.5, 0.2)
        depth_then = ball_depth(SPECS[then], there)
        rgb = painted(points_of(SPECS[then], there, depth_then))
        frame = with_users(recorded(SPECS[then], there, rgb, depth_then), {})
        images.append(device_carry.upload_image(frame, torch.device("cpu")))
    view = target(SPECS[now], here, ball_depth(SPECS[now], here))
    rays = None if view.rays is None else torch.tensor(view.rays.transpose(2, 0, 1))
    view = replace(view, depth=torch.from_numpy(view.depth), rays_on_device=rays)
    below = se2(0.0, 0.0, 0.0, -1.5)
    views = [device_carry.CarriedView(images, view, below)] * 4
    room = 4.01 * count * W * H * device_carry.LENS_PIXEL_BYTES
    monkeypatch.setattr(device_carry, "WORKING_BYTES", int(room))
    with Memory() as memory:
        device_carry.carry_on_device(views)
    assert 0.4 * room < memory.most < room


@pytest.mark.parametrize("name", LENSES)
def test_a_frame_carried_into_the_lens_that_recorded_it_is_itself(name):
    spec, T = SPECS[name], at(3.0, 1.0, 0.3)
    rng = np.random.default_rng(0)
    depth = rng.uniform(2, 60, (H, W)).astype(np.float32)
    depth[:30] = 0  # sky
    rgb = rng.integers(0, 256, (H, W, 3), dtype=np.uint8)
    frame = recorded(spec, T, rgb, depth)
    out = warp(frame, target(spec, T, depth))
    inner = frame.lens.visible
    assert (out[inner, 3] == VALID).mean() > 0.999
    assert np.abs(out[..., :3].astype(int) - rgb).max(axis=-1)[inner].mean() < 2.0
    assert (out[~sights(spec, T)[1]] == 0).all()


def test_a_car_beside_a_fisheye_is_looked_up_where_it_was_also_behind_its_plane():
    spec = SPECS["fisheye"]
    boxes = {"car": Box(4.0, 2.0, 1.6)}
    now, then = se2(-0.6, 3.5, 0.2, 0.3), se2(2.5, 4.5, 0.0, 0.3)
    view, there = at(0.0), at(0.5, 0.3, 0.1)
    rays = sights(spec, view)[0]
    placed = boxes_on_rays(rays, view, {"car": now}, boxes).boxes
    on_car = on_boxes((H, W), placed, rays)
    # Its near wall, as seen by each ray
    local = rays @ (inverse(now) @ view)[:3, :3].T
    eye = (inverse(now) @ view)[:3, 3]
    with np.errstate(divide="ignore"):
        wall = (-1.0 - eye[1]) / local[..., 1]
    on_wall = eye + local * wall[..., None]
    hit = (wall > 0) & (np.abs(on_wall[..., 0]) < 2) & (np.abs(on_wall[..., 2]) < 0.7)
    assert (hit & on_car).sum() == hit.sum() > 100
    assert (rays[..., 2][hit] < 0).any()
    depth = np.where(hit, wall, 0.0)
    columns = np.repeat(np.arange(W, dtype=np.uint8)[None, :, None], H, 0).repeat(3, 2)
    far = np.full((H, W), 50.0)
    out = warp(
        recorded(spec, there, columns, far, {"car": then}),
        target(spec, view, depth, {"car": now}, boxes),
    )
    points = points_of(spec, view, depth) @ inverse(now)[:3, :3].T + inverse(now)[:3, 3]
    moved = points @ then[:3, :3].T + then[:3, 3]
    pixel, inside = place_in(spec, there, moved)
    shown = hit & (out[..., 3] > 0)
    assert shown.sum() > 0.8 * (hit & inside).sum() > 80
    assert np.abs(out[..., 0] + 0.5 - pixel[..., 0])[shown].max() < 0.6
    stood = warp(
        recorded(spec, there, columns, far), target(spec, view, depth, {"car": now}, boxes)
    )
    assert (stood[hit, 3] == 0).all()  # it was not there


@pytest.mark.parametrize("name", LENSES)
def test_no_ray_of_a_lens_that_meets_a_box_is_left_out(name):
    spec, T = SPECS[name], at(0.0, 0.0, 0.0, 1.5)
    rng = np.random.default_rng(1)
    places = {f"{i}": se2(*rng.uniform(-9, 9, 2), rng.uniform(0, 6), 0.8) for i in range(40)}
    places["around"] = se2(0.5, 0.2, 0.3, 1.2)
    boxes = {box: Box(*rng.uniform((0.2, 0.2, 0.2), (12, 2.5, 3.5))) for box in places}
    rays = sights(spec, T)[0]
    placed = boxes_on_rays(rays, T, places, boxes).boxes
    whole = replace_windows(placed, (0, H, 0, W))
    for i in range(len(placed.ray)):
        single, all_pixels = (
            type(placed)(*(part[i : i + 1] for part in p)) for p in (placed, whole)
        )
        np.testing.assert_array_equal(
            on_boxes((H, W), single, rays), on_boxes((H, W), all_pixels, rays)
        )
    window = np.diff(placed.pixels.reshape(-1, 2, 2), axis=2).prod(axis=1)
    assert np.median(window) < 0.3 * W * H


def replace_windows(boxes, window):
    return boxes._replace(pixels=np.tile(np.array(window), (len(boxes.ray), 1)))


@pytest.mark.parametrize("name", LENSES)
def test_the_ground_of_a_lens_lies_where_its_rays_meet_it(name):
    spec = SPECS[name]
    T = at(2.0, 0.3, 0.2, 1.4)
    view = target(spec, T, np.zeros((H, W)))
    distance = ground_hypothesis(view, se2(1.0, 0.0, 0.1))
    points = points_of(spec, T, distance)
    np.testing.assert_allclose(points[distance > 0][:, 2], 0.0, atol=1e-4)
    falls = (sights(spec, T)[0] @ T[:3, :3].T)[..., 2]
    assert ((distance > 0) == (falls < -T[2, 3] / FARTHEST_M)).mean() > 0.999
    box = {"car": Box(4.0, 2.0, 1.5)}
    car = {"car": se2(6.0, 0.0, 0.0, 0.75)}
    held = ground_hypothesis(replace(view, actors=car, boxes=box), se2(1.0, 0.0, 0.1))
    covered = on_boxes((H, W), boxes_on_rays(view.rays, T, car, box).boxes, view.rays)
    np.testing.assert_array_equal(held > 0, (distance > 0) & ~covered)


@pytest.fixture(scope="module")
def street():
    yield straight(actors=(parked("car", 27.0, 1.8),))
    clear_cache()


def session_of_street(street, spec, count=2):
    scenario = replace(street, cameras=(spec,))
    scene = scene_of(scenario)
    frames = built_recording(scenario, scene, scene.render, None, scenario.cameras)
    assert {frame.lens for frame in frames} == {spec.lens}
    near = [frame for frame in frames if 600_000 < frame.t_us < 2_400_000]
    return scenario, ReferenceSession(near, street.actors, street.ego_log, count)


def missed_levels(street, spec):
    """By how many levels the nearest reference misses the street as built in the directions up to 35
    degrees from the axis, where it holds, and the share of all pixels where it does.
    """
    scenario, session = session_of_street(street, spec)
    asked = replace(requests.request(scenario, 8, left_m=0.6), camera=spec)
    frame = make_renderer("clean", scenario, threads=1).render(asked)
    (out,) = session.added([asked], [frame])
    image = out.references[0]
    holds = image[..., 3] == VALID
    off = np.abs(image[..., :3].astype(int) - frame.rgb).mean(axis=-1)
    ray, visible = sights(spec, np.eye(4))
    near_axis = ray[..., 2] > np.cos(np.deg2rad(35)) * np.linalg.norm(ray, axis=-1)
    return float(off[holds & near_axis].mean()), float(holds[visible].mean())


@pytest.mark.parametrize("name", FISHEYE_AND_SLOW_OTHERS)
def test_a_reference_misses_a_street_through_a_lens_by_no_more_than_through_a_pinhole(street, name):
    spec = replace(SPECS[name], T_rig_camera=camera_spec().T_rig_camera)
    pinhole, _ = missed_levels(street, replace(spec, K=intrinsics_on_axis(spec), lens=None))
    missed, share = missed_levels(street, spec)
    assert missed < 1.2 * pinhole
    assert share > 0.85


def test_the_references_of_a_lens_follow_its_rolling_shutter(street):
    """A camera that turns while its shutter is open sees the ball's point of each row's time."""
    spec = replace(SPECS["fisheye"], shutter_us=30_000)
    there, start, end = at(1.0, -0.5, 0.3), at(0.0, 0.0, -0.1), at(0.3, 0.1, 0.1)
    depth_then = ball_depth(spec, there)
    rgb = painted(points_of(spec, there, depth_then))
    frame_then = recorded(spec, there, rgb, depth_then)
    session = ReferenceSession([], (), street.ego_log, 1)
    exposure = Exposure(rolling(W, H, "rows", backwards=False), {})
    request = RenderRequest(0, spec, np.stack([start, end]), {}, exposure=exposure)
    share = np.linspace(0, 1, H)
    poses = [at(0.3 * s, 0.1 * s, -0.1 + 0.2 * s) for s in share]
    depth = np.stack([ball_depth(spec, T)[row] for row, T in enumerate(poses)])
    points = np.stack([points_of(spec, T, depth)[row] for row, T in enumerate(poses)])
    frame = Frame(0, spec.name, rgb, None, depth.astype(np.float32))
    below = se2(0.0, 0.0, 0.0, -50.0)
    ((image,),) = session._carried(
        [(request, [frame_then], below)], [frame], session._carry_on_host
    )
    held = image[..., 3] == VALID
    off = np.abs(image[..., :3].astype(int) - painted(points)).max(axis=-1)
    assert held.mean() > 0.5
    assert off[held].mean() < 1.5
    assert (image[~sights(spec, end)[1]] == 0).all()
    still = target(spec, end, depth)
    (unrolled,) = carry([frame_then], still, below)
    both = held & (unrolled[..., 3] == VALID)
    off_end = np.abs(unrolled[..., :3].astype(int) - painted(points)).max(axis=-1)
    assert off_end[both].mean() > 3 * off[both].mean()


def test_the_pixels_of_a_road_user_in_a_frame_that_a_lens_recorded(street):
    spec, T = SPECS["fisheye"], at(0.0, 0.0, 0.0, 1.0)
    boxes = {"car": Box(4.0, 2.0, 1.6)}
    grey = np.zeros((H, W, 3), dtype=np.uint8)
    frame = recorded(spec, T, grey, np.full((H, W), 20.0), {"car": se2(0.0, 3.0, 0.0, 0.8)})
    users = with_users(frame, boxes).users
    pixel, inside = projected(spec, (np.array([[0.0, 3.0, 0.8]]) - T[:3, 3]) @ T[:3, :3])
    assert inside[0]
    column, row = pixel[0].astype(int)
    assert users[row, column]
    assert 0.02 < users.mean() < 0.3
