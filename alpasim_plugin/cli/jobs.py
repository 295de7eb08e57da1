"""Run independent work in processes; results do not depend on their number."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

from alpasim_plugin.runtime.execute import ignore_interrupts, thread_environment

A = TypeVar("A")
R = TypeVar("R")


def parallel_map(work: Callable[[A], R], items: Sequence[A], jobs: int) -> Iterator[tuple[A, R]]:
    """Yield every item with its result, as they finish; in order for one job.

    Args:
        work: A module-level function. One job runs it in this process.
        items: Its arguments; pickled for other processes.
        jobs: Processes, one thread each.

    Raises:
        The first exception of ``work``; queued items are cancelled.
    """
    if jobs <= 1:
        for item in items:
            yield item, work(item)
        return
    with thread_environment(1):
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(min(jobs, len(items) or 1), context, ignore_interrupts)
        try:
            futures = {pool.submit(work, item): item for item in items}
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            for process in list((pool._processes or {}).values()):
                process.terminate()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()
