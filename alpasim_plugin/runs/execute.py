"""Run the rollouts of a plan: in this process for one worker, in spawned processes for more, or on the
nodes of a cluster.

A cell's result does not depend on where or when it runs: every random stream is keyed by (scene,
seed, component, step) and the rasteriser is bit-equal for any number of threads. Workers may
therefore run rollouts in any order.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

from alpasim_plugin.core.cores import usable_cores
from alpasim_plugin.core.devices import share_card
from alpasim_plugin.core.errors import PolicyError, SimrunError
from alpasim_plugin.core.files.stage import shown_in
from alpasim_plugin.log.run_folder.manifests import write_manifest
from alpasim_plugin.log.run_folder.records import Manifest, RunInfo
from alpasim_plugin.log.run_folder.schema import STAGES
from alpasim_plugin.runs.cell import (
    copy_cell,
    failed_manifest,
    find_rollout_state,
    is_copied,
    kept_failure,
    rescore_cell,
    run_cell,
    users_parts,
)
from alpasim_plugin.runs.changes import reasons, score_reasons, sentence
from alpasim_plugin.runs.executor_choice import LOCAL, Executor
from alpasim_plugin.runs.local_executor import Lost, apart, run_jobs
from alpasim_plugin.runs.plan import Cell, RunOptions, RunPlan

NOT_DRIVEN = "Correct the policy; it was not driven."

OnDone = Callable[[Manifest, bool], None]  # (manifest, reused)
Job = tuple[Cell, Manifest | None]  # with the manifest of the rollout that it is a copy of
Done = Iterator[tuple[Cell, Manifest]]


@dataclass(frozen=True)
class Threads:
    """The thread budget: workers x threads per worker never exceeds the cores."""

    workers: int
    per_worker: int


def thread_budget(workers: int | None, n_cells: int, executor: Executor = LOCAL) -> Threads:
    """Divide the cores that this process may use among the workers; those of other nodes have the
    cores that the executor asks for.

    Args:
        workers: Number of workers; None is one per core. Never more than rollouts. On other nodes it
            is the most, and None is no bound.
        n_cells: Number of rollouts to run.
        executor: Where rollouts run.
    """
    if not executor.is_local:
        return Threads(max(1, min(workers or n_cells, n_cells)), executor.cores)
    cores = usable_cores()
    chosen = max(1, min(workers or cores, max(n_cells, 1)))
    return Threads(chosen, max(1, cores // chosen))


@dataclass(frozen=True)
class HowToRun:
    """What decides how a plan is executed, and nothing of its results.

    Attributes:
        threads: Workers, and threads of each.
        reuse_undigested: Also reuse rollouts with parts that have no digest.
        limit_s: Seconds that one rollout may take; a worker that exceeds them is killed. None: no
            limit.
        executor: Where rollouts run.
    """

    threads: Threads
    reuse_undigested: bool = False
    limit_s: float | None = None
    executor: Executor = LOCAL

    @property
    def stated(self) -> str | None:
        """Give what ``run.json`` says of the executor; None for a run on this machine."""
        return None if self.executor.is_local else str(self.executor)

    @property
    def local_threads(self) -> Threads:
        """Give the workers of this machine and their threads."""
        return self.threads if self.executor.is_local else thread_budget(1, 1)

    @property
    def local_cores(self) -> int:
        """Give the cores of this machine that a rollout may use when the others are done."""
        return self.local_threads.workers * self.local_threads.per_worker


def execute(
    plan: RunPlan,
    root: Path,
    how: HowToRun,
    on_done: OnDone,
    notify: Callable[[str], None],
    held: RunInfo | None = None,
    hanging: Mapping[str, str] = MappingProxyType({}),
) -> list[Manifest]:
    """Run every unfinished rollout and return all manifests in the plan's order.

    Whole rollouts are reused; those scored with another preset, or whose table is damaged, are
    scored again from their logs; damaged ones are driven again. A policy without a camera drives
    behind the first renderer alone, and its other rollouts are copies of that one. On SIGINT,
    SIGTERM or SIGHUP the workers are stopped; finished rollouts stay on disk.

    Args:
        plan: The run.
        root: Its folder.
        how: Workers, checks, limits.
        on_done: Called with each manifest.
        notify: Called with one line for each damaged rollout, one each that says what is driven or
            scored again and why, and one for each failure that is kept.
        held: What ``run.json`` said before; it names the files of what is driven again. None: not
            known.
        hanging: By policy what its check says, where it hung or died: such a policy is not driven.
    """
    work = _sort_cells(plan, root, how, on_done, notify, held, hanging)
    if work.n_again:
        notify(sentence(work.n_again, work.causes))
    if work.score_causes:
        notify(sentence(work.n_scored, work.score_causes, "scored"))

    def take(done: Done) -> None:
        for cell, manifest in done:
            work.manifests[cell.folder] = replace(manifest, reused=False)
            on_done(manifest, False)

    try:
        take(_run(work.todo, plan, root, how))
        jobs = [(cell, work.manifests[original.folder]) for cell, original in work.copies]
        take(_run([cell for cell, driven in jobs if not is_copied(driven)], plan, root, how))
        take(_run_local([job for job in jobs if is_copied(job[1])], plan, root, how))
    finally:
        shutil.rmtree(root / STAGES, ignore_errors=True)
    return [work.manifests[cell.folder] for cell in plan.cells]


@dataclass
class _Work:
    """The rollouts of a plan, by what is to be done with them.

    Attributes:
        manifests: Folder -> manifest of what is finished.
        todo: What is to be driven.
        copies: What is to be copied, with its original.
        n_again: How many of ``todo`` have been driven before.
        causes: Why those are driven again.
        n_scored: How many whole rollouts are scored again.
        score_causes: Why those are.
    """

    manifests: dict[Path, Manifest] = field(default_factory=dict)
    todo: list[Cell] = field(default_factory=list)
    copies: list[tuple[Cell, Cell]] = field(default_factory=list)
    n_again: int = 0
    causes: list[str] = field(default_factory=list)
    n_scored: int = 0
    score_causes: list[str] = field(default_factory=list)


def _sort_cells(
    plan: RunPlan,
    root: Path,
    how: HowToRun,
    on_done: OnDone,
    notify: Callable[[str], None],
    held: RunInfo | None,
    hanging: Mapping[str, str],
) -> _Work:
    """Reuse or score again what the run folder holds, and list what is to be driven or copied; see
    `execute`.
    """
    work = _Work()
    originals: dict[tuple[str, str, int], Cell] = {}
    for cell in plan.cells:
        action, state = find_rollout_state(cell, root, how.reuse_undigested, plan.options.video)
        manifest = state.manifest
        original = cell
        if cell.policy.is_blind:
            original = originals.setdefault((cell.policy.name, cell.scene, cell.seed), cell)
        if state.damage:
            notify(f"damaged: {'; '.join(map(str, state.damage))}; it is made again")
        if original is not cell:
            # None where it is still to be driven
            driven = work.manifests.get(original.folder)
            if _is_copied_anew(driven, manifest, action):
                work.copies.append((cell, original))
                continue
        if action == "drive" or manifest is None:
            if cell.policy.name in hanging:
                error = PolicyError(hanging[cell.policy.name], NOT_DRIVEN)
                work.manifests[cell.folder] = _write_failed(cell, root, error)
                on_done(work.manifests[cell.folder], False)
                continue
            work.todo.append(cell)
            why = [] if manifest is None else reasons(cell, manifest, held, plan)
            work.n_again += bool(why)
            work.causes += why
            continue
        if not manifest.ok:
            notify(kept_failure(cell, manifest))
        if action == "score":
            if not state.damage:
                work.n_scored += 1
                work.score_causes += score_reasons(manifest, held, plan)
            manifest = _rescored(cell, plan, root, manifest, how)
        work.manifests[cell.folder] = replace(manifest, reused=True)
        on_done(manifest, True)
    return work


def _is_copied_anew(driven: Manifest | None, copy: Manifest | None, action: str) -> bool:
    """Tell whether the rollout of a policy that sees nothing is copied from that behind another
    renderer, in place of what the folder holds.

    Args:
        driven: The rollout to copy; None where it is still to be driven.
        copy: What the folder holds.
        action: What the folder's rollout would need.
    """
    if driven is None:
        return True
    if not is_copied(driven):
        return False
    return action != "none" or copy is None or copy.copied_from != driven.path


def _rescored(cell: Cell, plan: RunPlan, root: Path, manifest: Manifest, how: HowToRun) -> Manifest:
    """Score a rollout again; where an evaluator fails, its log and its values stay on disk."""
    parts = ", ".join(part.name for part in cell.evaluators if part.is_users)
    work = partial(rescore_cell, options=plan.options, root=root.absolute(), manifest=manifest)
    try:
        return apart(work, cell, parts, how.local_threads.per_worker, how.limit_s)
    except SimrunError as error:
        return failed_manifest(cell, error)


def _run(todo: Sequence[Cell], plan: RunPlan, root: Path, how: HowToRun) -> Done:
    """Drive rollouts where the executor says; with Ray only this process writes the run folder."""
    if how.executor.is_local:
        yield from _run_local([(cell, None) for cell in todo], plan, root, how)
    elif todo:
        from alpasim_plugin.runs.ray_executor import run_on_ray

        workers = how.threads.workers
        for cell, got in run_on_ray(plan, todo, root, how.executor, workers, how.limit_s):
            yield cell, _lost(cell, root, got) if isinstance(got, Lost) else got


def _run_local(jobs: Sequence[Job], plan: RunPlan, root: Path, how: HowToRun) -> Done:
    """Drive or copy rollouts in this process, or in workers that write the run folder themselves."""
    workers = how.local_threads.workers
    threads = how.local_threads.per_worker
    if workers > 1:  # the slowest rollouts come first, so that all workers end together
        jobs = sorted(jobs, key=lambda job: job[0].renderer.fixer is None)
    work = partial(_work, plan.options, root.absolute(), how.local_threads)

    def written(job: Job) -> Manifest | None:
        """Return the manifest of a rollout whose worker died after it had written it."""
        action, state = find_rollout_state(job[0], root, reuse_undigested=True)
        return state.manifest if action == "none" else None

    driven = run_jobs(work, jobs, workers, threads, how.limit_s, written, _users_parts, _channel_of)
    for (cell, _), result in driven:
        yield cell, _lost(cell, root, result) if isinstance(result, Lost) else result


def _users_parts(job: Job) -> str:
    return users_parts(job[0])


def _channel_of(job: Job) -> str:
    cell, original = job
    return cell.policy.channel if original is None else ""


def _work(options: RunOptions, root: Path, local_threads: Threads, job: Job) -> Manifest:
    """Drive or copy a rollout in a worker of this machine."""
    share_card(options.device, local_threads.workers)
    cell, original = job
    threads = local_threads.per_worker
    with shown_in(root / STAGES):
        if original is None:
            return run_cell(cell, options, root, threads)
        return copy_cell(cell, options, root, threads, original)


def _lost(cell: Cell, root: Path, lost: Lost) -> Manifest:
    """Write the manifest of a rollout whose workers died, or that was ended since it took too
    long.
    """
    return _write_failed(cell, root, lost.error(cell.folder.as_posix()))


def _write_failed(cell: Cell, root: Path, error: SimrunError) -> Manifest:
    manifest = failed_manifest(cell, error)
    write_manifest(root / cell.folder, manifest)
    return manifest
