"""Run the cells of a plan: in this process for one worker, in spawned processes for more.

A cell's result does not depend on where or when it runs: every random stream is keyed by (scene, seed, component, step) and the
rasteriser is bit-equal for any number of threads. Workers may therefore run cells in any order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from alpasim_plugin.errors import InfrastructureError
from alpasim_plugin.runtime.cell import find_rollout_state, rescore_cell, run_cell
from alpasim_plugin.runtime.kernels import compile_for
from alpasim_plugin.runtime.manifests import write_manifest
from alpasim_plugin.runtime.plan import Cell, RunOptions, RunPlan
from alpasim_plugin.runtime.workers import Lost, in_workers

OnDone = Callable[[dict[str, Any], bool], None]  # (manifest, reused)


@dataclass(frozen=True)
class Threads:
    """The thread budget: workers x threads per worker never exceeds the cores."""

    workers: int
    per_worker: int


def thread_budget(workers: int | None, n_cells: int) -> Threads:
    """Divide the cores that this process may use among the workers.

    Args:
        workers: Number of workers; None is one per core. Never more than cells.
        n_cells: Number of cells to run.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    chosen = max(1, min(workers or cores, max(n_cells, 1)))
    return Threads(chosen, max(1, cores // chosen))


@dataclass(frozen=True)
class HowToRun:
    """What decides how a plan is executed, and nothing of its results.

    Attributes:
        threads: Workers, and threads of each.
        reuse_undigested: Also reuse rollouts with parts that have no digest.
        full: Read every file of a finished rollout before it is reused, even if size and time are as written.
        retry: Drive again also what failed by the policy's own fault.
        limit_s: Seconds that one rollout may take; a worker that exceeds them is killed. None: no limit.
    """

    threads: Threads
    reuse_undigested: bool = False
    full: bool = False
    limit_s: float | None = None
    retry: bool = False


def execute(
    plan: RunPlan, root: Path, how: HowToRun, on_done: OnDone, noticed: Callable[[str], None], known: Collection[str] = ()
) -> list[dict[str, Any]]:
    """Run every unfinished cell and return all manifests in the plan's order.

    Whole rollouts are reused; those scored with another preset, or whose table is damaged, are scored again from their logs; damaged
    ones are driven again. On SIGINT, SIGTERM or SIGHUP the workers are stopped; finished rollouts stay on disk.

    Args:
        plan: The run.
        root: Its folder.
        how: Workers, checks, limits.
        on_done: Called with each manifest.
        noticed: Called with one line for each damaged rollout.
        known: Folders of rollouts that were finished once.
    """
    manifests: dict[Path, dict[str, Any]] = {}
    todo: list[Cell] = []
    for cell in plan.cells:
        folder = cell.folder.as_posix()
        remedy, state = find_rollout_state(cell, root, how.reuse_undigested, how.full, folder in known, how.retry, plan.options.video)
        if state.damage:
            doing = "driving again" if remedy == "drive" else "scoring again"
            noticed(f"damaged: {'; '.join(map(str, state.damage))}; {doing}")
        if remedy == "drive" or state.manifest is None:
            todo.append(cell)
            continue
        manifest = state.manifest if remedy == "none" else rescore_cell(cell, plan.options, root, state.manifest)
        manifests[cell.folder] = manifest
        on_done(manifest, True)
    here = how.threads.workers == 1 and how.limit_s is None
    if not here:
        compile_for(todo, plan.scenarios, how.threads.workers)
    runner = _run_here if here else _run_in_workers
    for cell, manifest in runner(todo, plan.options, root, how):
        manifests[cell.folder] = manifest
        on_done(manifest, False)
    return [manifests[cell.folder] for cell in plan.cells]


def _run_here(todo: Sequence[Cell], options: RunOptions, root: Path, how: HowToRun) -> Iterator[tuple[Cell, dict[str, Any]]]:
    for cell in todo:
        yield cell, run_cell(cell, options, root, how.threads.per_worker)


def _run_in_workers(todo: Sequence[Cell], options: RunOptions, root: Path, how: HowToRun) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Run cells in workers. A cell whose worker died runs again at the end, alone: it may have been the victim of another's memory."""
    work = partial(run_cell, options=options, root=root, threads=how.threads.per_worker)
    victims: list[Cell] = []
    for cell, got in in_workers(work, todo, how.threads.workers, how.threads.per_worker, how.limit_s):
        if not isinstance(got, Lost):
            yield cell, got
        elif got.hung:
            yield cell, _lost(cell, root, got)
        else:
            victims.append(cell)
    for cell in victims:
        remedy, state = find_rollout_state(cell, root, reuse_undigested=True)  # the worker may have died after writing it
        if remedy == "none" and state.manifest is not None:
            yield cell, state.manifest
            continue
        for _, got in in_workers(work, [cell], 1, how.threads.per_worker, how.limit_s):
            yield cell, _lost(cell, root, got) if isinstance(got, Lost) else got


def _lost(cell: Cell, root: Path, lost: Lost) -> dict[str, Any]:
    """Write the manifest of a rollout whose worker died twice, or was killed since it took too long."""
    if lost.hung:
        found, do_this = lost.found, "look at what hangs with --workers 1, or raise --time-limit"
    else:
        found = f"{lost.found}, twice, without an error message"
        do_this = "look for the out-of-memory killer in the system log, or use --workers 1"
    error = InfrastructureError("running a rollout in a worker process", cell.folder.as_posix(), found, do_this)
    manifest = {
        **cell.names,
        "path": cell.folder.as_posix(),
        "rollout_key": cell.rollout_key,
        "score_key": cell.score_key,
        "status": "failed",
        "error": error.as_dict(),
        "wall_s": None,
    }
    write_manifest(root / cell.folder, manifest)
    return manifest
