"""Which executor a run uses, by the text of ``--executor``, and its workers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qsl

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runs.executors.assignment import Assignment
from alpasim_plugin.runs.executors.base import Backend, Resources

DOING = "choosing an executor"
NEEDS: dict[str, Callable[[str], float]] = {
    "cores": int,
    "gpus": float,
    "memory": float,
}  # memory in GiB


@dataclass(frozen=True)
class Executor:
    """Where rollouts run.

    Attributes:
        kind: ``local``: processes of this machine. ``ray``: a Ray cluster. ``slurm``: jobs of
            Slurm.
        where: Address of the cluster's head, or Slurm's partition; empty: the one at hand.
            ``@local`` for Slurm: processes of this machine.
        resources: Of each worker; not for ``local``.
    """

    kind: Literal["local", "ray", "slurm"] = "local"
    where: str = ""
    resources: Resources = Resources()

    @property
    def is_local(self) -> bool:
        """Tell whether workers are processes of this machine that write the run folder
        themselves.
        """
        return self.kind == "local"

    def __str__(self) -> str:
        return f"{self.kind}:{self.where}" if self.where else self.kind


LOCAL = Executor()


def parse_executor(text: str) -> Executor:
    """Parse ``--executor``: a place, and behind a question mark what each worker of a cluster
    needs.

    Example:
        >>> parse_executor("ray:10.0.0.1:6379").where, parse_executor("slurm?cores=4&gpus=0.5").resources
        ('10.0.0.1:6379', Resources(cores=4, gpus=0.5, memory_gib=None))

    Raises:
        InputError: There is no such executor, ``local`` is given needs, or a need is unknown or no
            number of its kind.
    """
    named, _, query = text.partition("?")
    kind, _, where = named.partition(":")
    if kind == "local" and not where:
        if query:
            raise InputError(
                f"--executor {text}: local divides this machine's cores among --workers",
                "use --workers, or another executor",
            )
        return LOCAL
    if kind == "ray":
        return Executor("ray", where, _resources(text, query))
    if kind == "slurm":
        return Executor("slurm", where, _resources(text, query))
    raise InputError(
        f"--executor {text}: no such executor",
        "write local, ray, ray:HOST:PORT, slurm, or slurm:PARTITION",
    )


def _resources(text: str, query: str) -> Resources:
    with suppress(KeyError, ValueError):
        needs = {
            name: NEEDS[name](value) for name, value in parse_qsl(query, keep_blank_values=True)
        }
        cores = int(needs.get("cores", 1))
        gpus = needs.get("gpus", 0.0)
        memory = needs.get("memory")
        if cores >= 1 and 0 <= gpus < math.inf and (memory is None or 0 < memory < math.inf):
            return Resources(cores, gpus, memory)
    raise InputError(
        f"--executor {text}: {query!r} is not what a worker can need",
        "write for example ray?cores=2&gpus=0.5&memory=7.5: whole cores, a share of a GPU, GiB",
    )


@contextmanager
def kept_open(executor: Executor) -> Iterator[None]:
    """Stay connected to the executor's cluster during the block, in which pools are opened several
    times.
    """
    if executor.kind != "ray":
        yield
        return
    from alpasim_plugin.runs.executors.ray_backend import connected

    with connected(executor.where or None):
        yield


@contextmanager
def opened_backend(
    executor: Executor, assignment: Assignment[Any], folder: Path
) -> Iterator[Backend[Any]]:
    """Open the workers of an executor that is not ``local`` for the block; at its end, however it
    ends, no worker is left.

    Args:
        executor: Which.
        assignment: What its workers do.
        folder: The run folder.

    Raises:
        InputError: Its library is not installed.
        InfrastructureError: There is no cluster.
    """
    with kept_open(executor):
        if executor.kind == "ray":
            from alpasim_plugin.runs.executors.ray_backend import RayBackend

            backend: Backend[Any] = RayBackend(assignment)
        else:
            from alpasim_plugin.runs.executors.slurm_backend import SlurmBackend

            backend = SlurmBackend(assignment, executor.where, folder)
        with closing(backend):
            yield backend
