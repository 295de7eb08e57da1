"""Stand-in weights for measuring: random, of the real sizes, with corrections as large as a trained
fixer's.

An identity shows no error of a reduced precision, for its transformer's output is multiplied by
zero. With these weights every layer contributes, and latents change by a quarter of their standard
deviation.
"""

import torch

from alpasim_plugin.block_fixers.dit import initial_weights
from alpasim_plugin.block_fixers.networks import condition_sizes
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.core.seeding import derive_seed, stream
from alpasim_plugin.fixers.bundle import save_bundle

VELOCITY = 0.25  # root mean square of the predicted velocity; latents have about unit variance
MODULATION = 0.1  # shift, scale and gate of the final layer
CORRECTION = 0.05  # of the codec's last layers, on the scale of their inputs
NOTE = "random weights, small corrections"


def save_stand_in(path, settings):
    """Write a bundle with stand-in weights for the tiny autoencoder and a transformer, both of the
    settings' sizes.

    Args:
        path: A ``.safetensors`` file.
        settings: Sizes, and what the bundle says it was made for.
        seed: Of all weights.
    """
    key = derive_seed("fixer-stand-in", 0, settings.name)
    dit = initial_weights(DiTSizes(**settings.dit.model_dump(), **condition_sizes(settings)), key)
    for name in (name for name in dit if name.endswith("opacity_embed.weight")):
        draw = stream("fixer-stand-in", 0, name).standard_normal(tuple(dit[name].shape))
        dit[name] = torch.from_numpy(draw).float() / dit[name].shape[1] ** 0.5
    dit["final_layer.linear.weight"] *= (
        VELOCITY  # its input is normalised, so this is the spread of its output
    )
    last = dit["final_layer.adaln_modulation.2.weight"]
    draw = stream("fixer-stand-in", 0, "modulation").standard_normal(tuple(last.shape))
    dit["final_layer.adaln_modulation.2.weight"] = torch.from_numpy(draw).float() * (
        MODULATION / last.shape[1] ** 0.5
    )
    vae = TinyVAE.random(TinySizes(*settings.vae.widths), key)
    with torch.no_grad():
        for name, head in (("encoder", vae.encoder.head), ("decoder", vae.decoder.head)):
            weight = head.weight
            noise = stream("fixer-stand-in", 0, f"vae.{name}").standard_normal(tuple(weight.shape))
            weight.copy_(torch.from_numpy(noise).float() * (CORRECTION / weight[0].numel() ** 0.5))
    save_bundle(path, {"dit": dit, "vae": vae.state_dict()}, settings, trained=False, note=NOTE)
