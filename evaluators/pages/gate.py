"""The verdict of a gate, kept in the run folder as ``gate.json`` and shown at the head of the
report: baseline, every check, the worst scenes first.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.log.run_folder.checksums import (
    DIGEST,
    check_seal,
    checksums_of,
    sealed,
    state_files,
)
from alpasim_plugin.log.run_folder.reader import read_json, table_path
from alpasim_plugin.log.run_folder.schema import GATE_FILES, ROLLOUTS, WHY_NAME
from evaluators.results import WORDS
from evaluators.statistics.gate import GateVerdict
from evaluators.statistics.numbers import short
from evaluators.statistics.opening import Run

WORST = 5  # scenes of a check that are named
TONES = {"pass": "better", "regression": "worse", "undecided": "unclear"}
CAUSES_FIRST = ("regression", "undecided")


def write_gate(run: Run, verdict: GateVerdict, gate: str) -> Path:
    """Keep a verdict in the run folder, for its report, with digests of the gate's files, and
    return the file.

    Args:
        run: The run that was gated.
        verdict: What `evaluators.statistics.gate.check_gate` gave.
        gate: Name or file of the gate.
    """
    path = run.folder / GATE_FILES[0]
    write_json(path, sealed({"of": _content(run.folder), "gate": gate} | verdict.as_dict()))
    state_files(run.folder, GATE_FILES)
    return path


def worst_of(checks: Sequence[JsonView]) -> list[JsonObject]:
    """Return the pairs that did worst in every check that did not pass, once each, those of a shown
    regression first; ``checks`` are those of `GateVerdict.as_dict`.
    """
    pairs: dict[tuple[Any, ...], JsonObject] = {}
    for check in sorted(checks, key=lambda check: check["cause"] != "regression"):
        if check["cause"] != "pass":
            variant = {name: check[name] for name in ("metric", "renderer", "policy")}
            for pair in check["entry"]["worst"][:WORST]:
                pairs.setdefault((*variant.values(), pair["scene"], pair["seed"]), variant | pair)
    return list(pairs.values())


def _content(folder: Path) -> str:
    """Return the digest of the rollouts' table: a verdict on other rollouts is not shown."""
    return str(checksums_of(table_path(folder, ROLLOUTS).parent, [ROLLOUTS])[ROLLOUTS]["sha256"])


def _stored(folder: Path) -> JsonObject | None:
    """Return ``gate.json`` of a run folder; None where there is none about these rollouts.

    Raises:
        InputError: It is damaged, or not what a gate wrote.
    """
    path = folder / GATE_FILES[0]
    if not os.path.isfile(path):
        return None
    stored = read_json(path)
    if stored["of"] != _content(folder):
        return None
    check_seal({DIGEST: None} | stored, path, "Give simrun gate again.")
    return stored


def gate_badge(folder: Path) -> tuple[str, str] | None:
    """Return the verdict of the last gate that checked a run folder's rollouts, in words, and its
    colour; None without one, and where it is damaged, as the run's own page says.
    """
    try:
        stored = _stored(folder)
    except InputError:
        return None
    if stored is None:
        return None
    cause = stored["outcome"]["cause"]
    return WORDS[cause], tone_of_cause(cause)


def gate_section(run: Run) -> JsonObject | None:
    """Return what the report shows of the last gate that checked these rollouts; None without one.

    Raises:
        InputError: gate.json is damaged, or not what a gate wrote.
    """
    stored = _stored(run.folder)
    if stored is None:
        return None
    pages = {
        rollout.cell: run.href(rollout, WHY_NAME) or run.href(rollout) for rollout in run.rollouts
    }
    order = {cause: rank for rank, cause in enumerate(CAUSES_FIRST)}
    checks = sorted(
        stored["checks"], key=lambda check: (order.get(check["cause"], 2), not check["binding"])
    )
    worst = []
    for pair in worst_of(stored["checks"]):
        unit = run.table.shown(pair["metric"]).unit
        cell = (pair["renderer"], pair["policy"], pair["scene"], pair["seed"])
        texts = {name: short(pair[name], unit) for name in ("was", "now")}
        worst.append(pair | texts | {"page": pages.get(cell)})
    outcome = stored["outcome"]
    return {
        "title": WORDS[outcome["cause"]],
        "tone": tone_of_cause(outcome["cause"]),
        "gate": stored["gate"],
        "baseline": stored["baseline"],
        "exit_code": outcome["exit_code"],
        "sizes": stored["sizes"],
        "checks": [check | {"tone": tone_of_cause(check["cause"])} for check in checks],
        "worst": worst,
    }


def tone_of_cause(cause: str) -> str:
    """Return the colour of a verdict."""
    return TONES.get(cause, "broken")
