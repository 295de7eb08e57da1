"""Parts by name: what can be named, what a name stands for, and what identifies it.

A name is resolved once, into a `PartSpec` that carries the part's identity; a worker process only
builds it. Shipped parts and those of other packages register by entry points
(`alpasim_plugin.core.parts.registry`); ``package.module:Class`` goes the same way.
"""

from alpasim_plugin.core.interfaces import complete
from alpasim_plugin.core.parts.grammar import split_names, split_settings
from alpasim_plugin.core.parts.resolve import (
    RendererSpec,
    find,
    names,
    overrides_of,
    require_installed,
    resolve,
    resolve_renderer,
    unidentified,
)
from alpasim_plugin.core.parts.spec import PartSpec, build, digest

__all__ = [
    "PartSpec",
    "RendererSpec",
    "build",
    "complete",
    "digest",
    "find",
    "names",
    "overrides_of",
    "require_installed",
    "resolve",
    "resolve_renderer",
    "split_names",
    "split_settings",
    "unidentified",
]
