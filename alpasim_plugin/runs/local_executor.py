"""Rollouts in worker processes of this machine.

A worker does one job at a time, and this process knows which: a worker that dies costs its own job
and no other. One that has called parts of the user's does jobs of the same parts alone from then
on, since a part may change its process: the folder, a library, what is open.
"""

import faulthandler
import multiprocessing
import os
import pickle
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from multiprocessing.reduction import ForkingPickler
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, Generic, TypeVar

from alpasim_plugin.alpasim.client.child import end_children
from alpasim_plugin.core.errors import InfrastructureError, InternalError, SimrunError
from alpasim_plugin.core.garbage import collect_seldom
from alpasim_plugin.core.parts.blame import Culprit, Note, note_in
from alpasim_plugin.core.parts.patches import watch_code
from alpasim_plugin.core.printing import warn
from alpasim_plugin.core.subprocesses import (
    end_descendants,
    end_group,
    end_orphans,
    end_with_parent,
    forget_safe_path,
    lead_group,
    parent_of,
    safe_path,
)
from alpasim_plugin.runs.forked_from import VARIABLE

J = TypeVar("J")
R = TypeVar("R")

OVERTIME_S = 3.0  # after the time limit, for a worker to end by itself
POLL_S = 0.5  # the end of a worker goes unnoticed where a copy of it holds its pipe
UNREACHABLE = 74  # exit code of a worker that cannot hand over its result (EX_IOERR)
LAST = -1_000  # priority of what is done at the end of a worker, after everything else
LEAVE_S = 10.0  # for idle workers, to end the commands that they have started
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
# Loaded once, by the process that workers are forked from.
PRELOAD = (
    "alpasim_plugin.runs.forked_from",
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
    """Stands for the result of a job whose worker died, or was ended.

    Attributes:
        reason: What became of the worker.
        hint: What to do about it.
        culprit: The user's part that it called, where that explains it.
        hung_s: How long the call of that part had not returned.
        is_late: Whether it was ended at the time limit.
        may_be_chance: Whether another try, alone, may end otherwise.
    """

    reason: str
    hint: str
    culprit: Culprit | None = None
    hung_s: float = 0.0
    is_late: bool = False
    may_be_chance: bool = False

    def error(self, name: str) -> SimrunError:
        """Return the error of the part that explains it, else that of the machine.

        Args:
            name: What was done.
        """
        if self.culprit is not None:
            return self.culprit.error(self.reason)
        return InfrastructureError(f"{name}: {self.reason}", self.hint)


def run_jobs(
    work: Callable[[J], R],
    jobs: Sequence[J],
    workers: int,
    threads: int = 1,
    limit_s: float | None = None,
    stored_result: Callable[[J], R | None] = lambda job: None,
    parts_of: Callable[[J], str] = lambda job: "",
    channel_of: Callable[[J], str] = lambda job: "",
) -> Iterator[tuple[J, R | Lost]]:
    """Yield every job with its result, as they finish; results do not depend on the workers.

    A job whose worker died is done again, alone, unless a part of the user's explains the death.

    Args:
        work: A module-level function, or a partial of one; pickled.
        jobs: Its arguments; pickled.
        workers: Processes. One, without a time limit and without parts of the user's, is this
            process.
        threads: Threads of each worker, for numerical libraries.
        limit_s: Seconds that one job may take before its worker is ended; None: no limit.
        stored_result: Returns the result of a job whose worker died, if it was finished before.
        parts_of: Names the parts of the user's that a job calls; empty where it calls none.
        channel_of: Names what a job has for itself: jobs of the same one are done one at a time;
            empty where it has nothing.

    Raises:
        The first exception of ``work``; what still runs is ended.
    """
    if workers == 1 and limit_s is None and not any(parts_of(job) for job in jobs):
        for job in jobs:
            yield job, work(job)
        return
    victims = []
    with _opened(_Pool(work, workers, threads, limit_s, parts_of, channel_of)) as pool:
        for job, result in pool.results(jobs):
            if isinstance(result, Lost) and result.may_be_chance:
                victims.append(job)
            else:
                yield job, result
        if victims:
            warn(f"warning: a worker process ended; {len(victims)} jobs run again, one at a time")
        pool.workers = 1
        for job in victims:
            before = stored_result(job)
            if before is None:
                yield from pool.results([job])
            else:
                yield job, before


def apart(
    work: Callable[[J], R], job: J, parts: str, threads: int, limit_s: float | None = None
) -> R:
    """Do one job in a process of its own where it calls parts of the user's, else in this one.

    Args:
        work: As in `run_jobs`.
        job: Its argument.
        parts: Names the parts of the user's that it calls; empty where it calls none.
        threads: For numerical libraries.
        limit_s: Seconds that it may take where it calls parts of the user's.

    Raises:
        The exception of ``work``.
        SimrunError: The process ended: the error of the part that explains it, else an
            `InfrastructureError`.
    """
    if not parts:
        return work(job)
    ((_, result),) = run_jobs(work, [job], 1, threads, limit_s, parts_of=lambda job: parts)
    if isinstance(result, Lost):
        raise result.error(parts)
    return result


_starting = threading.Lock()  # while a worker is started, it is no orphan
_running: set[int] = set()  # workers of this process


class _Worker:
    """A process that does one job at a time.

    Args:
        threads: Of numerical libraries.
        note: File in which it notes which part it calls.

    Attributes:
        parts: The user's parts that it has called; empty where it has called none.
        connection: Jobs go there, results come back.
        job: What it does, or did last.
    """

    def __init__(self, threads: int, note: Path) -> None:
        self.parts = ""
        self.job: Any = None
        self._note = Note(note)
        self._began_s = 0.0
        context = _context(threads)
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, note))  # type: ignore[attr-defined]
        with _starting, _environment(threads):
            self._process.start()
            _running.add(self._process.pid)
        theirs.close()
        self._forked_from = parent_of(self._process.pid)

    def give(self, work: Callable[[Any], Any], job: Any, limit_s: float | None, parts: str) -> None:
        """Hand over a job."""
        self.job = job
        self.parts = self.parts or parts
        self._began_s = time.monotonic()
        self._note.clear()
        message = ForkingPickler.dumps((work, job, limit_s))
        with suppress(OSError):  # it has died already, which is found out when its result is taken
            self.connection.send_bytes(message)

    @property
    def handles(self) -> list[Any]:
        """Give what becomes ready when there is a result, or when the process ends."""
        return [self.connection, self._process.sentinel]

    def is_late(self, limit_s: float | None) -> bool:
        """Tell whether it should have ended itself at the time limit."""
        return limit_s is not None and time.monotonic() - self._began_s > limit_s + OVERTIME_S

    def is_done(self, limit_s: float | None) -> bool:
        """Tell whether there is something to `take`."""
        return self.connection.poll() or not self._process.is_alive() or self.is_late(limit_s)

    def take(self, limit_s: float | None) -> Any:
        """Return the result of the job; `Lost` where there is none.

        Raises:
            The exception of the work.
        """
        try:
            if self.connection.poll():
                is_result, result = pickle.loads(self.connection.recv_bytes())
                if is_result:
                    return result
                raise result
        except (EOFError, ConnectionError):
            pass
        return self._lost(limit_s)

    def _lost(self, limit_s: float | None) -> Lost:
        """End the process and say what became of it."""
        spent_s = time.monotonic() - self._began_s
        is_late = limit_s is not None and spent_s >= limit_s
        self._process.join(0.0 if self.is_late(limit_s) else POLL_S)
        code = self._process.exitcode
        self.end()
        culprit = self._note.read()
        if culprit is not None and not culprit.is_at_work and (is_late or code == -signal.SIGKILL):
            culprit = None  # it had returned: something else took the time, or the memory
        hung_s = 0.0
        if culprit is not None and culprit.is_at_work:
            hung_s = time.monotonic() - culprit.since_s
        if is_late:
            reason = f"it did not finish within {limit_s:g} s"
            return Lost(reason, "find out what hangs, or raise --time-limit", culprit, hung_s, True)
        reason = "its process closed its files"
        if code == UNREACHABLE:
            code = None
        if code is not None and code < 0:
            reason = f"its process was ended by {signal.Signals(-code).name}"
        elif code is not None:
            reason = f"its process ended with exit code {code}"
        may_be_chance = culprit is None or code == -signal.SIGKILL
        hint = "look for the out-of-memory killer in the system log, or use fewer --workers"
        return Lost(reason, hint, culprit, hung_s, False, may_be_chance)

    def dismiss(self) -> None:
        """Let the process end: there are no more jobs for it."""
        self.connection.close()

    def left_within(self, seconds: float) -> bool:
        """Tell whether the process ends within a time."""
        self._process.join(max(seconds, 0.0))
        if self._process.exitcode is None:
            return False
        self._end_group()
        return True

    def end(self) -> None:
        """End the process, whatever it does, and what parts have started in it: a stopped process
        heeds no other signal.
        """
        self._process.kill()
        self._process.join()
        self._end_group()
        self.connection.close()

    def _end_group(self) -> None:
        """End what parts have started in the process and left behind."""
        end_group(self._process.pid)
        with _starting:
            _running.discard(self._process.pid)
            if self._forked_from not in (None, os.getpid()):
                end_orphans(self._forked_from, _running)


class _Pool(Generic[J, R]):
    """Workers, started when there are jobs for them; the arguments are those of `run_jobs`.

    Attributes:
        workers: Most jobs at a time.
    """

    def __init__(
        self,
        work: Callable[[J], R],
        workers: int,
        threads: int,
        limit_s: float | None,
        parts_of: Callable[[J], str],
        channel_of: Callable[[J], str],
    ) -> None:
        self.workers = workers
        self._work = work
        self._threads = threads
        self._limit_s = limit_s
        self._parts_of = parts_of
        self._channel_of = channel_of
        self._notes = tempfile.TemporaryDirectory(prefix="simrun-workers-")
        self._busy: list[_Worker] = []
        self._idle: list[_Worker] = []
        self._leaving: list[_Worker] = []
        self._started = 0

    def results(self, jobs: Sequence[J]) -> Iterator[tuple[J, R | Lost]]:
        """Yield every job with its result, as they finish.

        Raises:
            The first exception of the work.
        """
        waiting = deque(jobs)
        while waiting or self._busy:
            while len(self._busy) < self.workers and (startable := self._startable(waiting)):
                self._begin(waiting, startable)
            wait([handle for worker in self._busy for handle in worker.handles], POLL_S)
            for worker in [worker for worker in self._busy if worker.is_done(self._limit_s)]:
                result = worker.take(self._limit_s)
                self._busy.remove(worker)
                if not isinstance(result, Lost):
                    self._idle.append(worker)
                yield worker.job, result

    def _startable(self, waiting: Sequence[J]) -> Sequence[int]:
        """Return which jobs may begin now: those of a channel that no worker uses."""
        used = {self._channel_of(worker.job) for worker in self._busy} - {""}
        if not used:
            return range(len(waiting))
        return [n for n, job in enumerate(waiting) if self._channel_of(job) not in used]

    def _begin(self, waiting: deque[J], startable: Sequence[int]) -> None:
        """Hand the next job to a worker that may do it, a new one where there is none.

        Args:
            waiting: The jobs.
            startable: Which of them may begin, at least one.
        """
        worker = None
        number = startable[0]
        while self._idle and worker is None:
            worker = self._idle.pop()
            fitting = [n for n in startable if self._may_do(worker, waiting[n])]
            if fitting:
                number = fitting[0]
            else:
                worker.dismiss()
                self._leaving.append(worker)
                worker = None
        if worker is None:
            self._started += 1
            worker = _Worker(self._threads, Path(self._notes.name, str(self._started)))
        job = waiting[number]
        del waiting[number]
        self._busy.append(worker)
        worker.give(self._work, job, self._limit_s, self._parts_of(job))

    def _may_do(self, worker: _Worker, job: J) -> bool:
        return worker.parts in ("", self._parts_of(job))

    def close(self) -> None:
        """Let all workers end, and end those that do not."""
        for worker in self._idle:
            worker.dismiss()
        until_s = time.monotonic() + LEAVE_S
        for worker in [*self._leaving, *self._idle]:
            if not worker.left_within(until_s - time.monotonic()):
                worker.end()
        self._notes.cleanup()

    def end(self) -> None:
        """End all workers."""
        for worker in [*self._leaving, *self._idle, *self._busy]:
            worker.end()
        self._notes.cleanup()


@contextmanager
def _opened(pool: _Pool[J, R]) -> Iterator[_Pool[J, R]]:
    """Close a pool after the block; when the block raises, or is left early, end its workers."""
    try:
        yield pool
    except BaseException:
        pool.end()
        raise
    pool.close()


_server_threads: list[int] = []  # of the process that workers are forked from, once it runs


def prepare_workers(threads: int) -> None:
    """Start to load what workers need, while this process does something else."""
    if _context(threads).get_start_method() == "forkserver":
        with _environment(threads):
            forkserver.ensure_running()


def _context(threads: int) -> BaseContext:
    """Return how workers begin: forked from a process that has loaded what rollouts need; anew
    where that process has libraries with another number of threads.
    """
    if sys.platform != "linux" or _server_threads not in ([], [threads]):
        return multiprocessing.get_context("spawn")
    _server_threads[:] = [threads]
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(PRELOAD))
    return context


@contextmanager
def _environment(threads: int) -> Iterator[None]:
    """Set what a process that is started in the block reads first: the number of threads, and that
    nothing is imported from the working directory.
    """
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    before[VARIABLE] = os.environ.get(VARIABLE)
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)), **{VARIABLE: "1"})
    try:
        with safe_path():
            yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def limited(work: Callable[[J], R], job: J, limit_s: float | None) -> R:
    """Do a job; at the time limit the worker prints where it hangs and ends."""
    if limit_s is None:
        return work(job)
    faulthandler.dump_traceback_later(limit_s, exit=True)
    try:
        return work(job)
    finally:
        faulthandler.cancel_dump_traceback_later()


def _serve(connection: Connection, note: Path) -> None:
    """Do the jobs of a worker until there are no more. It ignores Ctrl-C, which the parent handles,
    and ends with its parent.
    """
    forget_safe_path()
    collect_seldom()
    lead_group()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    note_in(note)
    watch_code()
    folder = os.getcwd()
    process = os.getpid()
    while True:
        try:
            task = connection.recv_bytes()
        except (EOFError, OSError):
            break
        os.chdir(folder)
        try:
            work, job, limit_s = pickle.loads(task)
            message = ForkingPickler.dumps((True, limited(work, job, limit_s)))
        except BaseException as error:
            message = ForkingPickler.dumps((False, _sendable(error)))
        if os.getpid() != process:
            os._exit(1)
        try:
            connection.send_bytes(message)
        except OSError:  # the part has closed the connection too
            os._exit(UNREACHABLE)
    end_children()
    end_descendants()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    # What multiprocessing has noted goes first, such as named semaphores, which the system keeps
    # otherwise; and a thread that a part has started does not keep the process.
    Finalize(None, os._exit, args=(0,), exitpriority=LAST)


def _sendable(error: BaseException) -> Exception:
    """Return an error with its traceback, as it can be pickled."""
    if not isinstance(error, Exception):
        error = InternalError.of(error, "a worker")
    error.add_note("".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # an error of the user's may be anything
        plain = RuntimeError(f"{type(error).__name__}: {error}")
        plain.add_note("".join(traceback.format_exception(error)))
        return plain
    return error
