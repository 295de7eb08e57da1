"""Run dependent work in processes: each task as soon as those before it are done; results do not depend on the number of processes."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Protocol, TypeVar

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.process.subprocesses import end_with_parent, spawn_context
from alpasim_plugin.runtime.workers import GRACE_S, thread_environment

Say = Callable[[Any], None]


class Task(Protocol):
    """One piece of work; pickled for another process."""

    @property
    def name(self) -> str:
        """Unlike that of any other task."""
        ...

    @property
    def after(self) -> tuple[str, ...]:
        """Tasks that must be done before; names that no task has are done already."""
        ...


T = TypeVar("T", bound=Task)


@dataclass(frozen=True)
class _Running:
    name: str
    process: SpawnProcess
    pipe: Connection


def run_dependent(work: Callable[[T, Say], None], tasks: Sequence[T], jobs: int, heard: Callable[[str, Any], None]) -> None:
    """Do all tasks, each after those it depends on.

    One job does them in this process, in their order. Several have a process each, with one thread; all end with this one.

    Args:
        work: A module-level function; what it says is heard here.
        tasks: Every one behind those it depends on.
        jobs: Processes at a time.
        heard: Called with the name of a task and what its work said.

    Raises:
        InfrastructureError: A process ended before its work.
        ValueError: A task before one that it depends on.
        The first exception of ``work``; what still runs is ended.
    """
    _check_order(tasks)
    if jobs <= 1:
        for task in tasks:
            work(task, lambda said, name=task.name: heard(name, said))  # type: ignore[misc]
        return
    waiting, left, running = list(tasks), {task.name for task in tasks}, list[_Running]()
    try:
        while waiting or running:
            ready = [task for task in waiting if not left.intersection(task.after)][: jobs - len(running)]
            waiting = [task for task in waiting if task not in ready]
            running += [_start(work, task) for task in ready]
            for one in [one for one in running if one.pipe in wait([one.pipe for one in running])]:
                if _hear(one, heard):
                    running.remove(one)
                    left.discard(one.name)
    finally:
        _end(running)


def _check_order(tasks: Sequence[Task]) -> None:
    for i, task in enumerate(tasks):
        if early := {one.name for one in tasks[i:]}.intersection(task.after):
            raise ValueError(f"task {task.name} comes before {', '.join(sorted(early))}, which it depends on")


def _start(work: Callable[[T, Say], None], task: T) -> _Running:
    context = spawn_context()
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(theirs, work, task))
    with thread_environment(1):
        process.start()
    theirs.close()  # so that the pipe ends with the process
    return _Running(task.name, process, ours)


def _hear(one: _Running, heard: Callable[[str, Any], None]) -> bool:
    """Take one message; return whether the task is done."""
    try:
        kind, said = one.pipe.recv()
    except (EOFError, OSError) as error:
        one.process.join(GRACE_S)
        found = f"its process ended (exit code {one.process.exitcode})"
        do_this = "look for the out-of-memory killer in the system log, or use --jobs 1"
        raise InfrastructureError("working in several processes", one.name, found, do_this) from error
    if kind == "failed":
        raise said
    if kind == "said":
        heard(one.name, said)
        return False
    one.process.join()
    one.pipe.close()
    return True


def _end(running: Sequence[_Running]) -> None:
    for one in running:
        one.process.terminate()
    for one in running:
        one.process.join(GRACE_S)
        one.process.kill()
        one.pipe.close()


def _work(pipe: Connection, work: Callable[[T, Say], None], task: T) -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole process group, and the parent handles it
    try:
        work(task, lambda said: pipe.send(("said", said)))
        pipe.send(("done", None))
    except BrokenPipeError:
        return
    except Exception as error:
        error.add_note(traceback.format_exc())
        pipe.send(("failed", error))
