"""The executor ``local``: this process for one worker, spawned processes for more."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

from alpasim_plugin.runtime.executors.base import nothing_known
from alpasim_plugin.runtime.workers import Lost, in_workers

A = TypeVar("A")
R = TypeVar("R")

AFTER_HANGING = "look at what hangs with --workers 1, or raise --time-limit"
AFTER_DYING = "look for the out-of-memory killer in the system log, or use --workers 1"


def run_local(
    work: Callable[[A], R],
    items: Sequence[A],
    workers: int,
    threads: int,
    limit_s: float | None = None,
    recall: Callable[[A], R | None] = nothing_known,
) -> Iterator[tuple[A, R | Lost]]:
    """Yield every item with its result, as they finish.

    An item whose worker died runs again at the end, alone: it may have been the victim of another's memory.

    Args:
        work: A module-level function.
        items: Its arguments; pickled for more than one worker.
        workers: Number of processes. One without a time limit is this process.
        threads: Threads of each.
        limit_s: Seconds that one item may take.
        recall: Returns the result of an item whose worker died, if it was finished before.

    Raises:
        The first exception of ``work``; what still runs is ended.
    """
    if workers == 1 and limit_s is None:
        for item in items:
            yield item, work(item)
        return
    victims: list[A] = []
    for item, got in in_workers(work, items, workers, threads, limit_s):
        if not isinstance(got, Lost):
            yield item, got
        elif got.hung:
            yield item, replace(got, do_this=AFTER_HANGING)
        else:
            victims.append(item)
    for item in victims:
        known = recall(item)
        if known is not None:
            yield item, known
            continue
        for _, got in in_workers(work, [item], 1, threads, limit_s):
            yield item, _final(got) if isinstance(got, Lost) else got


def _final(lost: Lost) -> Lost:
    if lost.hung:
        return replace(lost, do_this=AFTER_HANGING)
    return Lost(f"{lost.found}, twice, without an error message", do_this=AFTER_DYING)
