"""Evaluators: a log and a map in, metric series out; then one value per rollout, and tables with intervals over rollouts.

Example:
    ``series = score(rollout, scene, preset="paper")``; ``reduction = reduce_rollout(series, "paper")``;
    ``row = {"renderer": ..., "policy": ..., "scene": ..., "seed": ..., "status": "ok", **reduction.as_row()}``;
    ``metrics = aggregate(rows)``.
"""

from evaluators import collision as _collision
from evaluators import image_health as _image_health
from evaluators import offroad as _offroad
from evaluators import plan as _plan
from evaluators import route as _route
from evaluators.aggregate.censoring import censoring
from evaluators.aggregate.paired import paired
from evaluators.aggregate.reduce import Reduction, RolloutValue, reduce_rollout, rollout_values
from evaluators.aggregate.summary import aggregate
from evaluators.base import EVALUATORS, EVALUATORS_VERSION, score
from evaluators.collision import ContactEvent, contact_events
from evaluators.metrics import METRICS, MetricInfo
from evaluators.presets import PRESETS, Preset, preset

# Importing an evaluator's module registers it.
_BUILTIN = (_collision, _offroad, _route, _plan, _image_health)

__all__ = [
    "EVALUATORS",
    "EVALUATORS_VERSION",
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
    "rollout_values",
    "score",
]
