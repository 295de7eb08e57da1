"""Evaluators: a log and a map in, metric series out; then one value per rollout, and tables with intervals over rollouts.

Example:
    ``series = score(rollout, scene, preset="paper")``; ``reduction = reduce_rollout(series, "paper")``;
    ``row = {"renderer": ..., "policy": ..., "scene": ..., "seed": ..., "status": "ok", **reduction.as_row()}``;
    ``metrics = aggregate(rows)``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from evaluators.aggregate.summary import aggregate  # not on first use: its package bears the same name

if TYPE_CHECKING:
    from evaluators.aggregate.censoring import censoring
    from evaluators.aggregate.paired import paired
    from evaluators.aggregate.reduce import Reduction, RolloutValue, reduce_rollout, rollout_values
    from evaluators.base import resolve_evaluators, score, series
    from evaluators.collision import ContactEvent, contact_events
    from evaluators.metrics import METRICS, MetricInfo
    from evaluators.presets import PRESETS, Preset, preset

_HOMES = {
    "METRICS": "metrics",
    "PRESETS": "presets",
    "ContactEvent": "collision",
    "MetricInfo": "metrics",
    "Preset": "presets",
    "Reduction": "aggregate.reduce",
    "RolloutValue": "aggregate.reduce",
    "censoring": "aggregate.censoring",
    "contact_events": "collision",
    "paired": "aggregate.paired",
    "preset": "presets",
    "reduce_rollout": "aggregate.reduce",
    "resolve_evaluators": "base",
    "rollout_values": "aggregate.reduce",
    "score": "base",
    "series": "base",
}

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


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"evaluators.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
