"""Networks of the fixer: causal transformer, video autoencoders, weights on disk, sampling."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from alpasim_plugin.nets.dit import CosmosCausalDiT, TextContext
    from alpasim_plugin.nets.sizes import DiTSizes
    from alpasim_plugin.nets.taehv import TinyDecoder
    from alpasim_plugin.nets.tiny_vae import TinyVAE
    from alpasim_plugin.nets.wan_vae import WanVAE

_HOMES = {
    "CosmosCausalDiT": "dit",
    "DiTSizes": "sizes",
    "TextContext": "dit",
    "TinyDecoder": "taehv",
    "TinyVAE": "tiny_vae",
    "WanVAE": "wan_vae",
}

__all__ = ["CosmosCausalDiT", "DiTSizes", "TextContext", "TinyDecoder", "TinyVAE", "WanVAE"]


def __getattr__(name: str) -> Any:
    """Import a network on first use: the noise schedule and the headers of weight files do not need torch."""
    if name in _HOMES:
        return getattr(import_module(f"alpasim_plugin.nets.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
