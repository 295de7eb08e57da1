"""The metrics: what each is, how it is measured on a rollout, and the presets that choose between
ways of measuring it.
"""

from evaluators.metrics.table import (
    METRICS,
    MIN_ADE,
    STEP_SERIES,
    MetricInfo,
    MetricTable,
    table_of,
)

__all__ = ["METRICS", "MIN_ADE", "STEP_SERIES", "MetricInfo", "MetricTable", "table_of"]
