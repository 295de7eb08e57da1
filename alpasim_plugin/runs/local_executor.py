"""Rollouts in worker processes of this machine (`concurrent.futures`).

A worker that dies breaks its pool: what ran then is done again, each job alone in a pool of its
own, since nobody knows which job it was.
"""

import faulthandler
import multiprocessing
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.context import BaseContext
from typing import Any, TypeVar

from alpasim_plugin.core.printing import warn
from alpasim_plugin.core.subprocesses import end_with_parent, forget_safe_path, safe_path

J = TypeVar("J")
R = TypeVar("R")

OVERTIME_S = 10.0  # after the time limit, for a worker to end by itself
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
# Loaded once, by the process that workers are forked from.
PRELOAD = (
    "alpasim_plugin.control.tracker",
    "alpasim_plugin.renderers.gaussian",
    "alpasim_plugin.runs.execute",
    "evaluators.metrics.image_health",
    "evaluators.metrics.motion",
    "evaluators.metrics.offroad",
    "evaluators.metrics.outcomes",
    "evaluators.metrics.plan",
    "policies.lane_camera",
    "pyarrow.dataset",
)


@dataclass(frozen=True)
class Lost:
    """Stands for the result of a job whose workers died.

    Attributes:
        reason: What became of them.
        hint: What to do about it.
    """

    reason: str
    hint: str


def run_jobs(
    work: Callable[[J], R],
    jobs: Sequence[J],
    workers: int,
    threads: int = 1,
    limit_s: float | None = None,
    known: Callable[[J], R | None] = lambda job: None,
) -> Iterator[tuple[J, R | Lost]]:
    """Yield every job with its result, as they finish; results do not depend on the workers.

    Args:
        work: A module-level function, or a partial of one; pickled.
        jobs: Its arguments; pickled.
        workers: Processes. One, without a time limit, is this process.
        threads: Threads of each worker, for numerical libraries.
        limit_s: Seconds that one job may take before its worker is ended; None: no limit.
        known: Returns the result of a job whose worker died, if it was finished before.

    Raises:
        The first exception of ``work``; what still runs is ended.
    """
    if workers == 1 and limit_s is None:
        for job in jobs:
            yield job, work(job)
        return
    victims = []
    for job, future in _in_pools(work, jobs, workers, threads, limit_s):
        if _is_lost(future):
            victims.append(job)
        else:
            yield job, future.result()
    if victims:
        warn(f"warning: a worker process ended; {len(victims)} jobs run again, one at a time")
    for job in victims:
        result = known(job)
        if result is not None:
            yield job, result
            continue
        began_s = time.monotonic()
        for _, future in _in_pools(work, [job], 1, threads, limit_s):
            is_late = limit_s is not None and time.monotonic() - began_s >= limit_s
            yield (
                job,
                (_lost(limit_s if is_late else None) if _is_lost(future) else future.result()),
            )


def _in_pools(
    work: Callable[[J], R], jobs: Sequence[J], workers: int, threads: int, limit_s: float | None
) -> Iterator[tuple[J, Future[R]]]:
    """Yield every job with its finished future; a pool that broke is followed by another one.

    A worker ends itself at the time limit. One that is stopped cannot, so all workers are ended
    where none has finished anything for longer than that.
    """
    waiting = deque(jobs)
    patience_s = None if limit_s is None else limit_s + OVERTIME_S
    while waiting:
        with _pool(workers, threads) as (pool, end_workers):
            running: dict[Future[R], J] = {}
            is_broken = False
            while running or (waiting and not is_broken):
                while waiting and len(running) < workers and not is_broken:
                    try:
                        future = _submit(pool, threads, limited, work, waiting[0], limit_s)
                    except BrokenProcessPool:
                        is_broken = True
                    else:
                        running[future] = waiting.popleft()
                done, _ = wait(running, patience_s, return_when=FIRST_COMPLETED)
                if not done:
                    end_workers()
                for future in done:
                    is_broken = is_broken or _is_lost(future)
                    yield running.pop(future), future


@contextmanager
def _pool(workers: int, threads: int) -> Iterator[tuple[ProcessPoolExecutor, Callable[[], None]]]:
    """Open a pool for the block, with a function that ends its workers; when the block raises, or
    is left early, they are ended.
    """
    others = set(multiprocessing.active_children())
    with _environment(threads):  # the pool's locks start a process, too: the resource tracker
        pool = ProcessPoolExecutor(workers, _context(threads), _begin)

    def end_workers() -> None:
        for worker in set(multiprocessing.active_children()) - others:
            worker.kill()  # a stopped process heeds no other signal

    try:
        yield pool, end_workers
    except BaseException:
        end_workers()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _context(threads: int) -> BaseContext:
    """Return how workers begin: forked from a process that has loaded what rollouts need, with
    numerical libraries of one thread; otherwise anew.
    """
    if threads > 1 or sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(PRELOAD))
    return context


def _submit(
    pool: ProcessPoolExecutor, threads: int, work: Callable[..., R], *arguments: Any
) -> Future[R]:
    """Hand over a job, for which the pool may start a process."""
    with _environment(threads):
        future = pool.submit(work, *arguments)
        # The pool watches the processes that it had before it started another one for this job;
        # any further job makes it watch that one too.
        with suppress(BrokenProcessPool):
            pool.submit(os.getpid)
    return future


@contextmanager
def _environment(threads: int) -> Iterator[None]:
    """Set what a process that is started in the block reads first: the number of threads, and that
    nothing is imported from the working directory.
    """
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    try:
        with safe_path():
            yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin() -> None:
    """Prepare a worker: it ignores Ctrl-C, which the parent handles, and ends with its parent."""
    forget_safe_path()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def limited(work: Callable[[J], R], job: J, limit_s: float | None) -> R:
    """Do a job; at the time limit the worker prints where it hangs and ends."""
    if limit_s is None:
        return work(job)
    faulthandler.dump_traceback_later(limit_s, exit=True)
    try:
        return work(job)
    finally:
        faulthandler.cancel_dump_traceback_later()


def _is_lost(future: Future[Any]) -> bool:
    return isinstance(future.exception(), BrokenProcessPool)


def _lost(limit_s: float | None) -> Lost:
    if limit_s is not None:
        return Lost(
            f"it did not finish within {limit_s:g} s",
            "find out what hangs with --workers 1, or raise --time-limit",
        )
    return Lost(
        "its worker process ended, twice, without an error message",
        "look for the out-of-memory killer in the system log, or use --workers 1",
    )
