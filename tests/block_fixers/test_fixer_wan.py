"""A fixer over Wan latents: published graphs, weights by path, both decoders."""

import numpy as np
import pytest
import torch

from alpasim_plugin.block_fixers.networks import load_networks
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_safetensors
from alpasim_plugin.fixers import fixer_settings
from tests.block_fixers.fixer_cases import Recorded, fixer, run_blocks
from tests.block_fixers.whole_clip import whole_clip
from tests.examples import first_of
from tests.fixers.clip_cases import maps_of, moving_picture, pixels

FRAMES = moving_picture(13)
MAPS = maps_of(FRAMES)


@pytest.fixture
def paths(shared_data, tmp_path):
    """Name the weights of the original networks at small sizes, and a prompt for them."""
    folder = shared_data / "golden-nets"
    prompt = tmp_path / "prompt.safetensors"
    width = load_width(folder / "dit.weights.safetensors")
    write_safetensors(prompt, {"text": torch.linspace(-1, 1, 3 * width).view(3, width)})
    files = {
        "dit": folder / "dit.weights.safetensors",
        "vae": folder / "wan_vae.weights.safetensors",
        "prompt": prompt,
    }
    return [f"weights.{part}={path}" for part, path in files.items()]


def load_width(path):
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        key = next(key for key in file.keys() if key.endswith("crossattn_proj.0.weight"))  # noqa: SIM118
        return int(file.get_slice(key).get_shape()[1])


def settings_of(*overrides):
    settings = fixer_settings("onefixer-2b", ["precision=fp32", "codec_precision=fp32", *overrides])
    assert isinstance(settings, OneFixerSettings)
    return settings


@pytest.mark.parametrize("decoder", first_of(["taehv", "latent"]))
def test_blocks_equal_the_whole_clip(paths, shared_data, decoder):
    taehv = f"weights.decoder={shared_data / 'golden-nets' / 'taehv.weights.safetensors'}"
    settings = settings_of(
        *paths, f"decoder.kind={decoder}", *([taehv] if decoder == "taehv" else [])
    )
    session = fixer(settings)
    assert session.trained
    assert session.label == "onefixer-2b, weights of dit.weights.safetensors"
    out = pixels(run_blocks(session, FRAMES, MAPS))
    assert (
        np.abs(out.astype(int) - whole_clip(settings, Recorded(FRAMES, MAPS), "scene", 0)).max()
        <= 1
    )
    assert np.abs(out.astype(int) - pixels(FRAMES)).mean() > 1


def test_parts_that_are_missing_are_named(paths):
    for missing, _part in (
        (paths[:2], "prompt"),
        (paths[1:], "dit"),
        ([paths[0], paths[2]], "vae"),
        (paths, "decoder"),
    ):
        with pytest.raises(InputError):
            load_networks(settings_of(*missing))


def test_random_weights_stand_in_for_timing():
    sizes = [
        "width=24",
        "blocks=1",
        "head_width=12",
        "mlp_width=24",
        "adaln_rank=4",
        "text_width=8",
        "context_width=8",
    ]
    small = [f"dit.{size}" for size in sizes] + [
        "vae.base=8",
        "untrained=random",
        "decoder.kind=latent",
        "precision=bf16",
    ]
    session = fixer(settings_of(*small))
    assert session.label == "onefixer-2b, untrained (random)"
    assert len(session.step(FRAMES[:5], MAPS[:5])) == 5
