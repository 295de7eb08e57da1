"""simrun: closed-loop evaluation of driving policies behind a 3D Gaussian renderer and a one-step
    video fixer.

The public functions are imported on first use, so that reading a log or a type does not load the
rasteriser.
"""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Any

from alpasim_plugin.core import places
from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from alpasim_plugin.alpasim.server.driver_service import serve_policy
    from alpasim_plugin.runs.cell import make_renderer
    from alpasim_plugin.runs.rollout import run_rollout
    from policies import make_policy
    from scenarios.load import load_scenario

__version__ = "0.1.0"

OWN_PACKAGES = ("alpasim_plugin", "configs", "evaluators", "policies", "scenarios", "simrun")

__all__ = [
    "OWN_PACKAGES",
    "__version__",
    "load_scenario",
    "make_policy",
    "make_renderer",
    "run_rollout",
    "serve_policy",
]


class _OwnPackages:
    """Find our packages beside this one, whatever else on the import path bears their names.

    ``policies`` and ``scenarios`` are ordinary names for folders in a user's project, and ``python
    -m`` puts the working folder first.
    """

    root = str(Path(__file__).resolve().parents[1])

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the spec of one of our packages; None leaves every other module to the finders
        that follow.
        """
        return PathFinder.find_spec(name, [cls.root], target) if name in OWN_PACKAGES else None


def _claim_packages() -> None:
    for name in OWN_PACKAGES[1:]:
        file = getattr(sys.modules.get(name), "__file__", None)
        if name in sys.modules and (
            file is None or not Path(file).resolve().is_relative_to(_OwnPackages.root)
        ):
            found = f"the package {name!r} was imported from {file or 'a folder without __init__.py'} before alpasim_plugin"
            raise ImportError(
                f"importing alpasim_plugin: {found}; import alpasim_plugin first, or rename that package"
            )
    if _OwnPackages not in sys.meta_path:
        sys.meta_path.insert(0, _OwnPackages)


_claim_packages()
places.prepare()


__getattr__ = lazy_names(
    __name__,
    {
        "load_scenario": "scenarios.load",
        "make_policy": "policies",
        "make_renderer": ".runs.cell",
        "run_rollout": ".runs.rollout",
        "serve_policy": ".alpasim.server.driver_service",
    },
)
