"""The generators of frames in blocks: causal transformer on the latents of a video autoencoder, in
chunks or along predicted poses.
"""

from alpasim_plugin.core.lazy import lazy_names

__all__ = ["CosmosCausalDiT", "TinyDecoder", "WanVAE"]

__getattr__ = lazy_names(
    __name__,
    {"CosmosCausalDiT": ".dit", "TinyDecoder": ".taehv", "WanVAE": ".wan_vae"},
)
