"""Judge a run that was driven until it was decided: margins by the decision, everything else as for any run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from alpasim_plugin.run_folder.sides import Row
from evaluators.aggregate.outcome import Cause, Outcome, outcome_of_failures, worst
from evaluators.gate.judge import Check, GateVerdict, judge
from evaluators.gate.spec import GateSpec
from evaluators.metrics import METRICS, MetricTable
from evaluators.report.decision import MetricRow, metric_rows
from evaluators.sequential.record import Decision

CAUSES: dict[str, Cause] = {"non-inferior": "pass", "worse": "regression", "undecided": "undecided"}


def judge_decided(
    rows: Sequence[Row], spec: GateSpec, decision: Decision, stored: Sequence[Row] | None = None, known: MetricTable = METRICS
) -> GateVerdict:
    """Judge rollout rows whose number was decided while they were driven.

    The intervals of `judge` are those of a fixed number of scenes, so its margins are replaced by the decision's verdicts; limits and
    failures stay.

    Args:
        rows: Every rollout that was driven.
        spec: The gate whose margins were asked about.
        decision: What was decided.
        stored: Rows of a stored baseline, of the scenes and seeds that were driven; without it the baseline was driven, too.
        known: What the metrics are.
    """
    plain = judge(rows, spec, stored, decision["baseline"], known)
    found = {row.metric: row for row in metric_rows(decision, known)}
    checks = tuple(_decided(check, found[check.metric], spec, decision) if check.kind == "margin" else check for check in plain.checks)
    outcomes = [Outcome(check.cause, (check.text,)) for check in checks if check.binding or check.cause == "regression"]
    return replace(plain, outcome=worst([outcome_of_failures(plain.failures, spec.max_failed), *outcomes]), checks=checks)


def _decided(check: Check, row: MetricRow, spec: GateSpec, decision: Decision) -> Check:
    look = decision["looks"][-1]["metrics"][check.metric]
    cause = CAUSES[look["verdict"]]
    text = f"{check.renderer}: {check.metric} {row.diff} against {decision['baseline']} ({row.interval} at every look, margin {row.margin})"
    text = f"{text}: {look['verdict']} after {row.n_scenes} scenes".replace("\u00a0", " ")
    entry = check.entry
    planned = entry["n_cells"] + entry["n_missing"]
    if cause != "regression" and entry["n_missing"] > spec.max_missing * planned:
        cause = "undecided"
        text += f"; {entry['n_missing']} of {planned} cells have no pair, the gate allows {spec.max_missing:.0%}"
    elif cause == "undecided" and check.binding:
        text += f"; {decision['stopped']}"
    kept = {key: value for key, value in entry.items() if key not in ("ci95", "p_value", "test", "more_scenes", "method", "difference")}
    told = {"interval": look["interval"], "verdict": look["verdict"], "method": decision["question"]["metrics"][check.metric]["method"]}
    return replace(check, cause=cause, text=text, entry=kept | told)
