"""Networks of the fixer: causal transformer, video autoencoders, weights on disk, sampling."""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from alpasim_plugin.nets.dit import CosmosCausalDiT as CosmosCausalDiT
    from alpasim_plugin.nets.dit import TextContext as TextContext
    from alpasim_plugin.nets.sizes import DiTSizes as DiTSizes
    from alpasim_plugin.nets.taehv import TinyDecoder as TinyDecoder
    from alpasim_plugin.nets.tiny_vae import TinyVAE as TinyVAE
    from alpasim_plugin.nets.wan_vae import WanVAE as WanVAE

__all__ = [
    "CosmosCausalDiT",
    "DiTSizes",
    "TextContext",
    "TinyDecoder",
    "TinyVAE",
    "WanVAE",
]

__getattr__ = lazy_names(
    __name__,
    {
        "CosmosCausalDiT": ".dit",
        "DiTSizes": ".sizes",
        "TextContext": ".dit",
        "TinyDecoder": ".taehv",
        "TinyVAE": ".tiny_vae",
        "WanVAE": ".wan_vae",
    },
)
