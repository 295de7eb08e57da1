"""The metrics: what each is, how it is measured on a rollout, and the presets that choose between
ways of measuring it.
"""

from alpasim_plugin.log.run_folder.records import MetricValue
from evaluators.metrics.table import (
    METRICS,
    MIN_ADE,
    STEP_SERIES,
    MetricInfo,
    MetricTable,
    table_of,
)

__all__ = [
    "METRICS",
    "MIN_ADE",
    "STEP_SERIES",
    "MetricInfo",
    "MetricTable",
    "MetricValue",
    "table_of",
]
