"""The gate: criteria, baseline and verdict of a run."""

from evaluators.gate.baseline import Baseline, baseline_of, check_made_alike, check_matches, read_baseline, write_baseline
from evaluators.gate.decided import judge_decided
from evaluators.gate.judge import Check, GateVerdict, judge, judge_table
from evaluators.gate.rows import rows_of_run, table_of_run
from evaluators.gate.spec import GateSpec, MetricRule, load_gate

__all__ = [
    "Baseline",
    "Check",
    "GateSpec",
    "GateVerdict",
    "MetricRule",
    "baseline_of",
    "check_made_alike",
    "check_matches",
    "judge",
    "judge_decided",
    "judge_table",
    "load_gate",
    "read_baseline",
    "rows_of_run",
    "table_of_run",
    "write_baseline",
]
