"""The per-frame fixer computes in a stream what its training computed over a clip."""

import numpy as np
import pytest
import torch

from alpasim_plugin.fixers.network.pixel_generator import noise_key, pixel_noise
from alpasim_plugin.lab.training.pixel_rollout import PixelObjectives, PixelSample, pixel_losses
from tests.examples import first_of
from tests.fixers.clip_cases import SIZE, pixels
from tests.fixers.pixel_cases import FRAMES, MAPS, generator, run, session, write_bundle


def scaled(images):
    return torch.from_numpy(images).float() / 127.5 - 1


@pytest.mark.parametrize("holes", first_of(["noise", "everywhere"]))
def test_streaming_equals_the_rollout_of_the_training(tmp_path, holes):
    bundle = write_bundle(tmp_path / "small.safetensors")
    streamed = pixels(run(session(bundle, "keep_render=false", f"holes={holes}"), FRAMES, MAPS))
    render = scaled(pixels(FRAMES))[None]
    sdmap = scaled(np.stack(MAPS))[None]
    opacity = torch.from_numpy(np.stack([f.alpha for f in FRAMES if f.alpha is not None]))[
        None, ..., None
    ]
    everywhere = np.arange(SIZE[0] * SIZE[1])
    eps = np.stack(
        [
            pixel_noise(noise_key("scene", 0, "front", 0, i), everywhere).reshape(*SIZE, 3)
            for i in range(len(FRAMES))
        ]
    )
    sample = PixelSample(
        render,
        render,
        sdmap,
        opacity,
        torch.from_numpy(eps)[None],
        render[:, 0],
        torch.ones(1),
        0,
        (),
        (0, 0),
        torch.ones(1, 1),
    )
    net = generator().requires_grad_(False)
    objectives = PixelObjectives(
        0, 0, 0, horizon=99, source="mixed" if holes == "noise" else "noise"
    )
    with torch.no_grad():
        whole = pixel_losses(net, sample, net.start(render[:, 0]), objectives, None).predictions[0]
    expected = whole.clamp(-1, 1).add(1).mul(127.5).round().to(torch.uint8).numpy()
    assert np.abs(streamed.astype(int) - pixels(FRAMES)).mean() > 2  # these weights do something
    assert np.abs(streamed.astype(int) - expected).max() <= 1
