"""Small image and window fixers for tests."""

import torch

from alpasim_plugin.block_fixers.codec_weights import fill_random
from alpasim_plugin.block_fixers.networks import Parts
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.bundle import save_bundle
from alpasim_plugin.lab.image_fixers.settings import NoiseWindowSettings, RenderStepSettings

SMALL = (
    "vae.widths=[16,16,16,16,16]",
    "dit.width=24",
    "dit.blocks=2",
    "dit.head_width=12",
    "dit.mlp_width=40",
    "dit.adaln_rank=5",
    "dit.text_width=7",
    "dit.context_width=9",
)
DAMPED = 0.3  # of the velocity and of the autoencoder's corrections: the guard finds nothing


def image_settings(name, *overrides):
    """Return a shipped arm's settings at a few thousand parameters."""
    settings = fixer_settings(name, (*SMALL, *overrides))
    assert isinstance(settings, RenderStepSettings | NoiseWindowSettings)
    return settings


def busy_settings(folder, name, *overrides):
    """Return settings whose weights make every layer count."""
    kind = image_settings(name, *overrides).decoder.kind
    path = folder / f"{name}_{kind}.safetensors"
    if not path.exists():
        parts = Parts(image_settings(name, "untrained=random", f"decoder.kind={kind}"))
        dit = parts.dit()
        vae = parts.vae()
        fill_random(vae.encoder, 1, "tests.encoder")
        fill_random(vae.decoder, 1, "tests.decoder")
        damp(dit.final_layer.linear.weight, vae.encoder.head.weight, vae.decoder.head.weight)  # type: ignore[union-attr]
        save(path, {"dit": dit.state_dict(), "vae": vae.state_dict()}, parts.settings)  # type: ignore[arg-type]
    return image_settings(name, f"weights.bundle={path}", *overrides)


def damp(*weights):
    """Make weights small, in place."""
    with torch.no_grad():
        for weight in weights:
            weight.mul_(DAMPED)


def save(
    path,
    parts,
    settings,
):
    """Write a bundle."""
    save_bundle(path, parts, settings, trained=True, note="3 updates")
