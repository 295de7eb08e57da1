"""Training the tiny autoencoder: draws repeat, the loss falls, quality is what its definition
says.
"""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from alpasim_plugin.block_fixers.codec_weights import LatentStats
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.clips import CropSize, draw_pair_clip, draw_video_clip
from alpasim_plugin.lab.training.trainer import Schedule, Trainer
from alpasim_plugin.lab.training.vae import (
    VaeRecipe,
    VaeTask,
    channel_amplitudes,
    measured_clip,
)
from tests.lab.training.pair_files import make

SIZE = CropSize(5, 16, 32)


def test_a_draw_repeats_and_its_channels_belong_together(tmp_path):
    sequences = [make(tmp_path, name="a"), make(tmp_path, name="b")]
    one, again = (draw_pair_clip(sequences, SIZE, 7, 3) for _ in range(2))
    assert torch.equal(one.target, again.target)
    assert one.target.shape == (3, 5, 16, 32)
    grey, damaged = ((x + 1) * 127.5 for x in (one.target, one.render))
    assert_close(damaged, (grey.round() / 2).floor(), atol=1e-3, rtol=0)
    np.testing.assert_allclose(one.sdmap, -one.target, atol=1e-6)
    assert set(one.opacity.unique().tolist()) <= {0.0, 1.0}
    assert any(
        not torch.equal(one.target, draw_pair_clip(sequences, SIZE, 7, i).target)
        for i in range(4, 8)
    )


def test_clip_larger_than_the_frames_is_refused(tmp_path):
    with pytest.raises(InputError):
        draw_pair_clip([make(tmp_path)], CropSize(5, 64, 64), 0, 0)
    with pytest.raises(InputError):
        draw_video_clip([np.zeros((4, 32, 48, 3), dtype=np.uint8)], SIZE, 0, 0)


def test_clips_that_are_no_whole_groups_are_refused_before_a_training():
    with pytest.raises(InputError, match="1 \\+ 4 k frames"):
        VaeRecipe(size=CropSize(8, 16, 32))


@pytest.mark.parametrize("frames", [12, 13])
def test_statistics_are_measured_on_whole_groups_of_frames(tmp_path, frames):
    clip = measured_clip(make(tmp_path, frames=frames))
    assert clip.shape[2] == {12: 9, 13: 13}[frames]
    assert TinyVAE.random().encode(clip).shape[2] == 1 + (clip.shape[2] - 1) // 4


def test_a_few_updates_lower_the_loss_of_every_kind(tmp_path):
    vae = TinyVAE.random()
    video = make(tmp_path, name="v").clip.rgb_gt
    task = VaeTask(
        vae,
        [make(tmp_path)],
        [np.asarray(video)],
        VaeRecipe(pair_clips=1, size=SIZE, latent_noise=0.0),
    )
    fixed = task.batch(0)
    before = task.loss(fixed, 0)[1]
    Trainer(
        vae,
        tmp_path / "run",
        Schedule(steps=12, peak_lr=2e-3, warmup=2),
        lambda _: fixed,
        task.loss,
        task.facts,
    ).run()
    after = task.loss(fixed, 0)[1]
    for kind in ("latent", "render", "video", "auxiliary"):
        assert after[kind] < before[kind]


def test_channel_amplitudes_are_what_an_error_of_a_channel_does_to_pixels():
    vae = TinyVAE.random(TinySizes(16, 16, 16, 16, 16))
    weights = channel_amplitudes(vae)
    assert float(weights.mean()) == pytest.approx(1.0)
    assert torch.equal(weights, channel_amplitudes(vae))
    assert weights.requires_grad is False
    # Untrained, the picture is linear in the latents: a channel whose unit is five times as large
    # shows five times as strongly.
    assert int(weights.argmax()) == 0, "brightness"
    vae.stats = LatentStats([0.0] * 16, [*[1.0] * 3, 5.0, *[1.0] * 12], stored=True)
    louder = channel_amplitudes(vae)
    assert_close(louder[3] / louder[0], 5 * weights[3] / weights[0], atol=0.0, rtol=1e-3)
    assert_close(louder[4] / louder[0], weights[4] / weights[0], atol=0.0, rtol=1e-3)
