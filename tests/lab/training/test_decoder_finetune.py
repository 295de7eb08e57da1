"""Adapting the decoder: the rollouts are the deployed generator's, only the decoder learns, and
pictures get nearer to the truth.
"""

import json

import numpy as np
import pytest
import torch

from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.training.decoder_finetune import DecoderRecipe
from alpasim_plugin.lab.training.decoder_finetune_run import finetune_decoder
from alpasim_plugin.lab.training.fixer_run import train_fixer
from alpasim_plugin.lab.training.trainer import Schedule
from tests.block_fixers.fixer_cases import fixer, run_blocks, small_settings
from tests.fixers.clip_cases import maps_of, moving_picture, pixels
from tests.lab.training.generator_runs import (
    FORM,
    brightness,
    clips_of,  # noqa: F401 - data is a fixture
    data,  # noqa: F401 - data is a fixture
    run_of,
)

RECIPE = DecoderRecipe(clips=2, rows=4, columns=4, perceptual_weight=0.1)


@pytest.fixture(scope="module")
def bundle(data, tmp_path_factory):
    return train_fixer(
        run_of(data, "V9"), tmp_path_factory.mktemp("run") / "v9", ("brightness", brightness)
    )


def test_only_the_decoder_learns_and_pictures_get_nearer(data, bundle, tmp_path):
    schedule = Schedule(30, peak_lr=5e-3, warmup=3, ema=0.5, save_every=10)
    path = finetune_decoder(
        bundle, data, tmp_path / "decoder", FORM, RECIPE, schedule, ("brightness", brightness)
    )
    before = load_weights(bundle)
    after = load_weights(path)
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
