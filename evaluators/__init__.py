"""Evaluators: a log and a map in, metric series out; then one value per rollout, and tables with intervals over rollouts.

Example:
    ``series = score(rollout, scene, preset="paper")``; ``reduction = reduce_rollout(series, "paper")``;
    ``row = {"renderer": ..., "policy": ..., "scene": ..., "seed": ..., "status": "ok", **reduction.as_row()}``;
    ``metrics = aggregate(rows)``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from evaluators.metrics import METRICS as METRICS
    from evaluators.metrics import MetricInfo as MetricInfo
    from evaluators.metrics.collision import ContactEvent as ContactEvent
    from evaluators.metrics.collision import contact_events as contact_events
    from evaluators.metrics.presets import PRESETS as PRESETS
    from evaluators.metrics.presets import Preset as Preset
    from evaluators.metrics.presets import preset as preset
    from evaluators.metrics.score import resolve_evaluators as resolve_evaluators
    from evaluators.metrics.score import score as score
    from evaluators.metrics.score import series as series
    from evaluators.statistics.paired import paired as paired
    from evaluators.statistics.reduce import Reduction as Reduction
    from evaluators.statistics.reduce import RolloutValue as RolloutValue
    from evaluators.statistics.reduce import reduce_rollout as reduce_rollout
    from evaluators.statistics.reduce import rollout_values as rollout_values
    from evaluators.statistics.summary import aggregate as aggregate
    from evaluators.statistics.summary import censoring as censoring

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
        "ContactEvent": ".metrics.collision",
        "METRICS": ".metrics",
        "MetricInfo": ".metrics",
        "PRESETS": ".metrics.presets",
        "Preset": ".metrics.presets",
        "Reduction": ".statistics.reduce",
        "RolloutValue": ".statistics.reduce",
        "aggregate": ".statistics.summary",
        "censoring": ".statistics.summary",
        "contact_events": ".metrics.collision",
        "paired": ".statistics.paired",
        "preset": ".metrics.presets",
        "reduce_rollout": ".statistics.reduce",
        "resolve_evaluators": ".metrics.score",
        "rollout_values": ".statistics.reduce",
        "score": ".metrics.score",
        "series": ".metrics.score",
    },
)
