"""What a gate found, kept in the run folder and shown at the head of the report: verdict, baseline, every check, the worst scenes first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.io.atomic import write_json
from alpasim_plugin.io.checksums import checksums_of
from alpasim_plugin.run_folder.reader import read_json
from alpasim_plugin.run_folder.schema import ROLLOUTS, WHY_NAME
from alpasim_plugin.run_folder.sides import Row, value_of
from evaluators.opening import Run
from evaluators.report.numbers import short
from evaluators.statistics.arms import Arm, short_name
from evaluators.statistics.baselines import rows_of_run
from evaluators.statistics.gate import Check, GateVerdict
from evaluators.statistics.verdicts import WORDS

GATE_NAME = "gate.json"
WORST = 5  # scenes of a check that are named
TONES = {"pass": "better", "regression": "worse", "undecided": "unclear"}


def write_gate(run: Run, verdict: GateVerdict, gate: str, worst: Sequence[Mapping[str, Any]]) -> Path:
    """Keep a verdict in the run folder, for its report, and return the file.

    Args:
        run: The run that was judged.
        verdict: What `evaluators.statistics.gate.judge` gave.
        gate: Name or file of the gate.
        worst: As `worst_of` gives it.
    """
    write_json(run.folder / GATE_NAME, {"of": _content(run), "gate": gate, "worst": list(worst), **verdict.as_dict()})
    return run.folder / GATE_NAME


def worst_of(run: Run, verdict: GateVerdict, stored: Sequence[Row] | None = None) -> list[dict[str, Any]]:
    """Return the pairs that did worst in every check that did not pass; ``stored``: rows of a stored baseline."""
    rows = rows_of_run(run)
    base_rows = rows if stored is None else stored
    return [pair for check in verdict.checks if check.cause != "pass" for pair in worst_pairs(check, run, rows, base_rows)]


def _content(run: Run) -> str:
    """Return the digest of the rollouts' table: a verdict on other rollouts is not shown."""
    return str(checksums_of(run.folder, [ROLLOUTS])[ROLLOUTS]["sha256"])


def worst_pairs(check: Check, run: Run, rows: Sequence[Row], base_rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the pairs in which an arm did worst against its baseline, or its worst rollouts where a limit is broken.

    Args:
        check: One that did not pass.
        run: The run, whose table says which side is better.
        rows, base_rows: Rollouts of the run and of the baseline.
    """
    arm = Arm(check.renderer, check.policy)
    sign = -1.0 if run.table.info(check.metric).direction == "higher" else 1.0
    was: dict[tuple[str, int], float | None] = {}
    for row in base_rows:
        other = Arm(str(row["renderer"]), str(row["policy"]))
        if check.kind == "margin" and short_name(other, arm) == check.entry["baseline"]:
            was[str(row["scene"]), int(row["seed"])] = value_of(row, check.metric)
    found: list[dict[str, Any]] = []
    for row in rows:
        key, now = (str(row["scene"]), int(row["seed"])), value_of(row, check.metric)
        before = was.get(key)
        if (row["renderer"], row["policy"]) != (check.renderer, check.policy) or now is None or (check.kind == "margin" and before is None):
            continue
        worse = sign * (now - (before or 0.0))
        if worse > 0.0:
            pair: dict[str, Any] = {"scene": key[0], "seed": key[1], "was": before, "now": now, "worse": worse}
            found.append(pair | {"metric": check.metric, "renderer": check.renderer, "policy": check.policy})
    return sorted(found, key=lambda pair: -pair["worse"])[:WORST]


@dataclass(frozen=True)
class GateSection:
    """What the report shows.

    Attributes:
        tone: Colour of the verdict.
        checks: A row a check: metric, arm, tone, result, sentence with the numbers.
        worst: A row a pair: scene, seed, metric, value of the baseline, value, where it is shown.
    """

    title: str
    tone: str
    gate: str
    baseline: str
    exit_code: int
    checks: list[tuple[str, str, str, str, str]]
    worst: list[tuple[str, int, str, str, str, str | None]]


def gate_section(run: Run) -> GateSection | None:
    """Return the verdict of the last gate that judged these rollouts; None without one.

    Raises:
        InputError: gate.json is damaged.
    """
    path = run.folder / GATE_NAME
    if not path.is_file():
        return None
    told = read_json(path)
    if told["of"] != _content(run):
        return None
    places = {one.cell: run.href(one, WHY_NAME) or run.href(one) for one in run.rollouts}
    order = {"regression": 0, "undecided": 1}
    checks = sorted(told["checks"], key=lambda one: (order.get(one["cause"], 2), not one["binding"]))
    return GateSection(
        WORDS[told["outcome"]["cause"]],
        TONES.get(told["outcome"]["cause"], "broken"),
        told["gate"],
        told["baseline"],
        told["outcome"]["exit_code"],
        [
            (one["metric"], f"{one['renderer']}/{one['policy']}", TONES.get(one["cause"], "broken"), _result(one), one["text"])
            for one in checks
        ],
        [_worst(run, one, places) for one in told["worst"]],
    )


def _result(check: Mapping[str, Any]) -> str:
    return f"{check['cause']}{'' if check['binding'] else ', not binding'}"


def _worst(run: Run, pair: Mapping[str, Any], places: Mapping[Any, str | None]) -> tuple[str, int, str, str, str, str | None]:
    unit = run.table.shown(pair["metric"]).unit
    was, now = ("\u2014" if value is None else short(float(value), unit) for value in (pair["was"], pair["now"]))
    place = places.get((pair["renderer"], pair["policy"], pair["scene"], pair["seed"]))
    return pair["scene"], pair["seed"], pair["metric"], was, now, place
