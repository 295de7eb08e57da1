"""Workers that are processes of this machine: the pool's backend, and what runs jobs in them.

Parent and worker talk over one pipe each. There is nothing else to share, so nothing is left behind
when both are killed at once.
"""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, TypeVar

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.subprocesses import (
    copy_context,
    end_with_parent,
    load_for_copies,
    spawn_context,
)
from alpasim_plugin.runs.executors.base import (
    THREAD_VARIABLES,
    Backend,
    Died,
    Done,
    Event,
    Lost,
    Place,
    Rules,
)
from alpasim_plugin.runs.executors.pool import run_jobs

J = TypeVar("J")
R = TypeVar("R")
Send = Callable[[Any], None]

GRACE_S = 5.0  # between asking a worker to end and ending it
DYING = "look for the out-of-memory killer in the system log, or use"
AHEAD = "alpasim_plugin.runs.executors.ahead"  # loads what rollouts need
RULES = Rules(chunk_s=0.0, most_losses=1, copies=False, after_hanging="", after_dying="")


def run_in_processes(
    work: Callable[[J], R],
    jobs: Sequence[J],
    workers: int,
    threads: int = 1,
    limit_s: float | None = None,
) -> Iterator[tuple[J, R | Lost]]:
    """Yield every job with its result, as they finish; a worker that dies or hangs costs only its
    own job.

    Workers end with this process, however it ends. Call it from the main thread: Linux takes the
    end of the thread that started a worker for the end of its parent.

    Args:
        work: A module-level function.
        jobs: Its arguments; pickled.
        workers: Number of processes.
        threads: Threads of each, for numerical libraries.
        limit_s: Seconds that one job may take before its worker is killed; None: no limit.

    Raises:
        The first exception of ``work``; what still runs is ended.
    """
    backend: LocalBackend[J] = LocalBackend(work, workers, threads)
    with closing(backend):
        yield from run_jobs(backend, jobs, _ignore, limit_s)


def run_or_retry(
    work: Callable[[J], R],
    jobs: Sequence[J],
    workers: int,
    threads: int,
    limit_s: float | None,
    known: Callable[[J], R | None],
) -> Iterator[tuple[J, R | Lost]]:
    """Yield every job with its result, as they finish: in this process for one worker without a
    time limit.

    A job whose worker died runs again at the end, alone: it may have been the victim of another's
    memory.

    Args:
        work, jobs, workers, threads, limit_s: As for `run_in_processes`.
        known: Returns the result of a job whose worker died, if it was finished before.

    Raises:
        The first exception of ``work``; what still runs is ended.
    """
    if workers == 1 and limit_s is None:
        for job in jobs:
            yield job, work(job)
        return
    victims: list[J] = []
    for job, got in run_in_processes(work, jobs, workers, threads, limit_s):
        if isinstance(got, Lost) and not got.hung:
            victims.append(job)
        else:
            yield job, _advised(got)
    for job in victims:
        result = known(job)
        if result is not None:
            yield job, result
            continue
        for _, got in run_in_processes(work, [job], 1, threads, limit_s):
            yield job, _advised(got)


def _advised(got: R | Lost) -> R | Lost:
    if not isinstance(got, Lost):
        return got
    if got.hung:
        return replace(got, do_this="look at what hangs with --workers 1, or raise --time-limit")
    return Lost(f"{got.found}, twice, without an error message", do_this=f"{DYING} --workers 1")


def load_early() -> None:
    """Load what rollouts need, while this process finds out what to do: workers of one thread are
    then copies that have it.
    """
    with _thread_environment(1):
        load_for_copies([AHEAD])


def map_jobs(work: Callable[[J], R], jobs: Sequence[J], workers: int) -> Iterator[tuple[J, R]]:
    """Yield every job with its result, as they finish; in order for one worker. Results do not
    depend on the number of workers.

    Args:
        work: A module-level function. One worker is this process.
        jobs: Its arguments; pickled for other processes.
        workers: Processes, one thread each.

    Raises:
        InfrastructureError: A process ended without a result.
        The first exception of ``work``; jobs that wait are dropped.
    """
    if workers <= 1:
        for job in jobs:
            yield job, work(job)
        return
    for job, got in run_in_processes(work, jobs, workers):
        yield job, _kept(got, str(job))


class Task(Protocol):
    """A job that may depend on others; pickled for another process."""

    @property
    def name(self) -> str:
        """Unlike that of any other task."""
        ...

    @property
    def after(self) -> tuple[str, ...]:
        """Tasks that must be done before; names that no task has are done already."""
        ...


T = TypeVar("T", bound=Task)


def run_dependent(
    work: Callable[[T, Send], None],
    tasks: Sequence[T],
    workers: int,
    on_message: Callable[[str, Any], None],
) -> None:
    """Do all tasks, each after those it depends on; results do not depend on the number of workers.

    Args:
        work: A module-level function of a task and of what sends a message here.
        tasks: Every one behind those it depends on.
        workers: Processes, one thread each. One is this process, which does the tasks in their
            order.
        on_message: Called with the name of a task and what its work sent.

    Raises:
        InfrastructureError: A process ended before its work.
        ValueError: A task before one that it depends on.
        The first exception of ``work``; what still runs is ended.
    """
    after = _indices_before(tasks)
    if workers <= 1:
        for task in tasks:
            work(task, partial(on_message, task.name))
        return
    backend: LocalBackend[T] = LocalBackend(
        work, workers, 1, lambda task, message: on_message(task.name, message)
    )
    with closing(backend):
        for task, got in run_jobs(backend, tasks, _ignore, after=after):
            _kept(got, task.name)


def _indices_before(tasks: Sequence[Task]) -> dict[int, list[int]]:
    names = {task.name: index for index, task in enumerate(tasks)}
    after = {}
    for index, task in enumerate(tasks):
        before = [names[name] for name in task.after if name in names]
        if early := sorted(tasks[i].name for i in before if i >= index):
            raise ValueError(
                f"task {task.name} comes before {', '.join(early)}, which it depends on"
            )
        after[index] = before
    return after


def _kept(got: R | Lost, name: str) -> R:
    if isinstance(got, Lost):
        raise InfrastructureError(f"{name}: {got.found}", f"{DYING} --jobs 1")
    return got


def _ignore(text: str) -> None:
    """Say nothing: what is lost here is a result."""


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    ready: bool = False
    job: Any = None
    busy: bool = False
    reached: bool = True  # whether its job was sent


class LocalBackend(Backend[J]):
    """Processes of this machine; see `alpasim_plugin.runs.executors.base.Backend`.

    Args:
        work: A module-level function of a job; with ``on_message`` also of what sends a message.
        workers: Most processes.
        threads: Of each, for numerical libraries.
        on_message: Called with a job and what its work sent.
    """

    rules = RULES

    def __init__(
        self,
        work: Callable[..., Any],
        workers: int,
        threads: int,
        on_message: Callable[[J, Any], None] | None = None,
    ) -> None:
        self._work, self._most, self._threads, self._on_message = work, workers, threads, on_message
        self._workers: dict[int, _Worker] = {}
        self._next = 0

    def free(self, wanted: int) -> list[Place]:
        """Start as many workers as are wanted and allowed, and return those that are ready and
        idle.
        """
        idle = sum(not one.busy for one in self._workers.values())
        for _ in range(min(self._most - len(self._workers), wanted - idle)):
            self._open()
        return [
            Place(number, "") for number, one in self._workers.items() if one.ready and not one.busy
        ]

    def start(self, worker: int, jobs: Sequence[J]) -> None:
        """Hand one job to a free worker."""
        one = self._workers[worker]
        (one.job,), one.busy = jobs, True
        try:
            one.pipe.send(one.job)
        except OSError:
            one.reached = False  # it is gone: its pipe says so next

    def wait(self, timeout_s: float) -> list[Event]:
        """Wait until workers answer, send a message, or end."""
        pipes = {one.pipe: number for number, one in self._workers.items()}
        speaking = set(wait(list(pipes), timeout_s))
        events = [self._receive(number) for pipe, number in pipes.items() if pipe in speaking]
        return [event for event in events if event is not None]

    def end(self, worker: int) -> None:
        """Kill a worker."""
        one = self._workers.pop(worker)
        one.process.kill()
        one.process.join()
        one.pipe.close()

    def close(self) -> None:
        """End all workers: idle ones by closing their pipes, busy ones by signal."""
        for one in self._workers.values():
            one.pipe.close()
            if one.busy or not one.ready:
                one.process.terminate()
        end_s = time.monotonic() + GRACE_S
        for one in self._workers.values():
            one.process.join(max(0.0, end_s - time.monotonic()))
            if one.process.is_alive():
                one.process.kill()
                one.process.join()
        self._workers.clear()

    def _open(self) -> None:
        context = (copy_context() if self._threads == 1 else None) or spawn_context()
        ours, theirs = context.Pipe()
        process = context.Process(
            target=_serve, args=(theirs, self._work, self._on_message is not None), daemon=False
        )
        with _thread_environment(self._threads):
            process.start()
        theirs.close()  # so that the pipe ends when the worker does
        self._workers[self._next] = _Worker(process, ours)
        self._next += 1

    def _receive(self, number: int) -> Event | None:
        one = self._workers[number]
        try:
            kind, value = one.pipe.recv()
        except (EOFError, OSError):
            del self._workers[number]
            one.process.join(GRACE_S)
            return Died(
                number,
                "",
                f"its worker process ended ({_exit_reason(one.process.exitcode)})",
                of_node=not one.reached,
            )
        if kind == "ready":
            one.ready = True
        elif kind == "message" and self._on_message is not None:
            self._on_message(one.job, value)
        elif kind == "answer":
            one.job, one.busy = None, False
            return Done(number, "", [value])
        return None


def _exit_reason(code: int | None) -> str:
    if code is not None and code < 0:
        name = (
            signal.Signals(-code).name
            if -code in [int(one) for one in signal.Signals]
            else f"signal {-code}"
        )
        return f"killed by {name}"
    return "its pipe broke" if code is None else f"exit code {code}"


def _serve(pipe: Connection, work: Callable[..., Any], sends: bool) -> None:
    """Answer jobs until the pipe ends; the main function of a worker."""
    end_with_parent()
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches the whole process group, and the parent handles it
    more = [lambda message: pipe.send(("message", message))] if sends else []
    pipe.send(("ready", None))
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        try:
            answer: Any = work(job, *more)
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = error
        try:
            pipe.send(("answer", answer))
        except BrokenPipeError:
            return
        except Exception as error:  # what cannot be pickled
            found = f"{type(answer).__name__} cannot be sent to the parent: {error}"
            pipe.send(
                (
                    "answer",
                    InfrastructureError(
                        f"{getattr(work, '__name__', 'a function')}: {found}",
                        "report it",
                    ),
                )
            )


@contextmanager
def _thread_environment(threads: int) -> Iterator[None]:
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
