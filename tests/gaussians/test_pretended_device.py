"""Drive what takes a device on a pretended one: the same images as the CPU, within a budget of
waits, launches and bytes.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from alpasim_plugin.core.types import Frame
from alpasim_plugin.fixers import make_fixer
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from tests.gaussians.gaussian_scenes import LSB
from tests.gaussians.test_scene_graph import SKY, blobs, camera, node, se2

pytest.importorskip("triton", reason="Triton is not installed")

from tests.pretended_device import pretended_device

HEIGHT, WIDTH = 64, 96


def frames():
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (4, HEIGHT, WIDTH, 4), dtype=np.uint8)
    opacity = rng.random((4, HEIGHT, WIDTH)).astype(np.float32)
    return [
        Frame(i * 100_000, "front", image[..., :3].copy(), alpha, references=(image,))
        for i, (image, alpha) in enumerate(zip(images, opacity, strict=True))
    ]


def test_a_scene_is_uploaded_once_and_a_frame_waits_once(monkeypatch):
    background = [node(f"b{i}", blobs((8 + 4 * i, 3 - 2 * i, 1.0), n=12, seed=i)) for i in range(4)]
    car = node("car", blobs((0, 0, 0), n=12, seed=9, sheen=True), "actor")
    poses = {"car": se2(9.0, -0.5, 0.7, 1.2)}
    graph = SceneGraph(background, [car], SKY)
    wanted = graph.render(camera(), poses)
    with pretended_device(monkeypatch) as traffic:
        graph.render(camera(), poses, device="cuda:0")
        assert traffic.bytes_up > 60 * 100  # 60 Gaussians
        traffic.reset()
        found = graph.render(camera(), poses, device="cuda:0")
    assert np.abs(found.rgb - wanted.rgb).max() <= LSB
    assert np.abs(found.alpha - wanted.alpha).max() <= LSB
    assert sum(traffic.waits.values()) == 1
    assert traffic.bytes_up < 2_000
    assert traffic.bytes_down == 20 * (found.alpha.size + 1)
    assert traffic.launches <= 20


def test_the_fixer_waits_once_a_frame_and_downloads_bytes(monkeypatch):
    host = make_fixer("onefixer", scene_id="scene")
    wanted = [host.step([frame], [frame.rgb])[0] for frame in frames()]
    with pretended_device(monkeypatch) as traffic:
        device = make_fixer("onefixer", scene_id="scene", device="cuda")
        for frame, due in zip(frames(), wanted, strict=True):
            traffic.reset()
            fixed = device.step([frame], [frame.rgb])[0]
            assert np.abs(fixed.rgb.astype(int) - due.rgb).max() <= 1
            assert fixed.facts.keys() == due.facts.keys()
            assert sum(traffic.waits.values()) == 1
            assert traffic.bytes_up == HEIGHT * WIDTH * (3 + 4 + 3 + 4)
            assert traffic.bytes_down < HEIGHT * WIDTH * 3.1
            assert traffic.launches <= 300


def test_tensors_of_two_devices_do_not_mix(monkeypatch):
    with pretended_device(monkeypatch):
        ours = torch.zeros(3, device="cuda")
        with pytest.raises(RuntimeError):
            ours + torch.zeros(3)
        with pytest.raises(TypeError):
            ours.numpy()
        assert (ours + 1).cpu().tolist() == [1, 1, 1]
