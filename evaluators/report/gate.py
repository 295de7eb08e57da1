"""The verdict of a gate, kept in the run folder as ``gate.json`` and shown at the head of the
report: baseline, every check, the worst scenes first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.log.run_folder.checksums import checksums_of
from alpasim_plugin.log.run_folder.reader import read_json, table_path
from alpasim_plugin.log.run_folder.schema import ROLLOUTS, WHY_NAME
from alpasim_plugin.log.run_folder.sides import Row, value_of
from evaluators.opening import Run
from evaluators.report.numbers import DASH, short
from evaluators.statistics.baselines import rows_of_run
from evaluators.statistics.gate import Check, GateVerdict
from evaluators.statistics.variants import Variant, short_name
from evaluators.statistics.verdicts import WORDS

GATE_NAME = "gate.json"
WORST = 5  # scenes of a check that are named
TONES = {"pass": "better", "regression": "worse", "undecided": "unclear"}
CAUSES_FIRST = ("regression", "undecided")


def write_gate(
    run: Run, verdict: GateVerdict, gate: str, worst: Sequence[Mapping[str, Any]]
) -> Path:
    """Keep a verdict in the run folder, for its report, and return the file.

    Args:
        run: The run that was judged.
        verdict: What `evaluators.statistics.gate.judge` gave.
        gate: Name or file of the gate.
        worst: As `worst_of` gives it.
    """
    path = run.folder / GATE_NAME
    head = {"of": _content(run), "gate": gate, "worst": list(worst)}
    write_json(path, head | verdict.as_dict())
    return path


def worst_of(
    run: Run, verdict: GateVerdict, stored: Sequence[Row] | None = None
) -> list[dict[str, Any]]:
    """Return the pairs that did worst in every check that did not pass, once each, those of a shown
    regression first.

    Args:
        run: The run.
        verdict: Of a gate.
        stored: Rows of a stored baseline.
    """
    rows = rows_of_run(run)
    base_rows = rows if stored is None else stored
    checks = sorted(
        (check for check in verdict.checks if check.cause != "pass"),
        key=lambda check: check.cause != "regression",
    )
    pairs: dict[tuple[Any, ...], dict[str, Any]] = {}
    for check in checks:
        for pair in _worst_pairs(check, run, rows, base_rows):
            key = tuple(pair[name] for name in ("metric", "renderer", "policy", "scene", "seed"))
            known = pairs.setdefault(key, pair)
            if known["was"] is None:  # a limit has no baseline, the margin of the same metric has
                known["was"] = pair["was"]
    return list(pairs.values())


def _content(run: Run) -> str:
    """Return the digest of the rollouts' table: a verdict on other rollouts is not shown."""
    return str(
        checksums_of(table_path(run.folder, ROLLOUTS).parent, [ROLLOUTS])[ROLLOUTS]["sha256"]
    )


def _worst_pairs(
    check: Check, run: Run, rows: Sequence[Row], base_rows: Sequence[Row]
) -> list[dict[str, Any]]:
    """Return the pairs in which a variant did worst against its baseline, or its worst rollouts
    where a limit is broken.
    """
    variant = Variant(check.renderer, check.policy)
    sign = -1.0 if run.table.info(check.metric).direction == "higher" else 1.0
    before: dict[tuple[Any, Any], float | None] = {}
    if check.kind == "margin":
        for row in base_rows:
            base = Variant(str(row["renderer"]), str(row["policy"]))
            if short_name(base, variant) == check.entry["baseline"]:
                before[row["scene"], row["seed"]] = value_of(row, check.metric)
    found: list[dict[str, Any]] = []
    for row in rows:
        if (row["renderer"], row["policy"]) != (check.renderer, check.policy):
            continue
        now = value_of(row, check.metric)
        was = before.get((row["scene"], row["seed"]))
        if now is None or (was is None and check.kind == "margin"):
            continue
        found.append(
            {
                "scene": str(row["scene"]),
                "seed": int(row["seed"]),
                "was": was,
                "now": now,
                "worse": sign * (now - (was or 0.0)),
                "metric": check.metric,
                "renderer": check.renderer,
                "policy": check.policy,
            }
        )
    worse = [pair for pair in found if pair["worse"] > 0.0]
    return sorted(worse, key=lambda pair: -pair["worse"])[:WORST]


def gate_section(run: Run) -> dict[str, Any] | None:
    """Return what the report shows of the last gate that judged these rollouts; None without one.

    Raises:
        InputError: gate.json is damaged.
    """
    path = run.folder / GATE_NAME
    if not path.is_file():
        return None
    stored = read_json(path)
    if stored["of"] != _content(run):
        return None
    pages = {
        rollout.cell: run.href(rollout, WHY_NAME) or run.href(rollout) for rollout in run.rollouts
    }
    order = {cause: rank for rank, cause in enumerate(CAUSES_FIRST)}
    checks = sorted(
        stored["checks"], key=lambda check: (order.get(check["cause"], 2), not check["binding"])
    )
    worst = []
    for pair in stored["worst"]:
        unit = run.table.shown(pair["metric"]).unit
        was = DASH if pair["was"] is None else short(pair["was"], unit)
        cell = (pair["renderer"], pair["policy"], pair["scene"], pair["seed"])
        shown = {"was": was, "now": short(pair["now"], unit), "page": pages.get(cell)}
        worst.append(pair | shown)
    outcome = stored["outcome"]
    return {
        "title": WORDS[outcome["cause"]],
        "tone": tone_of_cause(outcome["cause"]),
        "gate": stored["gate"],
        "baseline": stored["baseline"],
        "exit_code": outcome["exit_code"],
        "checks": [check | {"tone": tone_of_cause(check["cause"])} for check in checks],
        "worst": worst,
    }


def tone_of_cause(cause: str) -> str:
    """Return the colour of a verdict."""
    return TONES.get(cause, "broken")
