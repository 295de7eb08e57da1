"""Work in processes of our own: the parent knows which worker has which item, so a worker that dies or hangs costs only that item.

Parent and worker talk over one pipe each. There is nothing else to share, so nothing is left behind when both are killed at once.
"""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Generic, TypeVar

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.process.subprocesses import end_with_parent, spawn_context

A = TypeVar("A")
R = TypeVar("R")

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
READY = "ready"
GRACE_S = 5.0  # between asking a worker to end and ending it


@dataclass(frozen=True)
class Lost:
    """An item without a result.

    Attributes:
        found: What became of its worker.
        hung: It was ended because it exceeded the time limit.
        do_this: One action that would help; empty where the caller knows better.
    """

    found: str
    hung: bool = False
    do_this: str = ""


@dataclass
class _Worker(Generic[A]):
    process: SpawnProcess
    pipe: Connection
    ready: bool = False
    item: A | None = None
    since_s: float = 0.0


def in_workers(
    work: Callable[[A], R], items: Sequence[A], workers: int, threads: int, limit_s: float | None = None
) -> Iterator[tuple[A, R | Lost]]:
    """Yield every item with its result, as they finish.

    Workers end with this process, however it ends. Call it from the main thread: Linux takes the end of the thread that started a worker
    for the end of its parent.

    Args:
        work: A module-level function.
        items: Its arguments; pickled.
        workers: Number of processes.
        threads: Threads of each, for numerical libraries.
        limit_s: Seconds that one item may take before its worker is killed; None: no limit.

    Raises:
        The first exception of ``work``; what still runs is ended.
    """
    todo, crew = deque(items), list[_Worker[A]]()
    try:
        while todo or any(one.item is not None for one in crew):
            idle = [one for one in crew if one.item is None]
            for _ in range(min(workers - len(crew), len(todo) - len(idle))):
                crew.append(_start(work, threads))
            for one in crew:
                if one.ready and one.item is None and todo:
                    _hand(one, todo)
            for one in _heard(crew, limit_s):
                got = _receive(one)
                if got == READY:
                    one.ready = True
                    continue
                item, one.item = one.item, None
                if isinstance(got, Lost):
                    crew.remove(one)
                    if item is None and todo:
                        item = todo.popleft()  # a worker that cannot start costs an item, so that it is not started for ever
                elif isinstance(got, Exception):
                    raise got
                if item is not None:
                    yield item, got.value if isinstance(got, _Result) else got
            now = time.monotonic()
            for one in [w for w in crew if limit_s is not None and w.item is not None and now - w.since_s > limit_s]:
                crew.remove(one)
                _kill(one)
                assert one.item is not None
                yield one.item, Lost(f"it did not finish within {limit_s:g} s", hung=True)
    finally:
        _dismiss(crew)


@dataclass(frozen=True)
class _Result:
    value: Any


def _start(work: Callable[[A], R], threads: int) -> _Worker[A]:
    context = spawn_context()
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, work), daemon=False)
    with thread_environment(threads):
        process.start()
    theirs.close()  # so that the pipe ends when the worker does
    return _Worker(process, ours)


def _hand(one: _Worker[A], todo: deque[A]) -> None:
    try:
        one.pipe.send(todo[0])
    except OSError:
        return  # it is gone: its pipe says so next
    one.item, one.since_s = todo.popleft(), time.monotonic()


def _heard(crew: Sequence[_Worker[A]], limit_s: float | None) -> list[_Worker[A]]:
    """Wait until workers say something, end, or run out of time; return those that said something or ended."""
    busy = [one.since_s for one in crew if one.item is not None]
    timeout = None if limit_s is None or not busy else max(0.0, min(busy) + limit_s - time.monotonic()) + 0.01
    heard = wait([one.pipe for one in crew], timeout)
    return [one for one in crew if one.pipe in heard]


def _receive(one: _Worker[A]) -> Any:
    try:
        return one.pipe.recv()
    except (EOFError, OSError):
        one.process.join(GRACE_S)
        return Lost(f"its worker process ended ({_fate(one.process.exitcode)})")


def _fate(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name if -code in [int(one) for one in signal.Signals] else f"signal {-code}"
        return f"killed by {name}"
    return "its pipe broke" if code is None else f"exit code {code}"


def _kill(one: _Worker[A]) -> None:
    one.process.kill()
    one.process.join()
    one.pipe.close()


def _dismiss(crew: Sequence[_Worker[A]]) -> None:
    """End all workers: idle ones by closing their pipes, busy ones by signal."""
    for one in crew:
        one.pipe.close()
        if one.item is not None or not one.ready:
            one.process.terminate()
    end_s = time.monotonic() + GRACE_S
    for one in crew:
        one.process.join(max(0.0, end_s - time.monotonic()))
        if one.process.is_alive():
            one.process.kill()
            one.process.join()


def _serve(pipe: Connection, work: Callable[[A], R]) -> None:
    """Answer items until the pipe ends; the main function of a worker."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole process group, and the parent handles it
    pipe.send(READY)
    while True:
        try:
            item = pipe.recv()
        except EOFError:
            return
        answer: Any
        try:
            answer = _Result(work(item))
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = error
        try:
            pipe.send(answer)
        except BrokenPipeError:
            return
        except Exception as error:  # what cannot be pickled
            found = f"{type(answer).__name__} cannot be sent to the parent: {error}"
            pipe.send(InfrastructureError("working in a process", getattr(work, "__name__", "a function"), found, "report it"))


@contextmanager
def thread_environment(threads: int) -> Iterator[None]:
    """Set the thread variables that numerical libraries read when a worker imports them."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
