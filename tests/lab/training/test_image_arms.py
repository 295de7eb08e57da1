"""Every image arm by the command: what it trains, and that its bundle drives as a fixer."""

import json

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from alpasim_plugin.block_fixers.dit import initial_weights
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.core.files.atomic import write_safetensors
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.fixers.refine import refine_frames
from alpasim_plugin.lab.cli.train import app
from alpasim_plugin.lab.training.bundle_fixer import bundle_fixer
from alpasim_plugin.lab.training.recipes.image_arms import IMAGE_ARMS
from tests.fixers.clip_cases import moving_picture, pixels
from tests.lab.training.pair_files import make

TRAINED = {
    "difix": {"dit", "vae.decoder"},
    "harmonizer": {"dit", "vae.encoder", "vae.decoder"},
    "gsfix3d": {"dit"},
    "3dgs-enhancer": {"dit"},
    "harmonizer-temporal": {"dit", "vae.encoder", "vae.decoder"},
    "harmonizer-temporal-teacher": {"dit", "vae.encoder", "vae.decoder"},
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("pairs")
    make(root, name="a", frames=31)
    make(root, name="b", frames=26)
    TinyVAE.random(TinySizes(16, 16, 16, 16, 16)).save(root / "vae.safetensors")
    write_safetensors(
        root / "dit.safetensors", initial_weights(DiTSizes(24, 2, 12, 40, 5, 7, 9), 0)
    )
    return root


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture
def train(data, runs):
    """Return a function that trains a recipe for some updates by the command and returns its
    folder.
    """

    def run(recipe, updates, folder, *more):
        torch.set_num_threads(1)
        start = "init-bi" if recipe == "3dgs-enhancer" else "init"
        options = {
            "--vae": data / "vae.safetensors",
            "--weights": f"{start}={data / 'dit.safetensors'}",
            "--out": runs / folder,
            "--recipe": recipe,
            "--steps": 3,
            "--stop-at": updates,
            "--clips": 2,
            "--accumulate": 1,
            "--columns": 4,
            "--latents": 7,
            "--lr": 0.01,
        }
        done = CliRunner().invoke(
            app, ["fixer", str(data), *(str(x) for pair in options.items() for x in pair), *more]
        )
        if done.exception is not None:
            raise done.exception
        return runs / folder

    return run


@pytest.fixture
def trained(train, runs):
    """Return a function that gives a recipe's bundle, trained once."""

    def bundle(recipe):
        folder = runs / recipe
        if not (folder / "fixer.safetensors").exists():
            from_frames = f"harmonizer={bundle('harmonizer')}" if "temporal" in recipe else ""
            train(recipe, 2, recipe, *(("--weights", from_frames) if from_frames else ()))
        return folder / "fixer.safetensors"

    return bundle


NAMES = [arm.name for arm in IMAGE_ARMS]
QUICK = (
    "difix",
    "harmonizer-temporal",
    "gsfix3d",
    "3dgs-enhancer",
)  # the temporal one trains harmonizer first


@pytest.mark.parametrize(
    "recipe",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in NAMES],
)
def test_an_arm_trains_its_parts_and_its_bundle_is_a_fixer(data, trained, recipe):
    path = trained(recipe)
    card = json.loads(path.with_suffix(".card.json").read_text())
    assert (card["training"]["recipe"], set(card["training"]["trained"])) in [
        (recipe, TRAINED[recipe]),
        (recipe, {"dit", "vae"}),
    ]
    after = load_weights(path)
    vae = load_weights(data / "vae.safetensors")
    learned = [
        key
        for key, value in after.items()
        if key.startswith("vae.") and not torch.equal(value, vae[key[4:]].half())
    ]
    assert {".".join(key.split(".")[:2]) for key in learned} == TRAINED[recipe] - {"dit"}
    name, overrides = bundle_fixer(path)
    fixer = make_fixer(name, fixer_settings(name, overrides), scene_id="scene")
    assert name == recipe.removesuffix("-teacher")
    assert fixer.trained
    assert f"{recipe}, 2 of " in fixer.label
    frames = moving_picture(6)
    fixed = [
        frame
        for block in refine_frames([(frame, None) for frame in frames], fixer)
        for frame in block.fixed
    ]
    assert np.abs(pixels(fixed).astype(int) - pixels(frames)).max() > 0
    assert [frame.t_us for frame in fixed] == [frame.t_us for frame in frames]
