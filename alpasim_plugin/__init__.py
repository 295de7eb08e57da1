"""simrun: closed-loop evaluation of driving policies behind a 3D Gaussian renderer and a one-step video fixer.

The public functions are imported on first use, so that reading a log or a type does not load the rasteriser.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from alpasim_plugin.runtime.compose import make_renderer
    from alpasim_plugin.runtime.rollout import run_rollout
    from policies import make_policy
    from scenarios.load import load_scenario

__version__ = "0.1.0"

_HOMES = {
    "load_scenario": "scenarios.load",
    "make_policy": "policies",
    "make_renderer": "alpasim_plugin.runtime.compose",
    "run_rollout": "alpasim_plugin.runtime.rollout",
}

__all__ = ["__version__", "load_scenario", "make_policy", "make_renderer", "run_rollout"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
