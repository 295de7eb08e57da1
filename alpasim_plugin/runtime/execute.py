"""Run the cells of a plan: in this process for one worker, in a pool of spawned processes for more.

A cell's result does not depend on where or when it runs: every random stream is keyed by (scene, seed, component, step) and the
rasteriser is bit-equal for any number of threads. The pool may therefore run cells in any order.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.atomic import write_json
from alpasim_plugin.errors import InfrastructureError
from alpasim_plugin.runtime.cell import MANIFEST, finished, rescore_cell, run_cell
from alpasim_plugin.runtime.plan import Cell, RunOptions, RunPlan

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

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


def execute(plan: RunPlan, root: Path, threads: Threads, on_done: OnDone, reuse_undigested: bool = False) -> list[dict[str, Any]]:
    """Run every unfinished cell and return all manifests in the plan's order.

    Finished rollouts are reused; those scored with another preset are scored again from their logs. KeyboardInterrupt is re-raised after
    the workers are stopped; finished rollouts stay on disk.

    Args:
        plan: The run.
        root: Its folder.
        threads: Workers, and threads of each.
        on_done: Called with each manifest.
        reuse_undigested: Also reuse rollouts with parts that have no digest.
    """
    manifests: dict[Path, dict[str, Any]] = {}
    todo: list[Cell] = []
    for cell in plan.cells:
        manifest = finished(cell, root, reuse_undigested)
        if manifest is None:
            todo.append(cell)
            continue
        if manifest.get("score_key") != cell.score_key:
            manifest = rescore_cell(cell, plan.options, root)
        manifests[cell.folder] = manifest
        on_done(manifest, True)
    runner = _run_here if threads.workers == 1 else _run_pool
    for cell, manifest in runner(todo, plan.options, root, threads):
        manifests[cell.folder] = manifest
        on_done(manifest, False)
    return [manifests[cell.folder] for cell in plan.cells]


def _run_here(todo: Sequence[Cell], options: RunOptions, root: Path, threads: Threads) -> Iterator[tuple[Cell, dict[str, Any]]]:
    for cell in todo:
        yield cell, run_cell(cell, options, root, threads.per_worker)


def _run_pool(todo: Sequence[Cell], options: RunOptions, root: Path, threads: Threads) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Run cells in pools. A worker that dies breaks its pool; the cells then in flight run again at the end, each in a pool of its own."""
    left = list(todo)
    suspects: list[Cell] = []
    while left:
        in_flight: dict[Future[dict[str, Any]], Cell] = {}
        try:
            for cell, manifest in _one_pool(list(left), options, root, threads, in_flight):
                left.remove(cell)
                yield cell, manifest
        except BrokenProcessPool:
            suspects += in_flight.values()
            left = [cell for cell in left if cell not in suspects]
    for cell in suspects:
        manifest_now = finished(cell, root, reuse_undigested=True)  # the worker may have died after writing it
        try:
            yield cell, manifest_now or next(_one_pool([cell], options, root, Threads(1, threads.per_worker), {}))[1]
        except BrokenProcessPool:
            yield cell, _lost_worker(cell, root)


def _one_pool(
    todo: Sequence[Cell],
    options: RunOptions,
    root: Path,
    threads: Threads,
    in_flight: dict[Future[dict[str, Any]], Cell],
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    context = multiprocessing.get_context("spawn")
    with thread_environment(threads.per_worker):
        pool = ProcessPoolExecutor(threads.workers, mp_context=context, initializer=ignore_interrupts)
        waiting = iter(todo)
        try:
            while True:
                # Few cells are queued, so that an interrupted run stops soon and few cells are suspects after a crash.
                for cell in _take(waiting, 2 * threads.workers - len(in_flight)):
                    in_flight[pool.submit(run_cell, cell, options, root, threads.per_worker)] = cell
                if not in_flight:
                    break
                done, _ = wait(in_flight, return_when=FIRST_COMPLETED)
                for future in done:
                    manifest = future.result()
                    yield in_flight.pop(future), manifest
        except BaseException:
            for process in list((pool._processes or {}).values()):
                process.terminate()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()


def _take(cells: Iterator[Cell], count: int) -> list[Cell]:
    return [cell for _, cell in zip(range(count), cells, strict=False)]


def ignore_interrupts() -> None:
    """Ignore SIGINT in a worker process: Ctrl-C reaches the whole process group, and the parent handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def thread_environment(per_worker: int) -> Iterator[None]:
    """Set the thread variables that numerical libraries read when a worker imports them."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(per_worker)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _lost_worker(cell: Cell, root: Path) -> dict[str, Any]:
    error = InfrastructureError(
        "running a rollout in a worker process",
        cell.folder.as_posix(),
        "the worker process exited without an error message, twice",
        "look for the out-of-memory killer in the system log, or use --workers 1",
    )
    manifest = {
        **cell.names,
        "path": cell.folder.as_posix(),
        "rollout_key": cell.rollout_key,
        "score_key": cell.score_key,
        "status": "failed",
        "error": error.as_dict(),
        "wall_s": None,
    }
    write_json(root / cell.folder / MANIFEST, manifest)
    return manifest
