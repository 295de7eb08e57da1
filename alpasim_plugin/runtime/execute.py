"""Run the cells of a plan: in this process for one worker, in spawned processes for more, or on the nodes of a cluster.

A cell's result does not depend on where or when it runs: every random stream is keyed by (scene, seed, component, step) and the
rasteriser is bit-equal for any number of threads. Workers may therefore run cells in any order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.io.measured import share_measurements
from alpasim_plugin.runtime.cell import failed_manifest, find_rollout_state, rescore_cell, run_cell
from alpasim_plugin.runtime.executors.assignment import assignment_as_here
from alpasim_plugin.runtime.executors.choice import LOCAL, Executor, opened_pool
from alpasim_plugin.runtime.executors.dispatch import dispatch
from alpasim_plugin.runtime.executors.identity import targets_of
from alpasim_plugin.runtime.executors.local import run_local
from alpasim_plugin.runtime.executors.parcel import Parcel, unpack
from alpasim_plugin.runtime.executors.scratch import measured_folder
from alpasim_plugin.runtime.kernels import compile_for
from alpasim_plugin.runtime.manifests import write_manifest
from alpasim_plugin.runtime.plan import Cell, RunOptions, RunPlan
from alpasim_plugin.runtime.stores.commits import Commits
from alpasim_plugin.runtime.stores.stored import commit_key, opened, run_stored_cell
from alpasim_plugin.runtime.workers import Lost

OnDone = Callable[[dict[str, Any], bool], None]  # (manifest, reused)


@dataclass(frozen=True)
class Threads:
    """The thread budget: workers x threads per worker never exceeds the cores."""

    workers: int
    per_worker: int


def thread_budget(workers: int | None, n_cells: int, executor: Executor = LOCAL) -> Threads:
    """Divide the cores that this process may use among the workers; those of other nodes have the cores that the executor asks for.

    Args:
        workers: Number of workers; None is one per core. Never more than cells. On other nodes it is the most, and None is no bound.
        n_cells: Number of cells to run.
        executor: Where rollouts run.
    """
    if not executor.is_local:
        return Threads(max(1, min(workers or n_cells, n_cells)), executor.resources.cores)
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
        executor: Where rollouts run.
        store: URL of a store in which rollouts are looked up and committed; None: the run folder alone.
        run: Token by which the processes of the run know each other.
    """

    threads: Threads
    reuse_undigested: bool = False
    full: bool = False
    limit_s: float | None = None
    retry: bool = False
    executor: Executor = LOCAL
    store: str | None = None
    run: str = field(default_factory=lambda: os.urandom(8).hex())

    @property
    def stated(self) -> dict[str, Any]:
        """Give what ``run.json`` says of executor and store; nothing for a run on this machine alone."""
        return {} if self.executor.is_local and self.store is None else {"executor": str(self.executor), "store": self.store}

    @property
    def cores_here(self) -> int:
        """Give the cores of this machine that a rollout may use when the others are done."""
        here = self.threads if self.executor.is_local else thread_budget(1, 1)
        return here.workers * here.per_worker


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
    share_measurements(measured_folder(how.run))
    manifests: dict[Path, dict[str, Any]] = {}
    todo: list[Cell] = []
    shelf = None if how.store is None else Shelf(opened(how.store), plan.options, how.reuse_undigested)
    for cell in plan.cells:
        folder = cell.folder.as_posix()
        remedy, state = find_rollout_state(cell, root, how.reuse_undigested, how.full, folder in known, how.retry, plan.options.video)
        if state.damage:
            doing = "driving again" if remedy == "drive" else "scoring again"
            noticed(f"damaged: {'; '.join(map(str, state.damage))}; {doing}")
        if remedy == "drive" or state.manifest is None:
            stored = shelf and shelf.find(cell)
            if not stored:
                todo.append(cell)
                continue
            manifest = _scored(cell, plan.options, root, unpack(stored, root))
        else:
            manifest = state.manifest if remedy == "none" else rescore_cell(cell, plan.options, root, state.manifest)
        manifests[cell.folder] = manifest
        on_done(manifest, True)
    runner = _run_local if how.executor.is_local else _run_elsewhere
    for cell, manifest in runner(todo, plan, root, how, shelf, noticed):
        manifest = _scored(cell, plan.options, root, manifest)
        manifests[cell.folder] = manifest
        on_done(manifest, False)
        if shelf is not None:
            shelf.add(cell, manifest)
    if shelf is not None:
        shelf.commits.index.flush()
    return [manifests[cell.folder] for cell in plan.cells]


class Shelf:
    """The driver's view of a store: what it knows to be committed.

    Args:
        commits: The store.
        options: Of the run.
        reuse_undigested: Also reuse rollouts with parts that have no digest.
    """

    def __init__(self, commits: Commits, options: RunOptions, reuse_undigested: bool) -> None:
        self.commits, self._options = commits, options
        self.fresh = "" if reuse_undigested else os.urandom(8).hex()
        commits.index.load()

    def find(self, cell: Cell) -> Parcel | None:
        """Return a rollout that the index names."""
        key = commit_key(cell, self._options, self.fresh)
        return self.commits.find(key) if key in self.commits.index.keys else None

    def add(self, cell: Cell, manifest: Mapping[str, Any]) -> None:
        """Take in a rollout that a worker has committed."""
        if manifest["status"] == "ok":
            self.commits.index.add([commit_key(cell, self._options, self.fresh)])


def _scored(cell: Cell, options: RunOptions, root: Path, manifest: dict[str, Any]) -> dict[str, Any]:
    """Score a rollout that comes from a store, or from an earlier driver, again if its scores are another preset's."""
    if manifest["status"] != "ok" or manifest["score_key"] == cell.score_key:
        return manifest
    return rescore_cell(cell, options, root, manifest)


Done = Iterator[tuple[Cell, dict[str, Any]]]
Noticed = Callable[[str], None]


def _run_local(todo: Sequence[Cell], plan: RunPlan, root: Path, how: HowToRun, shelf: Shelf | None, noticed: Noticed) -> Done:
    """Run cells in this process, or in workers that write the run folder themselves."""
    if how.threads.workers > 1 or how.limit_s is not None:
        compile_for(todo, plan.scenarios, how.threads.workers)
    threads = how.threads.per_worker
    work: Callable[[Cell], dict[str, Any]] = partial(run_cell, options=plan.options, root=root, threads=threads)
    if how.store is not None and shelf is not None:
        work = partial(run_stored_cell, options=plan.options, root=root, threads=threads, store=how.store, fresh=shelf.fresh)

    def recall(cell: Cell) -> dict[str, Any] | None:  # a worker may have died after writing its rollout
        remedy, state = find_rollout_state(cell, root, reuse_undigested=True)
        return state.manifest if remedy == "none" else None

    for cell, got in run_local(partial(_of_run, how.run, work), todo, how.threads.workers, how.threads.per_worker, how.limit_s, recall):
        yield cell, _lost(cell, root, got) if isinstance(got, Lost) else got


def _of_run(run: str, work: Callable[[Cell], dict[str, Any]], cell: Cell) -> dict[str, Any]:
    """Run a cell in a worker of this machine."""
    share_measurements(measured_folder(run))
    return work(cell)


def _run_elsewhere(
    todo: Sequence[Cell], plan: RunPlan, root: Path, how: HowToRun, shelf: Shelf | None, noticed: Callable[[str], None]
) -> Done:
    """Run cells on other nodes; only this process writes the run folder."""
    if not todo:
        return
    from alpasim_plugin.runtime.executors.mission import mission_of  # a run on this machine needs none of it

    mission, contents = mission_of(plan, how.run, todo, how.threads.per_worker, how.store, shelf.fresh if shelf else "")
    most = min(how.threads.workers, len(todo))
    given = assignment_as_here(mission, contents, targets_of(plan.parts), how.executor.resources, most, noticed)
    with opened_pool(how.executor, given, root) as pool:
        for cell, got in dispatch(pool, todo, noticed, how.limit_s):
            yield cell, _lost(cell, root, got) if isinstance(got, Lost) else unpack(got, root)


def _lost(cell: Cell, root: Path, lost: Lost) -> dict[str, Any]:
    """Write the manifest of a rollout whose workers died, or that was ended since it took too long."""
    error = InfrastructureError("running a rollout in a worker process", cell.folder.as_posix(), lost.found, lost.do_this)
    manifest = failed_manifest(cell, error)
    write_manifest(root / cell.folder, manifest)
    return manifest
