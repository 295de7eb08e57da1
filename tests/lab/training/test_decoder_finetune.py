"""Adapting the decoder: the rollouts are the deployed generator's, only the decoder learns, and
pictures get nearer to the truth.
"""

import json

import numpy as np
import pytest
import torch

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.training.decoder_finetune import DecoderRecipe, Rollouts
from alpasim_plugin.lab.training.decoder_finetune_run import finetune_decoder
from alpasim_plugin.lab.training.fixer_run import train_fixer
from alpasim_plugin.lab.training.trainer import Schedule
from alpasim_plugin.lab.training.vae import load_tiny_vae
from tests.block_fixers.fixer_cases import fixer, run_blocks, small_settings
from tests.fixers.clip_cases import maps_of, moving_picture, pixels
from tests.lab.training.test_generator import FORM, brightness, clips_of, data, run_of  # noqa: F401 - data is a fixture

RECIPE = DecoderRecipe(clips=2, rows=4, columns=4, perceptual_weight=0.1)


@pytest.fixture(scope="module")
def bundle(data, tmp_path_factory):
    return train_fixer(
        run_of(data, "V9"), tmp_path_factory.mktemp("run") / "v9", ("brightness", brightness)
    )


def vae_of(bundle):
    return load_tiny_vae(bundle)


def net_of(bundle):
    tensors = {key: value.float() for key, value in load_weights(bundle).items()}
    return CosmosCausalDiT.from_state_dict(
        {key[4:]: value for key, value in tensors.items() if key.startswith("dit.")}
    )


def test_rollouts_are_those_of_the_shared_rollout_and_are_made_once(data, bundle, tmp_path):
    clips, net = clips_of(data, tmp_path / "z"), net_of(bundle)
    rollouts = Rollouts(clips, vae_of(bundle), net, 2, 4, "drawn", tmp_path / "r")
    assert len(rollouts) == len(clips)
    clip, z = rollouts[2]
    assert z.shape == clip.z_0.shape
    assert torch.isfinite(z).all()
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "r").rglob("*.npy")}
    Rollouts(clips, vae_of(bundle), net, 2, 4, "drawn", tmp_path / "r")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "r").rglob("*.npy")} == files
    other = net_of(bundle)
    with torch.no_grad():
        other.final_layer.linear.weight.add_(0.1)
    assert (
        Rollouts(clips, vae_of(bundle), other, 2, 4, "drawn", tmp_path / "r").digest
        != rollouts.digest
    )


def test_only_the_decoder_learns_and_pictures_get_nearer(data, bundle, tmp_path):
    schedule = Schedule(30, peak_lr=5e-3, warmup=3, ema=0.5, save_every=10)
    path = finetune_decoder(
        bundle, data, tmp_path / "decoder", FORM, RECIPE, schedule, ("brightness", brightness)
    )
    before, after = load_weights(bundle), load_weights(path)
    assert before.keys() == after.keys()
    changed = {key for key in before if not torch.equal(before[key], after[key])}
    assert changed
    assert all(key.startswith("vae.decoder.") for key in changed)
    rows = [
        json.loads(line) for line in (tmp_path / "decoder" / "log.jsonl").read_text().splitlines()
    ]
    gains = [row["psnr_db"] - row["render_psnr_db"] for row in rows]
    assert np.mean(gains[-8:]) > np.mean(gains[:8]) + 0.5, "decibels over the render"
    card = json.loads(path.with_suffix(".card.json").read_text())
    assert card["training"]["recipe"]["rows"] == 4
    frames = moving_picture(13)
    session = fixer(
        small_settings("window=4", "holes=noise", "history=finalise", f"weights.bundle={path}")
    )
    assert "decoder 30 updates" in session.label
    assert pixels(run_blocks(session, frames, maps_of(frames))).shape[0] == 13
