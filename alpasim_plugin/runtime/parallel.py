"""Run independent work in processes; results do not depend on their number."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.runtime.workers import Lost, in_workers

A = TypeVar("A")
R = TypeVar("R")


def parallel_map(work: Callable[[A], R], items: Sequence[A], jobs: int) -> Iterator[tuple[A, R]]:
    """Yield every item with its result, as they finish; in order for one job.

    Args:
        work: A module-level function. One job runs it in this process.
        items: Its arguments; pickled for other processes.
        jobs: Processes, one thread each.

    Raises:
        InfrastructureError: A process ended without a result.
        The first exception of ``work``; queued items are cancelled.
    """
    if jobs <= 1:
        for item in items:
            yield item, work(item)
        return
    for item, got in in_workers(work, items, jobs, threads=1):
        if isinstance(got, Lost):
            do_this = "look for the out-of-memory killer in the system log, or use --jobs 1"
            raise InfrastructureError("working in several processes", str(item), got.found, do_this)
        yield item, got
