"""The determinism certificate of a run: one rollout is repeated and compared with the first,
component by component, bit for bit.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pyarrow.parquet as pq

from alpasim_plugin.core.atomic import scratch_folder
from alpasim_plugin.core.errors import InfrastructureError, SimrunError
from alpasim_plugin.log import read_facts
from alpasim_plugin.log.run_folder.schema import FRAMES_NAME, LOG_NAME, STEPS_NAME
from alpasim_plugin.log.trace import Key, digests, first_difference, sha256, trace_log
from alpasim_plugin.runs.cell import run_cell
from alpasim_plugin.runs.plan import Cell, RunPlan

Certify = Literal["none", "one"]


@dataclass
class Repeat:
    """A rollout that is driven twice, the second time beside other rollouts where there are
    workers.

    Attributes:
        cell: Which; None: none.
        root: Where the second drive is written, as below a run folder.
        manifest: Of the second drive; None: it was not driven yet, or its worker died.
    """

    cell: Cell | None
    root: Path
    manifest: dict[str, Any] | None = None


@contextmanager
def repeating(plan: RunPlan, root: Path, mode: Certify) -> Iterator[Repeat]:
    """Yield what is to be repeated of a plan; the second drive is removed when the block ends."""
    # In the run folder, under a name that the next run removes if this process is killed.
    with scratch_folder(root / "repeat") as scratch:
        yield Repeat(foreseen(plan, mode), scratch)


def foreseen(plan: RunPlan, mode: Certify) -> Cell | None:
    """Return which rollout of a plan may be repeated beside the others; None: none, or one of
    services, which may take one at a time.
    """
    cell = None if mode == "none" else chosen_of(plan, plan.cells)
    return None if cell is None or cell.undigested else cell


def chosen_of(plan: RunPlan, cells: Iterable[Cell]) -> Cell | None:
    """Return which of some rollouts is repeated; None where none can be: the shortest, of several
    that with the smallest content key.
    """

    def order(cell: Cell) -> tuple[int, str]:
        scenario = plan.scenarios[cell.scene]
        return scenario.end_us - scenario.start_us, cell.rollout_key

    return min(
        (cell for cell in cells if plan.scenarios[cell.scene].latency.kind != "measured"),
        key=order,
        default=None,
    )


def certify(
    plan: RunPlan,
    root: Path,
    manifests: Sequence[dict[str, Any]],
    threads: int,
    mode: Certify,
    before: Mapping[str, Any] | None = None,
    repeat: Repeat | None = None,
) -> dict[str, Any]:
    """Compare a rollout of a finished run with its repeat, and return the certificate.

    The rollout is `chosen_of` those that finished.

    Args:
        plan: The run.
        root: Its folder.
        manifests: One per cell, in the plan's order.
        threads: Threads of a repeat in this process; results must not depend on them.
        mode: "none" makes no repeat.
        before: The folder's earlier certificate; it is kept if it certifies the same rollout and
            the same log.
        repeat: What was repeated beside the others. Where it is another rollout, the repeat runs
            now, in this process.

    Returns:
        ``status`` (equal, different, skipped), ``reason`` where skipped, ``error`` (its four parts)
        where the repeat failed, ``cell``, ``path``, ``rollout_key``, ``score_key``, ``steps``,
        ``log_sha256`` and ``digests`` (component -> SHA-256 of the first rollout), ``repeated``
        (those of the repeat), ``first_difference`` (component, t_us, step, what) or None, and
        ``wall_s``.
    """
    if mode == "none":
        return {"status": "skipped", "reason": "switched off with --certify none"}
    done = [(cell, m) for cell, m in zip(plan.cells, manifests, strict=True) if m["status"] == "ok"]
    cell = chosen_of(plan, (cell for cell, _ in done))
    if cell is None:
        why = (
            "latency 'measured' depends on the machine: no rollout can be repeated"
            if done
            else "no rollout finished"
        )
        return {"status": "skipped", "reason": why}
    manifest = next(m for one, m in done if one is cell)
    log_sha256 = sha256((root / cell.folder / LOG_NAME).read_bytes())
    facts = {
        "cell": dict(cell.names),
        "path": cell.folder.as_posix(),
        "rollout_key": cell.rollout_key,
        "score_key": cell.score_key,
        "steps": manifest["steps"],
        "log_sha256": log_sha256,
    }
    if (
        before
        and before.get("status") == "equal"
        and all(before.get(key) == value for key, value in facts.items())
    ):
        return dict(before)
    began = time.perf_counter()
    try:
        with repeating(plan, root, mode) as late:
            again = (
                repeat
                if repeat is not None and repeat.cell is cell and repeat.manifest is not None
                else late
            )
            took_s = 0.0 if again.manifest is None else again.manifest["wall_s"]
            again.manifest = again.manifest or run_cell(cell, plan.options, late.root, threads)
            found = _compared(plan, cell, root, manifest, again.root, again.manifest, log_sha256)
    # the run is driven and scored: its tables and reports must not be lost with the repeat
    except SimrunError as error:
        found = _skipped(error.as_dict())
        took_s = 0.0
    return facts | found | {"wall_s": round(took_s + time.perf_counter() - began, 3)}


def certificate_line(certificate: Mapping[str, Any]) -> str:
    """Return a certificate as one line of text.

    Example:
        >>> certificate_line({"status": "skipped", "reason": "no rollout finished"})
        'skipped: no rollout finished'
    """
    if certificate["status"] == "skipped":
        return f"skipped: {certificate['reason']}"
    first = certificate["first_difference"]
    if first is None:
        return f"equal to the bit: {certificate['path']}"
    at = f" at step {first['step']}" if first["step"] is not None else ""
    return f"DIFFERENT: {certificate['path']}, first in {first['component']}{at} ({first['what']})"


def _compared(
    plan: RunPlan,
    cell: Cell,
    root: Path,
    manifest: Mapping[str, Any],
    again_root: Path,
    again: Mapping[str, Any],
    log_sha256: str,
) -> dict[str, Any]:
    if again["status"] != "ok":
        return _not_repeated(again["error"])
    one, other = (
        rollout_trace(root / cell.folder, manifest),
        rollout_trace(again_root / cell.folder, again),
    )
    same_bytes = sha256((again_root / cell.folder / LOG_NAME).read_bytes()) == log_sha256
    scenario = plan.scenarios[cell.scene]
    difference = first_difference(one, other, scenario.start_us, scenario.rates.control_us)
    first = None if difference is None else difference.as_dict()
    if first is None and not same_bytes:
        first = {
            "component": "log",
            "t_us": None,
            "step": None,
            "what": "an entry that belongs to no component",
        }
    status = "equal" if first is None else "different"
    return {
        "status": status,
        "digests": digests(one),
        "repeated": digests(other),
        "first_difference": first,
    }


def _not_repeated(error: Mapping[str, str]) -> dict[str, Any]:
    """Return the certificate of a repeat that ended with an error; one of the machine or of a
    service says nothing about the rollout.
    """
    if error["failure_class"] == InfrastructureError.failure_class:
        return _skipped(error)
    first = {
        "component": "run",
        "t_us": None,
        "step": None,
        "what": f"the repeat failed: {error['message']}",
    }
    return {
        "status": "different",
        "digests": {},
        "repeated": {},
        "first_difference": first,
        "error": dict(error),
    }


def _skipped(error: Mapping[str, str]) -> dict[str, Any]:
    reason = f"the repeat failed: {error['message']}"
    return {"status": "skipped", "reason": reason, "error": dict(error)}


def log_trace(folder: Path) -> dict[str, dict[Key, str]]:
    """Read the components of a finished rollout from its log and its per-frame facts."""
    return trace_log(folder / LOG_NAME, read_facts(folder / FRAMES_NAME))


def rollout_trace(folder: Path, manifest: Mapping[str, Any]) -> dict[str, dict[Key, str]]:
    """Read all components of a finished rollout, its scores included.

    Args:
        folder: The rollout's folder.
        manifest: Its manifest.

    Raises:
        InputError: A file is missing or damaged.
    """
    trace = log_trace(folder)
    table = pq.read_table(
        folder / STEPS_NAME, columns=["t_us", "metric", "value", "valid", "reason"]
    )
    values: dict[Key, list[str]] = defaultdict(list)
    columns: list[list[Any]] = [table[name].to_pylist() for name in table.column_names]
    for t_us, metric, *rest in zip(*columns, strict=True):
        values[t_us, metric].append(repr(rest))
    scores = {key: sha256("".join(found).encode()) for key, found in values.items()}
    for name, entry in manifest["metrics"].items():
        scores[0, f"{name} of the rollout"] = sha256(json.dumps(entry, sort_keys=True).encode())
    return trace | {"scores": scores}
