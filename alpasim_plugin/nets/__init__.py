"""Networks of the fixer: causal transformer, video autoencoders, weights on disk, sampling."""

from alpasim_plugin.nets.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.nets.sizes import DiTSizes
from alpasim_plugin.nets.taehv import TinyDecoder
from alpasim_plugin.nets.tiny_vae import TinyVAE
from alpasim_plugin.nets.wan_vae import WanVAE

__all__ = ["CosmosCausalDiT", "DiTSizes", "TextContext", "TinyDecoder", "TinyVAE", "WanVAE"]
