"""Run one compiled function on several threads at once.

Kernels release the interpreter lock and share work through an atomic counter, so the same compiled code serves any number of threads, no
threading layer spins between frames, nothing is lost by a fork, and one thread costs nothing extra.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

from alpasim_plugin.core.errors import InputError

_pools: dict[int, ThreadPoolExecutor] = {}
_lock = threading.Lock()


def _forget_pools() -> None:
    """Drop pools after a fork: their threads live only in the parent."""
    global _lock
    _lock = threading.Lock()
    _pools.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pools)


def thread_count(threads: int | None) -> int:
    """Return how many threads to use: the argument, or numba's current setting.

    Raises:
        InputError: Fewer than one.
    """
    if threads is None:
        import numba

        return int(numba.get_num_threads())
    if threads < 1:
        raise InputError("rendering Gaussians", f"threads={threads}", "no thread to work with", "give at least 1, or None for the default")
    return threads


def run_on_threads(threads: int, function: Callable[..., None], *args: Any) -> None:
    """Call ``function(*args)`` on each of ``threads`` threads, this one included, and return when all have ended.

    An exception in any of them is raised here.
    """
    if threads == 1:
        function(*args)
        return
    with _lock:
        pool = _pools.get(threads)
        if pool is None:
            pool = _pools[threads] = ThreadPoolExecutor(threads - 1, thread_name_prefix="raster")
    others = [pool.submit(function, *args) for _ in range(threads - 1)]
    try:
        function(*args)
    finally:
        wait(others)
    for other in others:
        other.result()
