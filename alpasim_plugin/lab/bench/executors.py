"""What the way over other nodes costs: rollouts that only sleep, so that their time is known
whatever the processor does.

Everything else is as in a run: workers are actors of Ray that compare versions first, a result is
as large as a rollout, travels to the driver, is checked and written to a folder with its manifest.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.runs.commits import RolloutResult, unpack
from alpasim_plugin.runs.executors.assignment import Contents, assignment_as_here
from alpasim_plugin.runs.executors.base import Backend, Lost, Node, Resources
from alpasim_plugin.runs.executors.choice import Executor, kept_open, opened_backend
from alpasim_plugin.runs.executors.pool import run_jobs

DOING = "measuring an executor"
LOG = "rollout.asl"
RESULT_BYTES = 750_000  # of a rollout of eight seconds with its pictures
LIGHT = {"include_log_monitor": False}  # fewer processes of Ray's own
LIGHT_HEAD = {"include_dashboard": False, "no_monitor": True, **LIGHT}
STARTS = 4  # of a node that does not come up in time
READY_S = 600.0  # for all workers to be ready


@dataclass(frozen=True)
class ExecutorRow:
    """One number of workers.

    Attributes:
        workers: At a time.
        rollouts: That they drove.
        start_s: Until all workers were ready; not part of the next.
        wall_s: From the first rollout handed out to the last one written.
        efficiency: Sleeping time of all rollouts over ``workers * wall_s``, a fraction.
        driver_cpu_s: Processor time of the driver during ``wall_s``.
        driver_ms: The same for each rollout, milliseconds.
    """

    workers: int
    rollouts: int
    start_s: float
    wall_s: float
    efficiency: float
    driver_cpu_s: float
    driver_ms: float


@dataclass(frozen=True)
class Sleeping:
    """Rollouts that take a known time and give a result of a known size."""

    seconds: float
    result_bytes: int

    def __call__(self, job: int, node: Node) -> RolloutResult:
        """Sleep."""
        time.sleep(self.seconds)
        data = os.urandom(self.result_bytes)
        facts = {"bytes": len(data), "mtime_ns": 0, "sha256": hashlib.sha256(data).hexdigest()}
        return RolloutResult(
            {"path": f"rollouts/{job}", "status": "ok", "node": node.name, "files": {LOG: facts}},
            {LOG: data},
        )

    def key(self, job: int) -> str:
        """Return the rollout's number."""
        return str(job)

    def needs(self, job: int) -> list[str]:
        """Return nothing: a sleeping rollout has no scene."""
        return []


def patiently(start: Callable[[], Any]) -> Any:
    """Start a node of Ray, which gives it 30 s to come up; on a busy machine it is started again,
    `STARTS` times in all.

    Raises:
        InfrastructureError: It never came up in time.
    """
    for _ in range(STARTS):
        try:
            return start()
        except Exception as error:  # Ray has no class of its own for it
            if "timed out during startup" not in str(error):
                raise
            last = error
    raise InfrastructureError(
        f"this machine: {last}", "try again when the machine is less busy"
    ) from last


@contextmanager
def local_nodes(nodes: int, cores: int) -> Iterator[Executor]:
    """Start a Ray cluster on this machine, whose nodes say that they have so many cores each, for
    the block.
    """
    require_library("ray", f"--nodes {nodes}", "pip install 'alpasim-onefixer[ray]'")
    from ray.cluster_utils import Cluster

    cluster = patiently(
        lambda: Cluster(initialize_head=True, head_node_args={"num_cpus": cores, **LIGHT_HEAD})
    )
    try:
        for _ in range(nodes - 1):
            patiently(lambda: cluster.add_node(num_cpus=cores, **LIGHT))
        yield Executor("ray", str(cluster.address))
    finally:
        cluster.shutdown()


def bench_executor(
    executor: Executor,
    counts: Sequence[int],
    rollouts: int,
    seconds: float,
    result_bytes: int = RESULT_BYTES,
) -> Iterator[ExecutorRow]:
    """Yield one row for each number of workers.

    Args:
        executor: A Ray cluster.
        counts: Numbers of workers.
        rollouts: For each worker.
        seconds: That a rollout takes.
        result_bytes: Size of its result.

    Raises:
        InputError: Another executor.
        InfrastructureError: The cluster has fewer cores, or its workers do not start.
    """
    if executor.kind != "ray":
        raise InputError(
            f"--executor {executor}: its workers cannot be started before the clock",
            "measure --executor ray",
        )
    with kept_open(executor), TemporaryDirectory(prefix="simrun-bench-") as scratch:
        for count in counts:
            yield _row(
                executor,
                count,
                list(range(count * rollouts)),
                Sleeping(seconds, result_bytes),
                Path(scratch, str(count)),
            )


def _row(
    executor: Executor, count: int, items: Sequence[int], work: Sleeping, root: Path
) -> ExecutorRow:
    noticed: list[str] = []
    given = assignment_as_here(work, Contents(), (), Resources(), count, noticed.append)
    asked_s = time.perf_counter()
    with opened_backend(executor, given, root) as backend:
        _all_ready(backend, count, noticed)
        began_s, began_cpu_s = time.perf_counter(), time.process_time()
        for item, got in run_jobs(backend, items, noticed.append):
            if isinstance(got, Lost):
                raise InfrastructureError(
                    f"rollout {item}: {got.found}", "look at the nodes, then measure again"
                )
            unpack(got, root)
        wall_s, cpu_s = time.perf_counter() - began_s, time.process_time() - began_cpu_s
    efficiency = len(items) * work.seconds / (count * wall_s)
    return ExecutorRow(
        count, len(items), began_s - asked_s, wall_s, efficiency, cpu_s, 1e3 * cpu_s / len(items)
    )


def _all_ready(backend: Backend[Any], count: int, noticed: Sequence[str]) -> None:
    until_s = time.perf_counter() + READY_S
    while (ready := len(backend.free(count))) < count:
        if time.perf_counter() > until_s:
            found = "; ".join([f"{ready} were ready after {READY_S:g} s", *noticed])
            raise InfrastructureError(
                f"{count} workers: {found}",
                "ask for no more workers than the cluster has cores",
            )
        backend.wait(0.1)
