"""The semantic map through lenses, against a reference that follows the ray of every sample."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from alpasim_plugin.cameras.lens import exposed_bands, projected, rays_at, rays_of
from alpasim_plugin.cameras.shutter import rolling
from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Actor, Box, Exposure, LensModel, RenderRequest, Trajectory
from alpasim_plugin.fixers.semantic_map.draw import draw_exposed_maps, draw_map, seen_from
from alpasim_plugin.fixers.semantic_map.prepare import ActorBox, actor_boxes, prepare_map
from alpasim_plugin.fixers.semantic_map.raster import SAMPLES
from alpasim_plugin.fixers.semantic_map.style import DEPTH_MAX_M, NEAR_M, WIDTH_DEFINED_AT_PX
from tests.fixers.views import CAR, EMPTY, PIN, at, line, marked

W, H = 160, 120
K = np.array([[47.0, 0, 79], [0, 47.5, 61.5], [0, 0, 1.0]])
LENSES = {
    "fisheye": (1.0, LensModel("fisheye", (0.02, -0.004), max_angle_rad=np.deg2rad(95))),
    "ftheta": (1.0, LensModel("ftheta", (0.0, 53.0, 0.0, -1.0), (), (1.01, 0.01, -0.02))),
    "ftheta-backward": (1.0, LensModel("ftheta", (), (0.0, 1 / 60, 0.0, 3e-8))),
    "opencv": (2.0, LensModel("opencv", (-0.25, 0.06, 2e-3, -3e-3, 0.0, 0.0, 0.0, 0.0, 1e-3))),
}


def through(name, focal=1.0):
    scale, lens = LENSES[name]
    return replace(PIN, width=W, height=H, K=np.diag([focal * scale] * 2 + [1.0]) @ K, lens=lens)


def street(with_users=True):
    """Lines beside, ahead, behind and below the camera, areas under it, and near road users."""
    ring = line((-6, -3, 0), (-6, 3, 0), (7, 3, 0), (7, -3, 0), (-6, -3, 0))
    far = line((9, -8, 0), (9, 8, 0), (12, 8, 0), (12, -8, 0), (9, -8, 0))
    lane_map = replace(
        marked((line((-30, 1.7, 0), (150, 1.7, 0)), "solid_white")),
        crosswalks=(ring, far),
        road_edges=(line((-40, -4, 0), (5, -4, 0), (150, -20, 1)), line((2, 0.2, 0), (2, -9, 0))),
        poles=(line((4, 3, 0), (4, 3, 6)), line((-1, -3, 0), (-1, -3, 5))),
        signs=((se2(6, -4, np.pi, 2.5), Box(0.1, 0.8, 0.8)),),
    )
    users = (
        ActorBox(se2(9, 0.5, 0.3, 0.8), CAR, "car"),
        ActorBox(se2(0.3, 2.4, 0.1, 0.8), CAR, "bus"),  # 1.4 m beside the camera, and past it
    )
    return prepare_map(lane_map), users if with_users else ()


def depth_of(points):
    return np.abs(points).max(axis=-1)


def reference(scene, camera, pose, users):
    """Draw by following the ray of each sample to every triangle, and by its distance in the image
    from the dense curve of every line.
    """
    _, to_camera, faces, edges = seen_from(scene, camera, pose, users)
    u, v = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    middle = np.stack([u, v], axis=-1)[:, :, None]
    samples = (middle + SAMPLES).reshape(-1, 2)
    rays = rays_at(camera, samples)
    ray = rays.ray / np.linalg.norm(rays.ray, axis=1, keepdims=True)
    nearness = np.zeros(len(samples))
    colour = np.zeros((len(samples), 3))

    def put(is_hit, near, colours):
        nearer = is_hit & (near > nearness)
        nearness[nearer] = near[nearer]
        colour[nearer] = colours[nearer]

    def strokes(part):
        for ends, style in zip(part.ends, part.style, strict=True):
            a, b = ends @ to_camera[:, :3].T + to_camera[:, 3]
            share = np.concatenate([np.linspace(0, 1, 3001), np.geomspace(1e-4, 1, 800)])
            points = a + np.sort(share)[:, None] * (b - a)
            points = points[(depth_of(points) > NEAR_M) & (depth_of(points) < DEPTH_MAX_M)]
            pixel, is_described = projected(camera, points)
            if not is_described.any():
                continue
            stretched = np.array([1.0, W / H])
            tree = cKDTree(pixel[is_described] * stretched)
            half = 0.5 * style[0] * W / WIDTH_DEFINED_AT_PX
            distance, nearest = tree.query(samples * stretched, distance_upper_bound=half)
            depths = np.append(depth_of(points[is_described]), DEPTH_MAX_M)
            depth = depths[nearest]  # the last where no point is so near
            fade = 1 - depth / DEPTH_MAX_M
            near = 1 / np.maximum(depth - style[1], 1e-3)
            put(distance <= half * fade, near, np.round(style[2:5] * fade[:, None]))

    def shapes(part):
        for corners, closed, shade, style in zip(
            part.corners, part.closed, part.shade, part.style, strict=True
        ):
            a, b, c = corners @ to_camera[:, :3].T + to_camera[:, 3]
            normal = np.cross(b - a, c - a)
            if closed and normal @ a >= 0:
                continue
            with np.errstate(all="ignore"):
                t = (normal @ a) / (ray @ normal)
                points = t[:, None] * ray
                area = normal @ normal
                first = np.cross(c - b, points - b) @ normal / area
                second = np.cross(a - c, points - c) @ normal / area
                weights = np.column_stack([first, second, 1 - first - second])
                depth = depth_of(points)
                is_hit = (t > 0) & (weights >= -1e-9).all(axis=1)
                is_hit &= (depth > NEAR_M) & (depth < DEPTH_MAX_M)
                part_of_way = np.clip(weights @ shade, 0, 1)[:, None]
                fade = 1 - depth / DEPTH_MAX_M
                mixed = (style[1:4] + part_of_way * (style[4:7] - style[1:4])) * fade[:, None]
                put(is_hit, 1 / np.maximum(depth - style[0], 1e-3), np.round(mixed))

    strokes(scene.segments)
    shapes(scene.triangles)
    shapes(replace(faces, closed=np.ones_like(faces.closed)))
    strokes(edges)
    image = colour.reshape(H, W, len(SAMPLES), 3).mean(axis=2)
    image[~rays_of(camera).visible.reshape(H, W)] = 0
    return image


def close_to(image, wanted, share, mean):
    off = np.abs(image - wanted).max(axis=2)
    # one sample of four may fall on the other side of an edge
    assert (off > 64).mean() < share
    assert off.mean() < mean


@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_every_sample_shows_what_its_ray_meets(name):
    scene, users = street()
    camera = through(name)
    pose = at(yaw=0.1)
    image = draw_map(scene, camera, pose, users, threads=1)
    wanted = reference(scene, camera, pose, users)
    assert (wanted.max(axis=2) > 0).mean() > 0.02
    close_to(image, wanted, 2e-3, 1.0)


def test_a_lens_without_distortion_shows_what_its_pinhole_shows():
    scene, users = street(with_users=False)
    users = (ActorBox(se2(9, 0.5, 0.3, 0.8), CAR, "car"),)
    camera = replace(PIN, width=256, height=144)
    plain = draw_map(scene, camera, at(), users)
    image = draw_map(scene, replace(camera, lens=LensModel("opencv")), at(), users)
    close_to(image, plain.astype(float), 2e-3, 0.5)


def test_nothing_is_drawn_where_the_lens_sees_nothing():
    scene, users = street()
    camera = through("fisheye", 0.6)
    image = draw_map(scene, camera, at(), users)
    visible = rays_of(camera).visible.reshape(H, W)
    assert 0.3 < visible.mean() < 0.95
    assert not image[~visible].any()
    assert image[visible].any()


def test_an_area_behind_the_camera_does_not_fold_into_the_image():
    ring = line((-3, -3, -2), (-3, 3, -2), (-3, 3, 4), (-3, -3, 4), (-3, -3, -2))
    scene = prepare_map(replace(EMPTY, crosswalks=(ring,)))
    assert not draw_map(scene, through("fisheye"), at()).any()


def test_rows_of_a_rolling_shutter_show_the_map_at_their_time():
    scene, _ = street(with_users=False)
    camera = through("ftheta")
    first = at(yaw=0.1)
    last = at(x=0.4, yaw=0.14)
    car = Actor("car", "car", CAR, Trajectory(np.array([0]), np.zeros((1, 3)), np.eye(4)[:1]))
    exposure = Exposure(rolling(W, H, "rows", backwards=False), {"car": se2(9, 0.5, 0.3, 0.8)})
    request = RenderRequest(
        0, camera, np.stack([first, last]), {"car": se2(8.8, 0.5, 0.3, 0.8)}, exposure=exposure
    )
    (image,) = draw_exposed_maps(scene, [request], [car])
    cut = exposed_bands(request)
    assert len(cut) > 3
    for band in cut:
        users = actor_boxes(band.actors, [car])
        at_once = draw_map(scene, camera, band.T_world_camera, users)
        np.testing.assert_array_equal(image[band.rows], at_once[band.rows])
    assert (image != draw_map(scene, camera, last, actor_boxes(request.actors, [car]))).any()


def test_the_image_depends_on_no_number_of_threads():
    scene, users = street()
    images = [draw_map(scene, through("ftheta"), at(), users, threads=n) for n in (1, 2)]
    np.testing.assert_array_equal(*images)
