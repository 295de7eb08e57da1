"""Networks of the fixer: causal transformer, video autoencoders, weights on disk, sampling."""

from alpasim_plugin.nets.dit import CosmosCausalDiT, DiTSizes, TextContext

__all__ = ["CosmosCausalDiT", "DiTSizes", "TextContext"]
