"""Runs, pools and scripted work on a Ray cluster of this machine: what the slow tests of Ray
share.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from alpasim_plugin.runs.executors.assignment import Assignment, Contents, assignment_as_here
from alpasim_plugin.runs.executors.base import Resources
from alpasim_plugin.runs.executors.choice import Executor
from alpasim_plugin.runs.executors.pool import run_jobs
from alpasim_plugin.runs.plan import RunPlan
from alpasim_plugin.runs.run import RunResult, execute_run
from tests.runs.cluster_nodes import Nodes
from tests.runs.remote_work import Scripted
from tests.runs.test_runs import Announced


def run(plan: RunPlan, root: Path, executor: Executor, **more: Any) -> tuple[RunResult, Announced]:
    announced = Announced()
    result = execute_run(
        plan,
        root,
        None,
        ["simrun"],
        announced,
        certificate="none",
        report=False,
        executor=executor,
        **more,
    )
    return result, announced


@contextmanager
def pool_on(
    nodes: Nodes | None, work: Scripted, contents: Contents | None = None, **more: Any
) -> Iterator[Any]:
    """Give a pool of at most eight workers; ``more`` for `Assignment`, or ``start_s`` for the
    pool.
    """
    from alpasim_plugin.runs.executors.ray_backend import START_S, RayBackend, connected

    start_s = more.pop("start_s", START_S)
    given: Assignment[str] = replace(
        assignment_as_here(work, contents or Contents(), (), Resources(), 8, print), **more
    )
    with connected(nodes and nodes.address):
        pool = RayBackend(given, start_s)
        try:
            yield pool
        finally:
            pool.close()


def scripted(
    nodes: Nodes,
    work: Scripted,
    items: list[str],
    contents: Contents | None = None,
    limit_s: float | None = None,
) -> dict:
    with pool_on(nodes, work, contents) as pool:
        return dict(run_jobs(pool, items, print, limit_s))
