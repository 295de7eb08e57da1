"""``simrun bench executors``: what the way over other nodes costs."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Annotated

import typer

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.executors import (
    RESULT_BYTES,
    ExecutorRow,
    bench_executor,
    local_nodes,
)
from alpasim_plugin.lab.cli.bench_rows import print_rows
from alpasim_plugin.runs.executors.choice import parse_executor

DOING = "measuring an executor"

EPILOG = """
Examples:

- `simrun bench executors`: a Ray cluster of four nodes on this machine, 1 to 16 workers

- `simrun bench executors --seconds 0.2 --rollouts 100`: short rollouts, which go in chunks

- `simrun bench executors --executor ray:10.0.0.1:6379 --workers 1,16,256`: a cluster that runs
"""


def executors(
    executor: Annotated[
        str | None,
        typer.Option(
            "--executor", help="A running Ray cluster, `ray:HOST:PORT`; by default one made here."
        ),
    ] = None,
    nodes: Annotated[
        int, typer.Option("--nodes", min=1, help="Nodes of the cluster that is made here.")
    ] = 4,
    cores: Annotated[
        int, typer.Option("--cores", min=1, help="Cores that each of them says it has.")
    ] = 4,
    workers: Annotated[str, typer.Option("--workers", help="Numbers of workers.")] = "1,2,4,8,16",
    rollouts: Annotated[
        int, typer.Option("--rollouts", min=1, help="Rollouts for each worker.")
    ] = 10,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.001, help="That a rollout takes.")
    ] = 4.0,
    result_kb: Annotated[
        float, typer.Option("--result-kb", min=0.0, help="Size of a rollout's result.")
    ] = RESULT_BYTES / 1e3,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Drive rollouts that only sleep with 1 to 16 workers of a Ray cluster: efficiency, and the
    driver's time for each.

    Results travel, are checked and written as a run's are. Sleeping needs no core, so this measures
    the engine and not the processor; on a busy machine it measures how long driver and workers wait
    for one, too.
    """
    del debug
    counts = parse_workers(workers)
    if executor is None:
        if max(counts) > nodes * cores:
            raise InputError(
                f"--workers {workers}: {nodes} nodes of {cores} cores hold {nodes * cores}",
                "raise --nodes or --cores",
            )
        with local_nodes(nodes, cores) as made:
            rows = _heard(bench_executor(made, counts, rollouts, seconds, int(1e3 * result_kb)))
    else:
        rows = _heard(
            bench_executor(
                parse_executor(executor), counts, rollouts, seconds, int(1e3 * result_kb)
            )
        )
    print_rows([asdict(row) for row in rows], as_json)


def _heard(rows: Iterable[ExecutorRow]) -> Sequence[ExecutorRow]:
    """Say each row on standard error when it is there; together they take minutes."""
    found = []
    for row in rows:
        print(
            f"{row.workers} workers: efficiency {row.efficiency:.3f}", file=sys.stderr, flush=True
        )
        found.append(row)
    return found


def parse_workers(text: str) -> list[int]:
    """Read ``1,4,16``.

    Example:
        >>> parse_workers("1, 16")
        [1, 16]

    Raises:
        InputError: Not numbers from 1 up.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--workers {text}: no numbers from 1 up", "write for example 1,4,16")
    return [int(part) for part in parts]
