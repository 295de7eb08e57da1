"""Drive a rollout of each policy a second time, to see whether it is repeatable."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.files.atomic import scratch_folder
from alpasim_plugin.log import read_facts
from alpasim_plugin.log.run_folder.checksums import checksums_of
from alpasim_plugin.log.run_folder.records import CellNames, LogDifference, Manifest, Repeat
from alpasim_plugin.log.run_folder.schema import FRAMES_NAME, LOG_NAME, cell_name
from alpasim_plugin.log.trace import Trace, first_difference, trace_log
from alpasim_plugin.runs.cell import run_cell, users_parts
from alpasim_plugin.runs.local_executor import apart
from alpasim_plugin.runs.plan import Cell, RunPlan


def log_trace(folder: Path) -> Trace:
    """Read the components of a finished rollout from its log and its per-frame facts."""
    return trace_log(folder / LOG_NAME, read_facts(folder / FRAMES_NAME))


def repeat_rollout(
    plan: RunPlan, root: Path, manifests: Sequence[Manifest], threads: int
) -> Repeat:
    """Drive the shortest finished rollout of each policy again and compare the two logs.

    Times that depend on the clock are no part of the comparison. Rollouts whose latency is measured
    depend on the machine, so none of them is repeated.

    Args:
        plan: The run.
        root: Its folder.
        manifests: One per rollout, in the plan's order.
        threads: Threads of the second rollout.

    Returns:
        Of the first policy that is not repeatable, else of one that could not be compared, else of
        any.
    """
    finished = [
        cell
        for cell, manifest in zip(plan.cells, manifests, strict=True)
        if manifest.ok and plan.scenarios[cell.scene].latency.kind != "measured"
    ]
    longest_first = sorted(
        finished,
        key=lambda cell: (
            plan.scenarios[cell.scene].start_us - plan.scenarios[cell.scene].end_us,
            cell.rollout_key,
        ),
    )
    shortest = {cell.policy.name: cell for cell in longest_first}
    if not shortest:
        return _not_compared("no rollout with a fixed latency has finished")
    comparisons = [_driven_twice(plan, root, cell, threads) for cell in shortest.values()]
    return min(comparisons, key=lambda result: (False, None, True).index(result.repeatable))


def _driven_twice(plan: RunPlan, root: Path, cell: Cell, threads: int) -> Repeat:
    folder = root / cell.folder
    with scratch_folder(root / "repeat") as scratch:
        work = partial(run_cell, options=plan.options, root=scratch.absolute(), threads=threads)
        try:
            again = apart(work, cell, users_parts(cell), threads)
        except SimrunError as error:
            return _not_compared(f"the second rollout failed: {error.message}")
        if again.error is not None:
            return _not_compared(f"the second rollout failed: {again.error.message}")
        first = log_trace(folder)
        second = log_trace(scratch / cell.folder)
        digests = [
            checksums_of(path, [LOG_NAME])[LOG_NAME]["sha256"]
            for path in (folder, scratch / cell.folder)
        ]
    scenario = plan.scenarios[cell.scene]
    difference = first_difference(first, second, scenario.start_us, scenario.rates.control_us)
    return Repeat(
        repeatable=difference is None and digests[0] == digests[1],
        cell=CellNames(cell.renderer.name, cell.policy.name, cell.scene, cell.seed),
        digests=tuple(digests),
        first_difference=None if difference is None else LogDifference(**difference),
    )


def repeat_line(repeat: Repeat) -> str:
    """Return the result of a repeated rollout as one line of text.

    Example:
        >>> repeat_line(Repeat(None, reason="no rollout has finished"))
        'not compared: no rollout has finished'
    """
    if repeat.cell is None:
        return f"not compared: {repeat.reason}"
    cell = cell_name(repeat.cell.renderer, repeat.cell.policy, repeat.cell.scene, repeat.cell.seed)
    if repeat.repeatable:
        return f"repeatable: {cell} was driven twice with equal logs"
    difference = repeat.first_difference or LogDifference("log")
    step = "" if difference.step is None else f" at step {difference.step}"
    return (
        f"NOT repeatable: {cell} was driven twice and differs first in {difference.component}{step}"
    )


def _not_compared(reason: str) -> Repeat:
    return Repeat(None, reason=reason)
