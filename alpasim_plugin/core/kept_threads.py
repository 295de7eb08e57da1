"""Threads that the main thread keeps from call to call, and that end with the command."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

_pools: dict[int, ThreadPoolExecutor] = {}  # by their number of threads


def kept_pool(threads: int) -> ThreadPoolExecutor:
    """Return the pool of so many threads, which lives until `end_kept_threads`; for the main thread
    alone.
    """
    if threads not in _pools:
        _pools[threads] = ThreadPoolExecutor(threads, thread_name_prefix="kept")
    return _pools[threads]


def end_kept_threads() -> None:
    """End all kept threads, when what they still do is done; later calls start new ones."""
    for pool in _pools.values():
        pool.shutdown()
    _pools.clear()


# A forked process has the pools of its parent, but not their threads.
os.register_at_fork(after_in_child=_pools.clear)
