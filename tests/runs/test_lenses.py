"""A run sees its cameras through their lenses, whoever renders and fixes."""

from dataclasses import replace

import numpy as np

from alpasim_plugin.cameras.lens import rays_of
from alpasim_plugin.cameras.lens_cover import LensCover
from alpasim_plugin.cameras.shutter import rolling_exposure
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import CameraSpec, Frame, LensModel, RenderRequest
from alpasim_plugin.fixers.loop import BlockRunner
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import prepare_map
from alpasim_plugin.runs.lenses import LensRenderer


class Directions(Renderer):
    """Paints every pixel with the direction that it sees, and keeps the requests."""

    def __init__(self, scenario):
        self.scenario = scenario
        self.asked = []

    def render(self, request):
        """Draw one frame."""
        self.asked.append(request)
        spec = request.camera
        assert spec.lens is None
        x, y = np.meshgrid(np.arange(spec.width) + 0.5, np.arange(spec.height) + 0.5)
        ray = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(spec.K).T
        ray = ray @ request.T_world_camera[1, :3, :3].T
        unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        return Frame(request.t_us, spec.name, (127.5 + 127 * unit).round().astype(np.uint8))


def fisheye(straight_road):
    K = np.array([[60.0, 0.0, 100.0], [0.0, 60.0, 75.0], [0.0, 0.0, 1.0]])
    lens = LensModel("fisheye", (), max_angle_rad=np.deg2rad(95))
    return CameraSpec("fish", 200, 150, K, straight_road.cameras[0].T_rig_camera, 30_000, lens)


def test_a_frame_shows_the_world_in_the_directions_of_the_lens(straight_road):
    camera = fisheye(straight_road)
    cover = LensCover([camera, straight_road.cameras[0]])
    inner = Directions(straight_road)
    renderer = LensRenderer(inner, cover)
    T = np.stack([np.eye(4) @ camera.T_rig_camera] * 2)
    exposure = rolling_exposure(camera, {}, {}, 100_000)
    plain = RenderRequest(0, straight_road.cameras[0], T, {})
    asked = RenderRequest(0, camera, T, {}, exposure=exposure)
    first, second = renderer.render_batch([plain, replace(asked, ahead=[asked])])
    assert (first.camera, second.camera) == ("front", "fish")
    rays = rays_of(camera)
    unit = rays.ray / np.linalg.norm(rays.ray, axis=1, keepdims=True)
    off = np.abs(second.rgb.reshape(-1, 3) - (127.5 + 127 * unit @ T[1, :3, :3].T)).max(axis=1)
    assert (off[rays.visible] <= 2).mean() > 0.995
    names = [one.name for one in cover.pinholes(camera)]
    sides = ["fish.ahead", "fish.left", "fish.right", "fish.up", "fish.down"]
    assert sorted(names) == sorted(sides)
    assert [request.camera.name for request in inner.asked] == ["front", *names]
    for request in inner.asked[1:]:
        share = request.exposure.share
        assert share.shape == (request.camera.height, request.camera.width)
        (later,) = request.ahead
        assert later.camera.name == request.camera.name
    ahead = inner.asked[1].exposure
    assert abs(float(np.nanmedian(ahead.share)) - 0.5) < 0.02


def test_a_fixer_sees_the_image_of_the_lens(straight_road):
    camera = fisheye(straight_road)
    scenario = replace(straight_road, cameras=(camera,))
    cover = LensCover([camera])
    inner = Directions(scenario)
    T = np.stack([np.eye(4) @ camera.T_rig_camera] * 2)
    runner = BlockRunner(inner.render_batch, prepare_map(scenario.lane_map), (), cover=cover)
    (seen,) = runner.render([RenderRequest(0, camera, T, {})])
    assert seen.frame.rgb.shape == seen.map.shape == (150, 200, 3)
    alone = LensRenderer(inner, cover).render(RenderRequest(0, camera, T, {}))
    np.testing.assert_array_equal(seen.frame.rgb, alone.rgb)


class LensDirections(Renderer):
    """Paints every pixel of a lens with the direction that it sees; all is 5 m away."""

    draws_lenses = True

    def render(self, request):
        """Draw one frame."""
        spec = request.camera
        rays = rays_of(spec)
        unit = rays.ray / np.linalg.norm(rays.ray, axis=1, keepdims=True)
        rgb = (127.5 + 127 * unit @ request.T_world_camera[1, :3, :3].T).round().astype(np.uint8)
        shape = spec.height, spec.width
        depth = np.full(shape, 5.0, dtype=np.float32)
        return Frame(request.t_us, spec.name, rgb.reshape(*shape, 3), None, depth)


class Depths:
    """References that say from which depth they would be carried."""

    def added(self, requests, frames, on_device):
        out = []
        for request, frame in zip(requests, frames, strict=True):
            assert request.camera.lens is not None
            rgba = np.full((*frame.size, 4), 255, dtype=np.uint8)
            rgba[..., 0] = np.round(10 * frame.depth)
            out.append(frame.changed(references=(rgba,)))
        return out


def test_a_fixer_over_a_renderer_of_lenses_has_maps_and_references_of_the_same_lens(straight_road):
    camera = fisheye(straight_road)
    scenario = replace(straight_road, cameras=(camera,))
    cover = LensCover([camera])
    T = np.stack([np.eye(4) @ camera.T_rig_camera] * 2)
    request = RenderRequest(0, camera, T, {})
    scene_map = prepare_map(scenario.lane_map)
    by_pinholes = BlockRunner(Directions(scenario).render_batch, scene_map, (), cover=cover)
    through_lens = BlockRunner(
        LensDirections().render_batch,
        scene_map,
        (),
        references=Depths(),
        cover=cover,
        draws_lenses=True,
    )
    (joined,) = by_pinholes.render([request])
    (seen,) = through_lens.render([request])
    np.testing.assert_array_equal(seen.map, draw_map(scene_map, camera, T[1]))
    np.testing.assert_array_equal(joined.map, seen.map)
    assert seen.map.any()
    visible = rays_of(camera).visible.reshape(150, 200)
    off = np.abs(seen.frame.rgb.astype(int) - joined.frame.rgb)[visible]
    assert np.mean(off <= 2) > 0.995
    (reference,) = seen.frame.references
    assert (reference[..., 0] == 50).all()
