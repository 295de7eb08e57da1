"""Short trainings of a block generator over pairs on disk."""

import pytest

from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.training.clip_batches import BatchForm
from alpasim_plugin.lab.training.fixer_run import FixerRun
from alpasim_plugin.lab.training.latent_clips import ClipForm, LatentClips
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.training.recipes.registry import recipe_of, with_attention
from alpasim_plugin.lab.training.trainer import Schedule
from tests.block_fixers.fixer_cases import small_settings
from tests.lab.training.pair_files import make

FORM = ClipForm(latents=4, stride=7)


def brightness(a, b):
    """Stand for a perceptual network."""
    return (a.mean(dim=(1, 2, 3)) - b.mean(dim=(1, 2, 3))).abs()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("pairs")
    make(root, name="a", frames=21)
    make(root, name="b", frames=14)
    TinyVAE.random(TinySizes(16, 16, 16, 16, 16)).save(root / "vae.safetensors")
    return root


def run_of(data, recipe, *, steps=2, init=None):
    schedule = Schedule(steps, peak_lr=1e-2, warmup=1, accumulate=1, save_every=1, ema=0.5)
    settings = small_settings("window=4", "history=finalise", "holes=noise")
    weights = {} if init is None else {"init": init}
    chosen = with_attention(recipe_of(recipe), window=4)
    return FixerRun(
        settings,
        chosen,
        data,
        data / "vae.safetensors",
        weights,
        FORM,
        BatchForm(clips=2, columns=4),
        schedule,
    )


def clips_of(data, folder):
    return LatentClips(
        PairDataset(data, "train").sequences,
        TinyVAE.from_state_dict(load_weights(data / "vae.safetensors")),
        FORM,
        folder,
    )
