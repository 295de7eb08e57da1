"""Evaluators: a log and a map in, metric series out; then one value per rollout, and tables with
    intervals over rollouts.

Example:
    ``series = score(rollout, scene)``; ``reduction = reduce_rollout(series)``; ``row = {"renderer":
    ..., "policy": ..., "scene": ..., "seed": ..., "status": "ok", **reduction.as_row()}``;
    ``metrics = aggregate(rows)``.
"""

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from evaluators.metrics import METRICS, MetricInfo, MetricValue
    from evaluators.metrics.collision import ContactEvent, contact_events
    from evaluators.metrics.presets import PRESETS, Preset, preset
    from evaluators.metrics.score import resolve_evaluators, score, series
    from evaluators.statistics.paired import paired
    from evaluators.statistics.reduce import Reduction, reduce_rollout, rollout_values
    from evaluators.statistics.summary import aggregate, censoring

__all__ = [
    "METRICS",
    "PRESETS",
    "ContactEvent",
    "MetricInfo",
    "MetricValue",
    "Preset",
    "Reduction",
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

_HOMES = {
    ".metrics": ("METRICS", "MetricInfo", "MetricValue"),
    ".metrics.collision": ("ContactEvent", "contact_events"),
    ".metrics.presets": ("PRESETS", "Preset", "preset"),
    ".metrics.score": ("resolve_evaluators", "score", "series"),
    ".statistics.paired": ("paired",),
    ".statistics.reduce": ("Reduction", "reduce_rollout", "rollout_values"),
    ".statistics.summary": ("aggregate", "censoring"),
}
__getattr__ = lazy_names(__name__, {name: home for home, names in _HOMES.items() for name in names})
