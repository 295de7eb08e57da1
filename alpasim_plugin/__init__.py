"""simrun: closed-loop evaluation of driving policies behind a 3D Gaussian renderer and a one-step
    video fixer.

The public functions are imported on first use, so that reading a log or a type does not load the
rasteriser.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from alpasim_plugin.core.files import places, real
from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from alpasim_plugin.alpasim.server.driver_service import serve_policy
    from alpasim_plugin.runs.renderer import make_renderer
    from alpasim_plugin.runs.rollout import run_rollout
    from policies.base import make_policy
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


def _refuse_hidden_packages() -> None:
    """Refuse to run where another folder on Python's path hides one of our packages: ``policies``
    and ``scenarios`` are ordinary names in a user's project.

    Raises:
        ImportError: It does.
    """
    root = Path(__file__).resolve().parents[1]
    for name in OWN_PACKAGES[1:]:
        spec = find_spec(name)
        if spec is None or spec.origin is None or root not in real(Path(spec.origin)).parents:
            places_found = spec and (spec.origin or list(spec.submodule_search_locations or ()))
            raise ImportError(
                f"the package {name!r} of simrun is hidden by {places_found}: rename that folder, "
                "or take the folder that it lies in off Python's path (run simrun, not python -m)"
            )


_refuse_hidden_packages()
places.prepare()


__getattr__ = lazy_names(
    __name__,
    {
        "load_scenario": "scenarios.load",
        "make_policy": "policies.base",
        "make_renderer": ".runs.renderer",
        "run_rollout": ".runs.rollout",
        "serve_policy": ".alpasim.server.driver_service",
    },
)


def __dir__() -> list[str]:
    """Return the public names, those among them that are not yet loaded as well."""
    return sorted(__all__)
