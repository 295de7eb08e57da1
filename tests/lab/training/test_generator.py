"""Training a row of the ablation: latents on disk, equal draws, budgets, and a bundle that
drives.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from torch.testing import assert_close

from alpasim_plugin.block_fixers.networks import load_networks
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.training.bundle_fixer import bundle_fixer
from alpasim_plugin.lab.training.clip_batches import BatchForm, ClipBatches, Conditioning
from alpasim_plugin.lab.training.fixer_run import train_fixer
from alpasim_plugin.lab.training.recipes.ablation import ABLATION
from alpasim_plugin.lab.training.shared_rollout import Objectives
from tests.block_fixers.fixer_cases import fixer, run_blocks, small_settings
from tests.fixers.clip_cases import maps_of, moving_picture, pixels
from tests.lab.training.generator_runs import (
    brightness,
    clips_of,
    data,  # noqa: F401 - data is a fixture
    run_of,
)


def objectives_of(recipe):
    objective = recipe.stages[0].objective
    return objective.objectives


def test_latents_are_those_of_a_rollout_that_starts_there_and_are_encoded_once(data, tmp_path):
    clips = clips_of(data, tmp_path)
    assert len(clips) == 2 * (2 + 1)  # starts 0 and 7 of 21 frames, 0 of 14; each mirrored as well
    clip = clips[3]
    assert (clip.start, clip.mirrored) == (7, True)
    frames = np.array(clip.sequence.clip.rgb_gt[7:20, :, ::-1])
    video = torch.from_numpy(frames).permute(3, 0, 1, 2)[None].float() / 127.5 - 1
    with torch.inference_mode():
        wanted = TinyVAE.from_state_dict(load_weights(data / "vae.safetensors")).encode(video)[0]
    assert_close(clip.z_0, wanted, atol=4e-3, rtol=2e-3)  # float16 on disk
    assert clip.m.shape == (1, 4, 4, 6)
    render, opacity = clip.frames(5)
    assert_allclose(
        (render.permute(1, 2, 3, 0) + 1) * 127.5,
        clip.sequence.clip.rgb_input[7:12, :, ::-1],
        atol=1e-3,
    )
    assert set(opacity.unique().tolist()) == {0.0, 1.0}
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npy")}
    clips_of(data, tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npy")} == times


QUICK = ("base", "V5", "V8")  # the branches that V9, which is trained below, does not take


@pytest.mark.parametrize(
    "name",
    [r.name if r.name in QUICK else pytest.param(r.name, marks=pytest.mark.slow) for r in ABLATION],
)
def test_every_row_trains_by_one_function(data, tmp_path, name):
    steps = 3 if name == "V7" else 2  # the last of three is its perceptual term's
    run = run_of(data, name, steps=steps)
    path = train_fixer(run, tmp_path / "run", ("brightness", brightness))
    card = json.loads(path.with_suffix(".card.json").read_text())
    assert card["training"]["recipe"] == name
    assert card["training"]["schedule"]["steps"] == steps
    assert card["curves"][-1]["step"] == steps
    rows = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert len(rows) == steps
    asked = (
        objectives_of(run.recipe) if name not in ("base", "base-bi") else (Objectives("own", 0),)
    )
    assert any("flow" in row for row in rows) == any(o.flow is not None for o in asked)
    assert any("perceptual" in row for row in rows) == any(o.horizon for o in asked)
    assert load_weights(path)["dit.additional_patch_embedding.proj.1.weight"].shape[1] == (
        128 if name == "V6" else 64
    )


def test_a_generator_from_noise_drives_with_the_render_as_its_condition(data, tmp_path):
    path = train_fixer(run_of(data, "V6"), tmp_path / "run", ("brightness", brightness))
    with pytest.raises(InputError):
        load_networks(
            small_settings("window=4", "holes=noise", "history=finalise", f"weights.bundle={path}")
        )
    name, overrides = bundle_fixer(path)
    settings = fixer_settings(name, overrides)
    assert (settings.holes, settings.render_input) == ("everywhere", True)
    frames = moving_picture(5)
    dark = [replace(frame, rgb=frame.rgb // 2) for frame in frames]
    one, other = (
        pixels(run_blocks(fixer(settings), clip, maps_of(frames))) for clip in (frames, dark)
    )
    assert (one != other).any()


def test_a_black_map_is_encoded_in_training_and_on_the_road(data, tmp_path):
    path = train_fixer(run_of(data, "V5"), tmp_path / "run", ("brightness", brightness))
    settings = fixer_settings(*bundle_fixer(path))
    assert (settings.uses_map, settings.no_map) == (False, "black")
    clips = clips_of(data, tmp_path)
    vae = TinyVAE.from_state_dict(load_weights(data / "vae.safetensors"))
    shown = ClipBatches(clips, vae, BatchForm(clips=2, columns=4), Conditioning(map="black"))[
        0
    ].sample.condition
    with torch.inference_mode():
        black = vae.encode(torch.full((1, 3, 13, 32, 48), -1.0))
    assert black.abs().mean() > 0.1
    assert_close(
        shown[:, :, :, :, 2:], black[..., 2:4].expand_as(shown[:, :, :, :, 2:]), atol=1e-5, rtol=0
    )
    frames = moving_picture(5)
    fixed, nothing = (
        pixels(run_blocks(fixer(s), frames, maps_of(frames)))
        for s in (settings, settings.model_copy(update={"no_map": "nothing"}))
    )
    given = settings.model_copy(update={"uses_map": True})
    blacked = pixels(
        run_blocks(fixer(given), frames, [np.zeros_like(frame.rgb) for frame in frames])
    )
    assert_array_equal(fixed, blacked)
    assert (fixed != nothing).any()
