"""Evaluators: a log and a map in, metric series out; then one value per rollout, and tables with intervals over rollouts.

Example:
    ``series = score(rollout, scene, preset="paper")``; ``reduction = reduce_rollout(series, "paper")``;
    ``row = {"renderer": ..., "policy": ..., "scene": ..., "seed": ..., "status": "ok", **reduction.as_row()}``;
    ``metrics = aggregate(rows)``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names
from evaluators.aggregate.summary import aggregate  # not on first use: its package bears the same name

if TYPE_CHECKING:
    from evaluators.aggregate.censoring import censoring as censoring
    from evaluators.aggregate.paired import paired as paired
    from evaluators.aggregate.reduce import Reduction as Reduction
    from evaluators.aggregate.reduce import RolloutValue as RolloutValue
    from evaluators.aggregate.reduce import reduce_rollout as reduce_rollout
    from evaluators.aggregate.reduce import rollout_values as rollout_values
    from evaluators.base import resolve_evaluators as resolve_evaluators
    from evaluators.base import score as score
    from evaluators.base import series as series
    from evaluators.collision import ContactEvent as ContactEvent
    from evaluators.collision import contact_events as contact_events
    from evaluators.metrics import METRICS as METRICS
    from evaluators.metrics import MetricInfo as MetricInfo
    from evaluators.presets import PRESETS as PRESETS
    from evaluators.presets import Preset as Preset
    from evaluators.presets import preset as preset

__all__ = [
    "METRICS",
    "PRESETS",
    "ContactEvent",
    "MetricInfo",
    "Preset",
    "Reduction",
    "RolloutValue",
    "aggregate",
    "censoring",
    "contact_events",
    "paired",
    "preset",
    "reduce_rollout",
    "resolve_evaluators",
    "rollout_values",
    "score",
    "series",
]

__getattr__ = lazy_names(
    __name__,
    {
        "ContactEvent": ".collision",
        "METRICS": ".metrics",
        "MetricInfo": ".metrics",
        "PRESETS": ".presets",
        "Preset": ".presets",
        "Reduction": ".aggregate.reduce",
        "RolloutValue": ".aggregate.reduce",
        "censoring": ".aggregate.censoring",
        "contact_events": ".collision",
        "paired": ".aggregate.paired",
        "preset": ".presets",
        "reduce_rollout": ".aggregate.reduce",
        "resolve_evaluators": ".base",
        "rollout_values": ".aggregate.reduce",
        "score": ".base",
        "series": ".base",
    },
)
