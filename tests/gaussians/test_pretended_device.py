"""Drive what takes a device on a pretended one: the same images as the CPU, within a budget of
waits, launches and bytes.
"""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from alpasim_plugin.alpasim.server.caches import SceneEntry
from alpasim_plugin.cameras.lens_cover import LensCover
from alpasim_plugin.cameras.shutter import rolling
from alpasim_plugin.core.devices import CapturedFunction, share_card, sizes_of, upload_together
from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import (
    OPACITY_MEAN,
    RECORDED_SHARE,
    CameraSpec,
    Exposure,
    Frame,
    LensModel,
    RecordedFrame,
    RenderRequest,
    Trajectory,
)
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.fixers.loop import BlockRunner
from alpasim_plugin.fixers.references import ReferenceSession
from alpasim_plugin.fixers.semantic_map.prepare import prepare_map
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from alpasim_plugin.renderers.rolling import camera_at, draw_requests
from tests.examples import first_of, first_rows_of
from tests.fixers.views import line, marked
from tests.gaussians.gaussian_scenes import LSB
from tests.gaussians.graph_scenes import SKY, blobs, camera, node

pytest.importorskip("triton", reason="Triton is not installed")

from tests.pretended_device import pretended_device, traffic

HEIGHT = 64
WIDTH = 96
FISHEYE = LensModel("fisheye", (0.01,), max_angle_rad=1.5)


def camera_size():
    return camera().height, camera().width


def frames():
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (4, HEIGHT, WIDTH, 4), dtype=np.uint8)
    opacity = rng.random((4, HEIGHT, WIDTH)).astype(np.float32)
    return [
        Frame(i * 100_000, "front", image[..., :3].copy(), alpha, references=(image,))
        for i, (image, alpha) in enumerate(zip(images, opacity, strict=True))
    ]


def scene():
    background = [node(f"b{i}", blobs((8 + 4 * i, 3 - 2 * i, 1.0), n=12, seed=i)) for i in range(4)]
    car = node("car", blobs((0, 0, 0), n=12, seed=9, sheen=True), "actor")
    return SceneGraph(background, [car], SKY), {"car": se2(9.0, -0.5, 0.7, 1.2)}


def test_a_scene_is_uploaded_once_and_a_frame_waits_when_it_is_read(monkeypatch):
    graph, poses = scene()
    wanted = graph.render(camera(), poses).surface().frame(0, "front")
    with pretended_device(monkeypatch) as traffic:
        graph.render(camera(), poses, device="cuda:0")
        assert traffic.bytes_up > 60 * 100  # 60 Gaussians
        traffic.reset()
        found = graph.render(camera(), poses, device="cuda:0").surface().frame(0, "front")
        assert not traffic.waits
        assert found.size == wanted.size
        assert np.abs(found.rgb.astype(int) - wanted.rgb).max() <= 1
        assert np.abs(found.alpha - wanted.alpha).max() <= LSB
        assert (np.abs(found.depth - wanted.depth) > 1e-3).mean() < 1e-3
    assert sum(traffic.waits.values()) == 1
    assert traffic.bytes_up < 3_000
    assert traffic.bytes_down == 11 * found.alpha.size + 8
    assert traffic.launches <= 40


@pytest.mark.parametrize(
    "lens",
    [
        pytest.param(None, id="pinhole"),
        pytest.param(FISHEYE, id="fisheye", marks=pytest.mark.slow),
    ],
)
def test_a_rolling_shutter_is_drawn_in_one_pass_as_on_the_cpu(monkeypatch, lens):
    graph, _ = scene()
    T = np.linalg.inv(camera().T_camera_world)
    spec = CameraSpec("front", *camera_size()[::-1], camera().K, T, lens=lens)
    exposure = Exposure(
        rolling(spec.width, spec.height, "rows", backwards=False), {"car": se2(8.5, -0.5, 0.7, 1.2)}
    )
    actors = {"car": se2(9.0, -0.5, 0.72, 1.2)}
    poses = np.stack([se2(0.3, 0, 0.02) @ T, T])
    request = RenderRequest(0, spec, poses, actors, exposure=exposure)

    def drawn(device):
        draw = partial(graph.render_all, device=device)
        return draw_requests([request], draw)[0].frame(0, "front")

    wanted = drawn("cpu")
    with pretended_device(monkeypatch) as traffic:
        found = drawn("cuda:0")
        assert not traffic.waits
        assert np.abs(found.rgb.astype(int) - wanted.rgb).max() <= 1
    assert sum(traffic.waits.values()) == 1


@pytest.mark.parametrize(
    ("capacity", "lens"), first_rows_of([(1 << 12, None), (1 << 12, FISHEYE), (10, None)])
)
def test_a_frame_its_references_and_its_map_stay_on_the_device(monkeypatch, capacity, lens):
    graph, poses = scene()
    spec = camera(48, 32)  # six tiles: interpreted kernels take a second for each
    T = np.linalg.inv(spec.T_camera_world)
    shown = graph.render(spec, poses).surface()
    rgb = (shown.rgb * 255).astype(np.uint8)
    recorded = [
        RecordedFrame(t, "front", spec.K, T, {}, lambda: (rgb, shown.depth)) for t in range(2)
    ]
    path = Trajectory(np.arange(2), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    view = CameraSpec("front", spec.width, spec.height, spec.K, T, lens=lens)
    request = RenderRequest(100_000, view, np.stack([T, T]), {})

    def rendered(requests, device="cuda:0"):
        views = [(camera_at(asked, asked.T_world_camera[1]), poses) for asked in requests]
        drawn = zip(requests, graph.render_all(views, device=device), strict=True)
        return [out.surface().frame(asked.t_us, asked.camera.name) for asked, out in drawn]

    def made(device):
        return BlockRunner(
            partial(rendered, device=device),
            prepare_map(marked((line((2, 1, 0), (30, 1, 0)), "solid_white"))),
            (),
            references=ReferenceSession(recorded, (), path, 2),
            on_device=True,
            cover=LensCover([view]),
            draws_lenses=True,
        )

    def fixed(device):
        fixer = make_fixer("onefixer", scene_id="scene", device=device)
        runner = made(device)
        for t_us in (0, request.t_us):
            traffic.reset()
            if device != "cpu":
                graph._upload(device, graph.background).clouds.capacity = capacity
            one = replace(request, t_us=t_us)
            (frame,) = runner.fix(fixer, fixer.step, runner.render([one]))
        return frame

    wanted = fixed("cpu")
    assert wanted.facts[RECORDED_SHARE] > 0.05
    with pretended_device(monkeypatch):
        found = fixed("cuda:0")
        assert sum(traffic.waits.values()) == (1 if capacity > 10 else 2)
        assert np.abs(found.rgb.astype(int) - wanted.rgb).max() <= 2
        assert found.facts[RECORDED_SHARE] == pytest.approx(wanted.facts[RECORDED_SHARE], abs=1e-3)
        assert found.facts[OPACITY_MEAN] == pytest.approx(wanted.alpha.mean(), abs=1e-4)
        if capacity > 10:
            # Poses, and what is in view of the map; through a lens the map itself.
            assert traffic.bytes_up < 3_000 + (0 if lens is None else 6_000 + rgb.nbytes)
            assert traffic.bytes_down < 3.1 * rgb[..., 0].size + 200
        if lens is not None:
            return
        renderer = SimpleNamespace(render_batch=rendered)
        served = SceneEntry(None, None, renderer, ReferenceSession(recorded, (), path, 2), True)
        assert np.abs(found.alpha - wanted.alpha).max() <= LSB
        traffic.computes = False  # from here on what is counted is what matters
        traffic.reset()
        assert len(served.render([request], True)[0].pending.references) == 2
        assert not traffic.waits
        launches = []
        for count in (1, 6):
            cameras = [replace(view, name=f"camera {i}") for i in range(count)]
            traffic.reset()
            made("cuda:0").render([replace(request, camera=one) for one in cameras])
            launches.append(traffic.launches)
        assert launches[1] < 1.2 * launches[0]


@pytest.mark.parametrize("capacity", [1 << 12, 10])
def test_references_of_the_pinholes_that_cover_a_lens_reach_its_frame(monkeypatch, capacity):
    """Of a renderer that draws no lenses and leaves its planes on the device, whose lists may be cut."""
    graph, poses = scene()
    pinhole = camera(32, 16)
    T = np.linalg.inv(pinhole.T_camera_world)
    shown = graph.render(pinhole, poses).surface()
    rgb = (shown.rgb * 255).astype(np.uint8)
    recorded = [RecordedFrame(0, "front", pinhole.K, T, {}, lambda: (rgb, shown.depth))]
    path = Trajectory(np.arange(2), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    narrow = replace(FISHEYE, max_angle_rad=0.7)
    view = CameraSpec("front", 32, 16, pinhole.K, T, lens=narrow)
    request = RenderRequest(100_000, view, np.stack([T, T]), {})

    def rendered(requests, device):
        views = [(camera_at(asked, asked.T_world_camera[1]), poses) for asked in requests]
        drawn = zip(requests, graph.render_all(views, device=device), strict=True)
        return [out.surface().frame(asked.t_us, asked.camera.name) for asked, out in drawn]

    def references(device):
        runner = BlockRunner(
            partial(rendered, device=device),
            None,
            (),
            references=ReferenceSession(recorded, (), path, 1),
            on_device=True,
            cover=LensCover([view]),
        )
        return runner.render([request])[0].frame.references

    (wanted,) = references("cpu")
    assert (wanted[..., 3] > 0).mean() > 0.2
    with pretended_device(monkeypatch):
        graph._upload("cuda:0", graph.background).clouds.capacity = capacity
        (found,) = references("cuda:0")
    assert (np.abs(found.astype(int) - wanted).max(axis=-1) > 2).mean() < 0.02


@pytest.mark.parametrize("holes", first_of(["noise", "render"]))
def test_the_fixer_waits_once_a_frame_and_replays_its_graph(monkeypatch, holes):
    settings = fixer_settings("onefixer", [f"holes={holes}"])
    host = make_fixer("onefixer", settings, scene_id="scene")
    wanted = [host.step([frame], [frame.rgb])[0] for frame in frames()]
    with pretended_device(monkeypatch) as traffic:
        device = make_fixer("onefixer", settings, scene_id="scene", device="cuda")
        for frame, due in zip(frames(), wanted, strict=True):
            traffic.reset()
            fixed = device.step([frame], [frame.rgb])[0]
            assert np.abs(fixed.rgb.astype(int) - due.rgb).max() <= 1
            assert fixed.facts.keys() == due.facts.keys()
            assert np.array_equal(fixed.image().held, fixed.rgb)
            assert sum(traffic.waits.values()) == 1
            assert traffic.bytes_up == HEIGHT * WIDTH * (3 + 4 + 3 + 4) + 8 * (holes == "noise")
            assert traffic.bytes_down < HEIGHT * WIDTH * 3.1
        assert traffic.launches <= 40


def test_workers_share_the_memory_of_a_card(monkeypatch):
    shares = []
    monkeypatch.setattr(torch.cuda, "set_per_process_memory_fraction", lambda *x: shares.append(x))
    share_card("cpu", 4)
    share_card("cuda:1", 1)
    share_card("cuda:1", 4)
    assert shares == [(0.25, "cuda:1")]


def test_arrays_sent_together_begin_where_kernels_expect_them(monkeypatch):
    arrays = [np.arange(3.0), np.ones((2, 2)), np.zeros((0, 4)), np.arange(5.0)]
    with pretended_device(monkeypatch) as traffic:
        sent = upload_together(arrays, "cuda:0")
        assert traffic.bytes_up == traffic.bytes_pinned == 8 * (4 + 4 + 6)
        assert not any(tensor.storage_offset() % 2 for tensor in sent)
        for tensor, array in zip(sent, arrays, strict=True):
            assert np.array_equal(tensor.cpu().numpy(), array)


def test_tensors_of_two_devices_do_not_mix(monkeypatch):
    with pretended_device(monkeypatch):
        ours = torch.zeros(3, device="cuda")
        with pytest.raises(RuntimeError):
            ours + torch.zeros(3)
        with pytest.raises(TypeError):
            ours.numpy()
        assert (ours + 1).cpu().tolist() == [1, 1, 1]


def test_what_is_captured_neither_waits_nor_copies(monkeypatch):
    with pretended_device(monkeypatch):
        ours = torch.ones(3, device="cuda")
        sizes = sizes_of({"x": ours})
        doubled = CapturedFunction(
            lambda x: (x + torch.ones(3, device="cuda").add_(x),), sizes, ours.device
        )
        for value in (2.0, 5.0):
            (found,) = doubled({"x": ours * value})
            assert found.cpu().tolist() == [2 * value + 1] * 3
        for wrong in (
            lambda x: (x * float(x[0]),),
            lambda x: (x.cpu(),),
            lambda x: (x + torch.ones(3).to("cuda"),),
        ):
            with pytest.raises(RuntimeError):
                CapturedFunction(wrong, sizes, ours.device)
