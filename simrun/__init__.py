"""simrun: what a user's own code imports. Every name is loaded on first use, so that a type costs
no rasteriser and no torch.
"""

from typing import TYPE_CHECKING

from alpasim_plugin import __version__
from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from alpasim_plugin.alpasim.server.driver_service import serve_policy
    from alpasim_plugin.core.errors import InputError, SimrunError
    from alpasim_plugin.core.types import (
        U8,
        CameraSpec,
        EgoState,
        Frame,
        MetricInfo,
        MetricSeries,
        Observation,
        Plan,
        RenderRequest,
        RolloutLog,
        Route,
        Scenario,
        Scene,
        SensorSpec,
        Trajectory,
    )
    from alpasim_plugin.runs.renderer import make_renderer
    from alpasim_plugin.runs.rollout import run_rollout
    from evaluators import (
        aggregate,
        paired,
        reduce_rollout,
        resolve_evaluators,
        rollout_values,
        score,
        series,
    )
    from policies.base import make_policy, plan_times
    from policies.conformance import check_policy
    from scenarios.load import load_scenario

HOMES = {
    "alpasim_plugin.alpasim.server.driver_service": ["serve_policy"],
    "alpasim_plugin.core.errors": ["InputError", "SimrunError"],
    "alpasim_plugin.core.types": [
        "CameraSpec",
        "EgoState",
        "Frame",
        "MetricInfo",
        "MetricSeries",
        "Observation",
        "Plan",
        "RenderRequest",
        "RolloutLog",
        "Route",
        "Scenario",
        "Scene",
        "SensorSpec",
        "Trajectory",
        "U8",
    ],
    "alpasim_plugin.runs.renderer": ["make_renderer"],
    "alpasim_plugin.runs.rollout": ["run_rollout"],
    "evaluators": [
        "aggregate",
        "paired",
        "reduce_rollout",
        "resolve_evaluators",
        "rollout_values",
        "score",
        "series",
    ],
    "policies.base": ["make_policy", "plan_times"],
    "policies.conformance": ["check_policy"],
    "scenarios.load": ["load_scenario"],
}

__all__ = [
    "U8",
    "CameraSpec",
    "EgoState",
    "Frame",
    "InputError",
    "MetricInfo",
    "MetricSeries",
    "Observation",
    "Plan",
    "RenderRequest",
    "RolloutLog",
    "Route",
    "Scenario",
    "Scene",
    "SensorSpec",
    "SimrunError",
    "Trajectory",
    "__version__",
    "aggregate",
    "check_policy",
    "load_scenario",
    "make_policy",
    "make_renderer",
    "paired",
    "plan_times",
    "reduce_rollout",
    "resolve_evaluators",
    "rollout_values",
    "run_rollout",
    "score",
    "series",
    "serve_policy",
]

__getattr__ = lazy_names(__name__, {name: home for home, names in HOMES.items() for name in names})


def __dir__() -> list[str]:
    """Return the public names, those among them that are not yet loaded as well."""
    return sorted(__all__)
