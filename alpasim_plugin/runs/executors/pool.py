"""The pool: give jobs to the workers of a backend, wherever they are: lost ones again elsewhere,
short ones in chunks, late ones twice.

This is all of the policy; a backend (`Backend`) only starts workers, hands them jobs and says what
became of them. Jobs without a result stay with the driver, and a worker gets the next ones only
when the results of its last ones were taken, so nothing piles up.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Generic, TypeVar

from alpasim_plugin.runs.executors.base import Backend, Died, Done, Event, Faulty, Lost, Place

J = TypeVar("J")
R = TypeVar("R")

STRIKES = 3  # so many failures in a row on one node, while others work, set it aside
MOST_JOBS = 64  # in a chunk
ELSEWHERE_S = 30.0  # that a lost job waits for a node that has not failed it
LATE_FACTOR, LATE_S = 3.0, 10.0  # late: slower than three times the median, and by more than this
LOOK_S = 1.0  # between looks at the workers, so that new nodes are seen


def run_jobs(
    backend: Backend[J],
    jobs: Sequence[J],
    notify: Callable[[str], None],
    limit_s: float | None = None,
    clock: Callable[[], float] = time.monotonic,
    after: Mapping[int, Collection[int]] | None = None,
) -> Iterator[tuple[J, R | Lost]]:
    """Yield every job with its result, as they finish. The backend is the caller's to close.

    Args:
        backend: The workers.
        jobs: What is to be done.
        notify: Called with a line for whatever a person should know.
        limit_s: Seconds that one job may take before its worker is ended; None: no limit.
        clock: Seconds of this process; no clock of any other machine is asked.
        after: Index of a job -> indices of the earlier jobs that must be done before it; jobs that
            are not named wait for none.

    Raises:
        The first exception of the work.
        InfrastructureError: No node accepts the work.
    """
    pool: _Pool[J, R] = _Pool(backend, jobs, notify, limit_s, clock, after or {})
    yield from pool.results()


@dataclass
class _Unit:
    jobs: tuple[int, ...]  # indices
    node: str
    since_s: float


class _Pool(Generic[J, R]):
    """Who has which jobs; arguments are those of `run_jobs`. Jobs are named by their index."""

    def __init__(
        self,
        backend: Backend[J],
        jobs: Sequence[J],
        notify: Callable[[str], None],
        limit_s: float | None,
        clock: Callable[[], float],
        after: Mapping[int, Collection[int]],
    ) -> None:
        self._backend, self._jobs, self._notify = backend, jobs, notify
        self._limit_s, self._clock, self._after = limit_s, clock, after
        self._rules = backend.rules
        self._todo = deque[int]()
        self._again = deque[int]()  # lost once: handed out first, and singly
        self._running: dict[int, _Unit] = {}  # worker -> unit
        self._done: set[int] = set()
        self._losses = Counter[int]()
        self._tried: dict[int, set[str]] = {}  # job -> nodes that failed it
        self._lost_s: dict[int, float] = {}  # job -> when it was lost last
        self._copied = False  # whether any job was ever handed out twice
        self._good: set[str] = set()  # nodes that have given a result
        self._strikes = Counter[str]()
        self._took_s = deque[float](maxlen=201)  # per job

    def results(self) -> Iterator[tuple[J, R | Lost]]:
        """Yield every job with its result."""
        for index, known in self._backend.inherited(self._jobs):
            self._done.add(index)
            yield self._jobs[index], known
        self._todo.extend(index for index in range(len(self._jobs)) if index not in self._done)
        while len(self._done) < len(self._jobs):
            self._hand_out()
            for event in self._backend.wait(self._patience_s()):
                yield from self._finish(self._take(event))
                if self._copied:
                    self._call_off()
            yield from self._finish(self._end_overdue())

    def _finish(self, found: Sequence[tuple[int, R | Lost]]) -> Iterator[tuple[J, R | Lost]]:
        for index, got in found:
            self._done.add(index)
            yield self._jobs[index], got

    def _hand_out(self) -> None:
        for place in self._backend.free(len(self._todo) + len(self._again)):
            chosen = self._choose(place)
            if chosen:
                self._running[place.worker] = _Unit(chosen, place.node, self._clock())
                self._backend.start(place.worker, [self._jobs[index] for index in chosen])

    def _choose(self, place: Place) -> tuple[int, ...]:
        """Return what a free worker is to do: a lost job that failed elsewhere, new jobs, or the
        copy of a late one.
        """
        for index in list(self._again):
            if index in self._done:
                self._again.remove(index)
            elif self._suits(index, place.node):
                self._again.remove(index)
                return (index,)
        if self._after:
            ready = (
                index for index in self._todo if self._done.issuperset(self._after.get(index, ()))
            )
            first = next(ready, None)
            if first is None:
                return ()
            self._todo.remove(first)
            return (first,)
        if self._todo:
            return tuple(self._todo.popleft() for _ in range(self._chunk()))
        return self._late(place) if self._rules.copies else ()

    def _suits(self, index: int, node: str) -> bool:
        """Tell whether a lost job may go to a node: not to one that failed it, unless there is no
        other or none has come for a while.
        """
        tried, now_s = self._tried.get(index, set()), self._clock()
        return (
            node not in tried
            or self._backend.nodes() <= tried
            or now_s - self._lost_s.get(index, now_s) > ELSEWHERE_S
        )

    def _chunk(self) -> int:
        """Return how many jobs make one unit: short ones go together, the last ones singly so that
        all workers end together.
        """
        if not self._took_s:
            return 1
        wanted = self._rules.chunk_s / max(median(self._took_s), 1e-6)
        fair = len(self._todo) / (2 * (len(self._running) + 1))
        return max(1, min(int(wanted), math.ceil(fair), MOST_JOBS, len(self._todo)))

    def _late(self, place: Place) -> tuple[int, ...]:
        """Return a copy of the unit that is most overdue; on another node where there is one."""
        if not self._took_s:
            return ()
        usual_s = median(self._took_s)
        now_s = self._clock()
        several = len(self._backend.nodes()) > 1
        overdue = []
        for unit in self._running.values():
            if place.node and several and unit.node == place.node:
                continue
            left = tuple(
                index for index in unit.jobs if index not in self._done and self._copies(index) < 2
            )
            late_s = (
                now_s - unit.since_s - max(LATE_FACTOR * usual_s, usual_s + LATE_S) * len(unit.jobs)
            )
            if left and late_s > 0:
                overdue.append((late_s, left))
        self._copied |= bool(overdue)
        return max(overdue)[1] if overdue else ()

    def _copies(self, index: int) -> int:
        return sum(index in unit.jobs for unit in self._running.values())

    def _patience_s(self) -> float:
        """Return how long to wait for news: not beyond the next time limit, and never so long that
        new nodes go unseen.
        """
        if self._limit_s is None or not self._running:
            return LOOK_S
        due_s = min(
            unit.since_s + self._limit_s * len(unit.jobs) for unit in self._running.values()
        )
        return min(LOOK_S, max(0.0, due_s - self._clock()) + 0.01)

    def _take(self, event: Event) -> list[tuple[int, R | Lost]]:
        """Return the jobs that an event finishes."""
        unit = self._running.pop(event.worker, None)
        if isinstance(event, Done):
            return [] if unit is None else self._answered(unit, event)
        if unit is not None:
            return self._lost(unit, event)
        self._strike(event.node, event.found)  # it could not even start
        if self._rules.most_losses == 1 and self._todo:
            return [
                (self._todo.popleft(), Lost(event.found))
            ]  # costs a job, so that it is not started for ever
        return []

    def _answered(self, unit: _Unit, event: Done) -> list[tuple[int, R | Lost]]:
        self._took_s.append((self._clock() - unit.since_s) / len(unit.jobs))
        finished: list[tuple[int, R | Lost]] = []
        for index, answer in zip(unit.jobs, event.answers, strict=True):
            if index in self._done:
                continue
            if isinstance(answer, Exception):
                raise answer
            if not isinstance(answer, Faulty):
                self._strikes[event.node] = 0
                self._good.add(event.node)
                finished.append((index, answer))
                continue
            self._losses[index] += 1
            self._strike(event.node, answer.found)
            tried = self._tried.setdefault(index, set()) | {event.node}
            if self._backend.nodes() <= tried or self._losses[index] >= 2 * self._rules.most_losses:
                finished.append((index, answer.value))
            else:
                self._try_again(index, event.node)
        return finished

    def _lost(self, unit: _Unit, event: Died) -> list[tuple[int, R | Lost]]:
        finished: list[tuple[int, R | Lost]] = []
        node = event.node or unit.node
        if not event.of_node:
            self._strike(node, event.found)
        left = [index for index in unit.jobs if index not in self._done and not self._copies(index)]
        for index in left:
            if (
                len(unit.jobs) == 1 and not event.of_node
            ):  # of a chunk nobody knows which job it was
                self._losses[index] += 1
            if self._losses[index] >= self._rules.most_losses:
                finished.append(
                    (
                        index,
                        Lost(
                            self._why_given_up(index, node, event.found),
                            do_this=self._rules.after_dying,
                        ),
                    )
                )
            else:
                self._try_again(index, node)
        if len(left) > len(finished):
            self._notify(
                f"a worker on {node or 'a node'} was lost ({event.found}); its work is done again"
            )
        return finished

    def _why_given_up(self, index: int, node: str, found: str) -> str:
        if self._rules.most_losses == 1:
            return found
        where = ", ".join(sorted((self._tried.get(index, set()) | {node}) - {""})) or "its nodes"
        return f"{found}; {self._rules.most_losses} workers died of it ({where})"

    def _try_again(self, index: int, node: str) -> None:
        self._tried.setdefault(index, set()).add(node)
        self._again.append(index)
        self._lost_s[index] = self._clock()

    def _strike(self, node: str, found: str) -> None:
        """Count a failure of a node; several in a row set it aside where another gives results."""
        self._strikes[node] += 1
        if (
            node
            and self._strikes[node] >= STRIKES
            and (self._backend.nodes() & self._good) - {node}
        ):
            self._backend.set_aside(node, f"{STRIKES} failures in a row, the last: {found}")

    def _call_off(self) -> None:
        """End workers that only do what is done."""
        for worker, unit in list(self._running.items()):
            if self._done.issuperset(unit.jobs):
                self._backend.end(worker)
                del self._running[worker]

    def _end_overdue(self) -> list[tuple[int, R | Lost]]:
        """End workers that exceeded the time limit; of a chunk each job is then tried alone."""
        finished: list[tuple[int, R | Lost]] = []
        for worker, unit in list(self._running.items()):
            if self._limit_s is None or self._clock() - unit.since_s <= self._limit_s * len(
                unit.jobs
            ):
                continue
            self._backend.end(worker)
            del self._running[worker]
            left = [index for index in unit.jobs if index not in self._done]
            if len(unit.jobs) > 1:
                self._again.extend(left)
                continue
            lost = Lost(
                f"it did not finish within {self._limit_s:g} s", True, self._rules.after_hanging
            )
            finished += [(index, lost) for index in left]
        return finished
