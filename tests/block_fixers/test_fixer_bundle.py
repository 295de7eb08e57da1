"""Weights on disk: what loads, and what is refused with which words."""

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from alpasim_plugin.block_fixers.dit import initial_weights
from alpasim_plugin.block_fixers.networks import load_networks
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.arrays import read_metadata
from alpasim_plugin.fixers.bundle import read_bundle, save_bundle
from tests.block_fixers.fixer_cases import fixer, run_blocks, small_settings
from tests.fixers.clip_cases import maps_of, moving_picture, pixels

FRAMES = moving_picture(13)
MAPS = maps_of(FRAMES)


def parts(settings):
    """Return a transformer, an autoencoder and a prompt of two tokens."""
    sizes = DiTSizes(**settings.dit.model_dump())
    prompt = torch.arange(2.0 * sizes.text_width).view(2, -1).sin()
    return {
        "dit": initial_weights(sizes, 5),
        "vae": TinyVAE.random(seed=5).state_dict(),
        "prompt": {"text": prompt},
    }


@pytest.fixture
def bundle(tmp_path):
    path = tmp_path / "tiny.safetensors"
    settings = small_settings("holes=noise")
    save_bundle(path, parts(settings), settings, trained=True, note="500 steps")
    return path


def at(bundle, *overrides):
    return small_settings("holes=noise", f"weights.bundle={bundle}", *overrides)


def spoil(bundle, **changes):
    """Write the bundle again with tensors replaced, or left out; a double underscore stands for a
    dot.
    """
    header = read_metadata(bundle)
    tensors = load_file(bundle)
    for name, value in changes.items():
        key = name.replace("__", ".")
        tensors.pop(key, None)
        if value is not None:
            tensors[key] = value
    save_file(tensors, bundle, header)


def refusal(settings):
    with pytest.raises(InputError) as caught:
        load_networks(settings)
    return str(caught.value)


def test_a_bundle_is_loaded_whole(bundle):
    session = fixer(at(bundle))
    assert session.trained
    assert session.label == "onefixer-dit-tiny, 500 steps"
    assert session.networks.text[0][0].shape[1] == 2
    out = pixels(run_blocks(session, FRAMES, MAPS))
    assert np.abs(out.astype(int) - pixels(FRAMES)).max() > 2
    spoil(bundle, prompt__text=None)
    other = small_settings(
        "holes=noise", f"weights.bundle={bundle.rename(bundle.with_name('b.safetensors'))}"
    )
    assert not np.array_equal(pixels(run_blocks(fixer(other), FRAMES, MAPS)), out), (
        "the prompt counts"
    )


def test_what_is_set_otherwise_than_trained_for_is_in_the_label(bundle):
    assert "history finalise instead of last-forward" in fixer(at(bundle, "history=finalise")).label


def test_weights_for_other_conventions_are_refused(bundle):
    text = refusal(at(bundle, "rope_ratios=[1.0,1.0,1.0]", "decoder.kind=latent"))
    assert "rope_ratios is [1.0, 1.0, 1.0] for [3.0, 3.0, 1.0]" in text
    assert "decoder.kind is latent for render" in text


def test_a_bundle_without_an_autoencoder_is_refused(bundle):
    spoil(
        bundle,
        **{key.replace(".", "__"): None for key in load_file(bundle) if key.startswith("vae.")},
    )
    assert "no vae.*" in refusal(at(bundle))
    with pytest.raises(InputError):
        save_bundle(bundle, {"dit": {}}, at(bundle), trained=False)


def test_a_pickle_a_foreign_file_and_no_file_are_refused(bundle, tmp_path):
    pickled = tmp_path / "net.safetensors"
    foreign = tmp_path / "plain.safetensors"
    torch.save(load_file(bundle), pickled)
    save_file(load_file(bundle), foreign)
    assert "not safetensors" in refusal(at(pickled))
    assert "format None" in refusal(at(foreign))
    assert "no such file" in refusal(at(tmp_path / "absent.safetensors"))
    bundle.write_bytes(bundle.read_bytes()[:-100])
    assert "not safetensors" in refusal(at(bundle))


def test_a_checkpoint_of_a_transformer_by_path_with_anything_but_tensors_is_refused(
    tmp_path,
):
    class Payload:
        def __reduce__(self):
            return (print, ("loaded",))

    path = tmp_path / "net.pt"
    torch.save({"net.x": torch.ones(1), "extra": Payload()}, path)
    assert "could run code" in refusal(small_settings(f"weights.dit={path}"))


def test_an_untrained_bundle_says_so(bundle):
    settings = small_settings("holes=noise")
    save_bundle(bundle, parts(settings), settings, trained=False)
    assert read_bundle(bundle, at(bundle)).note == "untrained"
    assert not load_networks(at(bundle)).trained
