"""Networks of the fixer: causal transformer, video autoencoders, weights on disk, sampling."""

from alpasim_plugin.nets.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.nets.sizes import DiTSizes

__all__ = ["CosmosCausalDiT", "DiTSizes", "TextContext"]
