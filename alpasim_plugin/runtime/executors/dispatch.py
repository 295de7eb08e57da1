"""Give items to the workers of a pool, wherever they are: lost ones again elsewhere, short ones in chunks, late ones twice.

This is all of the policy; a pool (`Pool`) only starts workers, hands them items and says what became of them. Items without a result stay
with the driver, and a worker gets the next ones only when the results of its last ones were taken, so nothing piles up.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Generic, Protocol, TypeVar

from alpasim_plugin.runtime.executors.base import Faulty
from alpasim_plugin.runtime.workers import Lost

A = TypeVar("A")
R = TypeVar("R")
A_contra = TypeVar("A_contra", contravariant=True)

MOST_LOSSES = 3  # an item that its worker died of so often is given up
STRIKES = 3  # so many failures in a row on one node, while others work, set it aside
MOST_ITEMS = 64  # in a chunk
ELSEWHERE_S = 30.0  # that a lost item waits for a node that has not failed it
LATE_FACTOR, LATE_S = 3.0, 10.0  # late: slower than three times the median, and by more than this


@dataclass(frozen=True)
class Place:
    """A free worker, and the node that it is on (empty where nobody knows before the work is done)."""

    worker: int
    node: str


@dataclass(frozen=True)
class Done:
    """A worker has answered: one answer per item, an exception where the work raised."""

    worker: int
    node: str
    answers: Sequence[Any]


@dataclass(frozen=True)
class Died:
    """A worker is gone. ``of_node``: with its node, so that its items are not to blame."""

    worker: int
    node: str
    found: str
    of_node: bool = False


Event = Done | Died


class Pool(Protocol[A_contra]):
    """Workers somewhere."""

    chunk_s: float  # how long a chunk should take: long against the time to hand it over

    def inherited(self, items: Sequence[A_contra]) -> Iterable[tuple[int, Any]]:
        """Yield index and result of items that the workers of an earlier driver have done."""
        ...

    def free(self) -> Sequence[Place]:
        """Start workers where there is room and return those without work.

        Raises:
            InfrastructureError: Every node was refused.
        """
        ...

    def start(self, worker: int, items: Sequence[A_contra]) -> None:
        """Hand items to a free worker."""
        ...

    def wait(self, timeout_s: float) -> Sequence[Event]:
        """Wait until workers answer or end, at most ``timeout_s`` seconds."""
        ...

    def end(self, worker: int) -> None:
        """End a worker and what it does, without an event."""
        ...

    def nodes(self) -> frozenset[str]:
        """Return the nodes that are in use."""
        ...

    def set_aside(self, node: str, why: str) -> None:
        """Use a node no more, and say why; what runs there ends with a `Died` of the node."""
        ...


@dataclass
class _Unit:
    items: tuple[int, ...]  # indices
    node: str
    since_s: float


@dataclass
class _Books(Generic[A, R]):
    """Who has what."""

    items: Sequence[A]
    todo: deque[int]
    again: deque[int] = field(default_factory=deque)  # lost once: handed out first, and singly
    running: dict[int, _Unit] = field(default_factory=dict)  # worker -> unit
    done: set[int] = field(default_factory=set)
    losses: Counter[int] = field(default_factory=Counter)
    tried: dict[int, set[str]] = field(default_factory=dict)  # item -> nodes that failed it
    lost_s: dict[int, float] = field(default_factory=dict)  # item -> when it was lost last
    copied: bool = False  # whether anything was ever handed out twice
    good: set[str] = field(default_factory=set)  # nodes that have given a result
    strikes: Counter[str] = field(default_factory=Counter)
    took_s: deque[float] = field(default_factory=lambda: deque(maxlen=201))  # per item

    def copies(self, index: int) -> int:
        return sum(index in unit.items for unit in self.running.values())


def dispatch(
    pool: Pool[A],
    items: Sequence[A],
    noticed: Callable[[str], None],
    limit_s: float | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[tuple[A, R | Lost]]:
    """Yield every item with its result, as they finish. The pool is the caller's to close.

    Args:
        pool: The workers.
        items: What is to be done.
        noticed: Called with a line for whatever a person should know.
        limit_s: Seconds that one item may take before its worker is ended; None: no limit.
        clock: Seconds of this process; no clock of any other machine is asked.

    Raises:
        The first exception of the work.
        InfrastructureError: No node accepts the work.
    """
    books: _Books[A, R] = _Books(items, deque(range(len(items))))
    for index, known in pool.inherited(items):
        books.done.add(index)
        yield items[index], known
    books.todo = deque(index for index in books.todo if index not in books.done)
    while len(books.done) < len(items):
        for place in pool.free():
            chosen = _choose(books, pool, place, clock(), limit_s)
            if chosen:
                books.running[place.worker] = _Unit(chosen, place.node, clock())
                pool.start(place.worker, [items[i] for i in chosen])
        for event in pool.wait(_patience_s(books, clock(), limit_s)):
            unit = books.running.pop(event.worker, None)
            if unit is None:
                if isinstance(event, Died):
                    _strike(books, pool, event.node, event.found)  # it could not even start
                continue
            if isinstance(event, Done):
                books.took_s.append((clock() - unit.since_s) / len(unit.items))
                finished = _take(books, pool, unit, event, clock())
            else:
                finished = _bury(books, pool, unit, event, noticed, clock())
            for index, got in finished:
                books.done.add(index)
                yield items[index], got
            if books.copied:
                _call_off(books, pool)
        for worker, unit in list(books.running.items()):
            if limit_s is not None and clock() - unit.since_s > limit_s * len(unit.items):
                pool.end(worker)
                del books.running[worker]
                for index in unit.items:
                    if index in books.done:
                        continue
                    if len(unit.items) > 1:
                        books.again.append(index)
                        continue
                    books.done.add(index)
                    yield items[index], Lost(f"it did not finish within {limit_s:g} s", True, "look at what hangs, or raise --time-limit")


def _choose(books: _Books[A, R], pool: Pool[A], place: Place, now_s: float, limit_s: float | None) -> tuple[int, ...]:
    """Return what a free worker is to do: a lost item that failed elsewhere, new items, or the copy of a late one."""
    nodes = pool.nodes()
    for index in list(books.again):
        if index in books.done:
            books.again.remove(index)
        elif _suits(books, index, place.node, nodes, now_s):
            books.again.remove(index)
            return (index,)
    if books.todo:
        return tuple(books.todo.popleft() for _ in range(_chunk(books, pool, limit_s)))
    return _late(books, place, nodes, now_s)


def _suits(books: _Books[A, R], index: int, node: str, nodes: frozenset[str], now_s: float) -> bool:
    """Tell whether a lost item may go to a node: not to one that failed it, unless there is no other or none has come for a while."""
    tried = books.tried.get(index, set())
    return node not in tried or nodes <= tried or now_s - books.lost_s.get(index, now_s) > ELSEWHERE_S


def _chunk(books: _Books[A, R], pool: Pool[A], limit_s: float | None) -> int:
    """Return how many items make one unit: short ones are handed over together, the last ones singly so that all workers end together."""
    if not books.took_s:
        return 1
    wanted = pool.chunk_s / max(median(books.took_s), 1e-6)
    fair = len(books.todo) / (2 * (len(books.running) + 1))
    return max(1, min(int(wanted), math.ceil(fair), MOST_ITEMS, len(books.todo)))


def _late(books: _Books[A, R], place: Place, nodes: frozenset[str], now_s: float) -> tuple[int, ...]:
    """Return a copy of the unit that is most overdue; on another node where there is one."""
    if not books.took_s:
        return ()
    usual_s = median(books.took_s)
    overdue = []
    for unit in books.running.values():
        if place.node and len(nodes) > 1 and unit.node == place.node:
            continue
        left = tuple(i for i in unit.items if i not in books.done and books.copies(i) < 2)
        late_s = now_s - unit.since_s - max(LATE_FACTOR * usual_s, usual_s + LATE_S) * len(unit.items)
        if left and late_s > 0:
            overdue.append((late_s, left))
    books.copied |= bool(overdue)
    return max(overdue)[1] if overdue else ()


def _patience_s(books: _Books[A, R], now_s: float, limit_s: float | None) -> float:
    """Return how long to wait for news: not beyond the next time limit, and never so long that new nodes go unseen."""
    if limit_s is None or not books.running:
        return 1.0
    due = min(unit.since_s + limit_s * len(unit.items) for unit in books.running.values())
    return min(1.0, max(0.0, due - now_s) + 0.01)


def _take(books: _Books[A, R], pool: Pool[A], unit: _Unit, event: Done, now_s: float) -> list[tuple[int, R | Lost]]:
    finished: list[tuple[int, R | Lost]] = []
    for index, answer in zip(unit.items, event.answers, strict=True):
        if index in books.done:
            continue
        if isinstance(answer, Exception):
            raise answer
        if not isinstance(answer, Faulty):
            books.strikes[event.node] = 0
            books.good.add(event.node)
            finished.append((index, answer))
            continue
        tried = books.tried.setdefault(index, set())
        tried.add(event.node)
        books.losses[index] += 1
        _strike(books, pool, event.node, answer.found)
        if pool.nodes() <= tried or books.losses[index] >= 2 * MOST_LOSSES:
            finished.append((index, answer.value))
        else:
            books.again.append(index)
            books.lost_s[index] = now_s
    return finished


def _bury(
    books: _Books[A, R], pool: Pool[A], unit: _Unit, event: Died, noticed: Callable[[str], None], now_s: float
) -> list[tuple[int, R | Lost]]:
    finished: list[tuple[int, R | Lost]] = []
    node = event.node or unit.node
    noticed(f"a worker on {node or 'a node'} was lost ({event.found}); its work is done again")
    if not event.of_node:
        _strike(books, pool, node, event.found)
    for index in unit.items:
        if index in books.done or books.copies(index):
            continue
        books.tried.setdefault(index, set()).add(node)
        if len(unit.items) == 1 and not event.of_node:  # of a chunk nobody knows which item it was
            books.losses[index] += 1
        if books.losses[index] >= MOST_LOSSES:
            where = ", ".join(sorted(books.tried[index] - {""})) or "its nodes"
            found = f"{event.found}; {MOST_LOSSES} workers died of it ({where})"
            finished.append((index, Lost(found, do_this="run it alone with --executor local --workers 1, and look at the memory it takes")))
        else:
            books.again.append(index)
            books.lost_s[index] = now_s
    return finished


def _strike(books: _Books[A, R], pool: Pool[A], node: str, found: str) -> None:
    """Count a failure of a node; several in a row set it aside where another gives results."""
    books.strikes[node] += 1
    if node and books.strikes[node] >= STRIKES and (pool.nodes() & books.good) - {node}:
        pool.set_aside(node, f"{STRIKES} failures in a row, the last: {found}")


def _call_off(books: _Books[A, R], pool: Pool[A]) -> None:
    """End workers that only do what is done."""
    for worker, unit in list(books.running.items()):
        if all(index in books.done for index in unit.items):
            pool.end(worker)
            del books.running[worker]
