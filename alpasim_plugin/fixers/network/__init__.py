"""Networks of the fixers, and reading their weights.

The networks of the block generators can be imported from here by name. The package that holds them
registers them in the entry-point group ``simrun.networks``; they are loaded on first use.
"""

from __future__ import annotations

from typing import Any

from alpasim_plugin.core.lazy import installed

GROUP = "simrun.networks"
__all__ = ["CosmosCausalDiT", "DiTSizes", "TextContext", "TinyDecoder", "TinyVAE", "WanVAE"]


def __getattr__(name: str) -> Any:
    """Return a network of an installed package.

    Raises:
        AttributeError: Not the name of a network.
        ImportError: The network's package is not installed.
    """
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name not in installed(GROUP):
        raise ImportError(
            f"{name}: no installed package registers this network (entry points {GROUP}); install simrun with its block fixers"
        )
    return installed(GROUP)[name].load()
