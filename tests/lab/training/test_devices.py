"""Training on a pretended device: the log and the weights of the CPU, one wait an update."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.training import vae
from alpasim_plugin.lab.training.clips import CropSize
from alpasim_plugin.lab.training.fixer_run import train_fixer
from alpasim_plugin.lab.training.trainer import Trainer
from alpasim_plugin.lab.training.vae import VaeRecipe
from tests.examples import first_of
from tests.lab.training.test_generator import brightness, data, run_of  # noqa: F401 - data is a fixture
from tests.pretended_device import pretended_device, traffic


@pytest.fixture
def waits(monkeypatch):
    """Return the waits of every update, without those of its checkpoint."""
    found = []
    update = Trainer._update

    def counted(trainer):
        traffic.reset()
        numbers = update(trainer)
        found.append(sum(traffic.waits.values()))
        return numbers

    monkeypatch.setattr(Trainer, "_update", counted)
    return found


def trained(recipe, data, folder, device, monkeypatch):
    distance = "brightness", brightness
    if recipe == "vae":
        monkeypatch.setattr(vae, "MEASURED_FRAMES", 13)
        monkeypatch.setattr(vae, "VaeRecipe", partial(VaeRecipe, size=CropSize(5, 32, 48)))
        monkeypatch.setattr(
            TinyVAE,
            "random",
            lambda seed: vae.load_tiny_vae(data / "vae.safetensors").requires_grad_(),
        )
        return vae.train_vae(data, None, folder / "run", 2, 0, None, device=device)
    run = replace(run_of(data, recipe), device=device)
    return train_fixer(run, folder / "run", distance)


@pytest.mark.parametrize("recipe", first_of(["vae", "V9", "base"]))
def test_a_recipe_on_a_device_equals_the_processors(recipe, data, tmp_path, monkeypatch, waits):
    with pretended_device(monkeypatch):
        found = load_weights(trained(recipe, data, tmp_path / "device", "cuda", monkeypatch))
    assert waits == [1, 1]
    wanted = load_weights(trained(recipe, data, tmp_path / "host", "cpu", monkeypatch))
    for name, due in wanted.items():
        torch.testing.assert_close(found[name], due, rtol=0, atol=1e-3)
