"""Workers on the nodes of a Ray cluster: one actor each, placed by us, so that a node that was
refused or set aside stays unused.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.runs.executors.assignment import Assignment, sweep
from alpasim_plugin.runs.executors.base import Backend, Died, Done, Event, Place, Rules
from alpasim_plugin.runs.executors.node import Serving

J = TypeVar("J")

DOING = "working on a Ray cluster"
LOOK_S = 1.0  # between looks at the nodes
BARREN_S = 60.0  # without any node before giving up
FAILED_STARTS = 3  # of workers on a node that never had one
START_S = 300.0  # for a worker to start, and again for it to compare versions and take the work
AGAIN_S = 2.0  # after a failed start
HELD_CONTENTS = (
    256  # references that the driver keeps, so that a scene is sent once for all its rollouts
)
SWEEP_S = 20.0  # that nodes may take to remove what killed workers left
GIB = 2**30
SAME_VERSIONS = "install the same versions on the nodes"
LOOK_THERE = (
    "look at Ray's logs and the file systems of these nodes, then give the same command again"
)


@dataclass
class _Worker:
    actor: Any
    node: str
    begun: Any  # answered when its process runs
    ref: Any  # what it is asked: to accept the work, or to do jobs; None: idle
    since_s: float  # when it was asked for, then when its process was seen to run
    has_begun: bool = False
    pid: int = 0
    ready: bool = False


@contextmanager
def connected(address: str | None) -> Iterator[None]:
    """Be connected to a Ray cluster during the block; one inside another stays with the outer's.

    Args:
        address: HOST:PORT of its head. None: the one that ``RAY_ADDRESS`` names or that runs on
            this machine; where there is none, one of this machine's cores is started for the block.

    Raises:
        InputError: Ray is not installed, or the address is that of a Ray client server.
        InfrastructureError: There is no cluster at the address, or it has another version of Ray or
            Python.
    """
    ray = require_library("ray", "--executor ray", "pip install 'alpasim-onefixer[ray]'")
    if address is not None and address.startswith("ray://"):
        raise InputError(
            f"--executor ray:{address}: a Ray client cannot place workers on nodes",
            "start simrun on a node of the cluster, with --executor ray",
        )
    if ray.is_initialized():
        with _signals_as_raised():
            yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    held = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    try:
        try:
            ray.init(address=address or "auto", **quiet)
        except ConnectionError:
            if address is not None:
                raise
            ray.init(
                address="local",
                num_cpus=len(os.sched_getaffinity(0)),
                include_dashboard=False,
                **quiet,
            )
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise InfrastructureError(
            f"{address or 'this machine'}: {error}",
            "start the cluster (ray start --head), or correct the address",
        ) from error
    finally:
        for (
            number,
            handler,
        ) in held.items():  # Ray puts its own in place, which would end the run without a word
            signal.signal(number, handler)
    try:
        with _signals_as_raised():
            yield
    finally:
        ray.shutdown()


@contextmanager
def _signals_as_raised() -> Iterator[None]:
    """Raise what a signal's handler has raised: out of Ray's compiled code it comes as the cause of
    a `SystemError`.
    """
    try:
        yield
    except SystemError as error:
        if error.__cause__ is None or isinstance(error.__cause__, Exception):
            raise
        raise error.__cause__ from None


class RayBackend(Backend[J]):
    """Workers on a Ray cluster; see `alpasim_plugin.runs.executors.base.Backend`.

    Args:
        assignment: What the workers do.
        start_s: Seconds for a worker to start, and again for it to be ready. A node that fails this
            without another worker is set aside.
    """

    rules = Rules(chunk_s=1.0)

    def __init__(self, assignment: Assignment[J], start_s: float = START_S) -> None:
        import ray

        self._ray, self._given, self._start_s = ray, assignment, start_s
        self._blob = ray.put(pickle.dumps(assignment.work))
        self._refs: OrderedDict[str, Any] = OrderedDict()
        self._workers: dict[int, _Worker] = {}
        self._next = 0
        self._events: list[Event] = []
        self._refused: dict[str, str] = {}  # node -> why
        self._do_this = SAME_VERSIONS  # against the last refusal
        self._pings: dict[
            str, tuple[Any, float]
        ] = {}  # node -> a process there that needs no core, when it was asked for
        self._accepted: set[str] = set()
        self._failed: dict[str, tuple[int, float]] = {}  # node -> failed starts, time of the last
        self._ended: dict[str, list[int]] = {}  # node -> processes that were killed
        self._ids: dict[str, str] = {}  # name -> Ray's id of living nodes
        self._usable: frozenset[str] = frozenset()  # living nodes with room for a worker
        self._looked_s = -LOOK_S
        self._alive_s = time.monotonic()

    def free(self, wanted: int) -> list[Place]:
        """Start workers where there is room and return those without work.

        Raises:
            InfrastructureError: Every node was refused, none has the resources, or none has been
                there for a minute.
        """
        if time.monotonic() - self._looked_s >= LOOK_S:
            self._look()
        return [
            Place(number, one.node)
            for number, one in self._workers.items()
            if one.ready and one.ref is None
        ]

    def start(self, worker: int, jobs: Sequence[J]) -> None:
        """Hand jobs to a free worker."""
        needed = dict.fromkeys(sha256 for job in jobs for sha256 in self._given.work.needs(job))
        refs = {sha256: self._reference(sha256) for sha256 in needed}
        one = self._workers[worker]
        one.ref = one.actor.do.remote(pickle.dumps(list(jobs)), refs)

    def wait(self, timeout_s: float) -> list[Event]:
        """Wait until workers answer or end."""
        asked = {one.ref: number for number, one in self._workers.items() if one.ref is not None}
        if not self._events:
            if not asked:
                time.sleep(min(timeout_s, 0.1))
            else:
                self._ray.wait(list(asked), num_returns=1, timeout=timeout_s)
        if asked:
            for ref in self._ray.wait(list(asked), num_returns=len(asked), timeout=0)[0]:
                self._receive(asked[ref])
        events, self._events = self._events, []
        return events

    def end(self, worker: int) -> None:
        """End a worker and what it does."""
        one = self._workers.pop(worker)
        if one.ready and one.ref is not None:  # at work: it may have left something
            self._ended.setdefault(one.node, []).append(one.pid)
        self._ray.kill(one.actor)

    def nodes(self) -> frozenset[str]:
        """Return the nodes that are in use."""
        return self._usable - self._refused.keys()

    def set_aside(self, node: str, why: str) -> None:
        """Use a node no more."""
        self._refuse(node, why, LOOK_THERE)

    def _refuse(self, node: str, why: str, do_this: str) -> None:
        if node in self._refused:
            return
        self._refused[node], self._do_this = why, do_this
        self._given.notify(f"node {node} is set aside: {why}")
        for number in [n for n, one in self._workers.items() if one.node == node]:
            if self._workers[number].ready and self._workers[number].ref is not None:
                self._events.append(Died(number, node, "its node was set aside", of_node=True))
            self.end(number)

    def close(self) -> None:
        """End all workers, and remove what those that were at work have left on their nodes."""
        for number in list(self._workers):
            self.end(number)
        sweeps = [
            self._sweep(node, pids) for node, pids in self._ended.items() if node in self._ids
        ]
        if sweeps:
            self._ray.wait(sweeps, num_returns=len(sweeps), timeout=SWEEP_S)

    def _sweep(self, node: str, pids: list[int]) -> Any:
        return (
            self._ray.remote(sweep)
            .options(num_cpus=0, max_retries=0, scheduling_strategy=self._on(node))
            .remote(pids)
        )

    def _on(self, node: str) -> Any:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        return NodeAffinitySchedulingStrategy(self._ids[node], soft=False)

    def _reference(self, sha256: str) -> Any:
        """Return Ray's reference to a content; Ray copies it to a node once, for all workers
        there.
        """
        if sha256 not in self._refs:
            self._refs[sha256] = self._ray.put(self._given.contents.read(sha256))
            while len(self._refs) > HELD_CONTENTS:
                self._refs.popitem(last=False)
        self._refs.move_to_end(sha256)
        return self._refs[sha256]

    def _look(self) -> None:
        """Look at the nodes and start workers where there is room, evenly."""
        self._looked_s = now = time.monotonic()
        alive = {
            f"{node['NodeManagerHostname']}/{node['NodeID'][:8]}": node
            for node in self._ray.nodes()
            if node["Alive"]
        }
        self._ids = {name: node["NodeID"] for name, node in alive.items()}
        self._end_overdue(now)
        room = {
            name: self._room(node["Resources"])
            for name, node in alive.items()
            if name not in self._refused
        }
        self._usable = frozenset(name for name, workers in room.items() if workers)
        if alive:
            self._alive_s = now
        if alive and not room:
            found = "; ".join(f"{name}: {why}" for name, why in self._refused.items())
            raise InfrastructureError(
                f"all of its nodes: no node takes the work: {found}", self._do_this
            )
        if (room and not any(room.values())) or now - self._alive_s > BARREN_S:
            found = "no node has that much" if room else f"no node for {BARREN_S:g} s"
            raise InfrastructureError(
                f"{self._given.resources}: {found}",
                "ask for less behind --executor, or add nodes",
            )
        on = {name: sum(one.node == name for one in self._workers.values()) for name in room}
        while len(self._workers) < self._given.workers:
            open_ = [name for name in room if on[name] < room[name] and not self._rests(name, now)]
            if not open_:
                return
            chosen = min(open_, key=lambda name: on[name])
            on[chosen] += 1
            self._open(chosen)

    def _end_overdue(self, now_s: float) -> None:
        """End workers that do not become ready, unless they wait for cores that another driver's
        workers hold.
        """
        starting = {number: one for number, one in self._workers.items() if not one.ready}
        new = {one.begun: one for one in starting.values() if not one.has_begun}
        if new:
            for ref in self._ray.wait(list(new), num_returns=len(new), timeout=0)[0]:
                new[ref].has_begun, new[ref].since_s = True, now_s
        for number, one in starting.items():
            if number not in self._workers or now_s - one.since_s < self._start_s:
                continue
            if not one.has_begun and self._may_wait_for_cores(one.node, now_s):
                one.since_s = now_s
                continue
            self.end(number)
            if any(other.node == one.node and other.ready for other in self._workers.values()):
                self._failed[one.node] = self._failed.get(one.node, (0, 0.0))[0] + 1, now_s
            else:
                what = (
                    "its worker has started, but was not ready"
                    if one.has_begun
                    else "no process has started there"
                )
                self._refuse(one.node, f"{what} within {self._start_s:g} s", LOOK_THERE)

    def _may_wait_for_cores(self, node: str, now_s: float) -> bool:
        """Tell whether a process that needs no core starts on a node where a worker does not; true
        until there was time to see.
        """
        if node not in self._pings:
            options = {"num_cpus": 0, "max_retries": 0, "scheduling_strategy": self._on(node)}
            self._pings[node] = self._ray.remote(_ping).options(**options).remote(), now_s
            self._given.notify(
                f"node {node} has started no worker for {self._start_s:g} s; others may hold its cores"
            )
            return True
        ping, asked_s = self._pings[node]
        if not self._ray.wait([ping], timeout=0)[0]:
            return now_s - asked_s < self._start_s
        del self._pings[node]  # if it stays so, the node is asked again: it may break later
        return True

    def _room(self, held: Mapping[str, float]) -> int:
        """Return how many workers fit on a node."""
        fits = [held.get("CPU", 0.0) / self._given.resources.cores]
        if self._given.resources.gpus:
            fits.append(held.get("GPU", 0.0) / self._given.resources.gpus)
        if self._given.resources.memory_gib:
            fits.append(held.get("memory", 0.0) / (self._given.resources.memory_gib * GIB))
        return int(min(fits) + 1e-9)

    def _rests(self, node: str, now_s: float) -> bool:
        times, last_s = self._failed.get(node, (0, 0.0))
        return times > 0 and now_s - last_s < AGAIN_S

    def _open(self, node: str) -> None:
        memory = (
            {"memory": int(self._given.resources.memory_gib * GIB)}
            if self._given.resources.memory_gib
            else {}
        )
        made = self._ray.remote(Serving).options(
            num_cpus=self._given.resources.cores,
            num_gpus=self._given.resources.gpus,
            max_restarts=0,
            max_task_retries=0,
            scheduling_strategy=self._on(node),
            **memory,
        )
        actor = made.remote(
            node, self._given.resources.cores, dict(self._given.expected), self._given.targets
        )
        self._workers[self._next] = _Worker(
            actor, node, actor.begun.remote(), actor.accept.remote(self._blob), time.monotonic()
        )
        self._next += 1

    def _receive(self, number: int) -> None:
        """Take what a worker answers."""
        one = self._workers[number]
        errors = self._ray.exceptions
        try:
            answer = self._ray.get(one.ref)
        except errors.RayTaskError as error:
            self._gone(
                number, one, f"{type(error.cause or error).__name__}: {error.cause or error}", error
            )
        except errors.RayError as error:
            self._gone(number, one, reason_of(error), error)
        else:
            one.ref = None
            if one.ready:
                self._events.append(Done(number, one.node, pickle.loads(answer)))
                return
            one.pid, reasons = answer
            if reasons:
                self._refuse(one.node, "; ".join(reasons), SAME_VERSIONS)
                return
            one.ready = True
            self._accepted.add(one.node)

    def _gone(self, number: int, one: _Worker, found: str, error: Exception) -> None:
        """Strike a worker that is gone off the list."""
        was_ready = one.ready
        self.end(number)
        self._looked_s = -LOOK_S
        alive = {node["NodeID"] for node in self._ray.nodes() if node["Alive"]}
        of_node = self._ids.get(one.node) not in alive or isinstance(
            error, self._ray.exceptions.NodeDiedError
        )
        if was_ready:
            self._events.append(Died(number, one.node, found, of_node))
            return
        times = self._failed.get(one.node, (0, 0.0))[0] + 1
        self._failed[one.node] = times, time.monotonic()
        if times >= FAILED_STARTS and one.node not in self._accepted and not of_node:
            self.set_aside(one.node, f"no worker starts there: {found}")


def _ping() -> None:
    """Run at all."""


def reason_of(error: Exception) -> str:
    """Return the first telling line of one of Ray's errors, which are pages long."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0] if lines else 'no reason given'}"[:200]
