"""Which executor a run uses, by the text of ``--executor``, and its workers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runtime.executors.assignment import Assignment
from alpasim_plugin.runtime.executors.base import Backend, Resources

DOING = "choosing an executor"


@dataclass(frozen=True)
class Executor:
    """Where rollouts run.

    Attributes:
        kind: ``local``: processes of this machine. ``ray``: a Ray cluster. ``slurm``: jobs of Slurm.
        where: Address of the cluster's head, or Slurm's partition; empty: the one at hand. ``@local`` for Slurm: processes of this machine.
        resources: Of each worker; not for ``local``.
    """

    kind: Literal["local", "ray", "slurm"] = "local"
    where: str = ""
    resources: Resources = Resources()

    @property
    def is_local(self) -> bool:
        """Tell whether workers are processes of this machine that write the run folder themselves."""
        return self.kind == "local"

    def __str__(self) -> str:
        return f"{self.kind}:{self.where}" if self.where else self.kind


LOCAL = Executor()


def parse_executor(text: str, cores: int | None = None, gpus: float | None = None, memory_gib: float | None = None) -> Executor:
    """Parse ``--executor`` and what a worker needs.

    Example:
        >>> parse_executor("ray:10.0.0.1:6379").where, parse_executor("slurm", cores=4).resources.cores
        ('10.0.0.1:6379', 4)

    Raises:
        InputError: There is no such executor, or ``local`` is given resources.
    """
    kind, _, where = text.partition(":")
    given = {"--cores": cores, "--gpus": gpus, "--memory": memory_gib}
    if kind == "local" and not where:
        named = [name for name, value in given.items() if value is not None]
        if named:
            found = "local divides this machine's cores among --workers"
            raise InputError(DOING, f"{named[0]} with --executor local", found, "use --workers, or another executor")
        return LOCAL
    resources = Resources(cores or 1, gpus or 0.0, memory_gib)
    if kind == "ray":
        return Executor("ray", where, resources)
    if kind == "slurm":
        return Executor("slurm", where, resources)
    raise InputError(DOING, f"--executor {text}", "no such executor", "write local, ray, ray:HOST:PORT, slurm, or slurm:PARTITION")


@contextmanager
def kept_open(executor: Executor) -> Iterator[None]:
    """Stay connected to the executor's cluster during the block, in which pools are opened several times."""
    if executor.kind != "ray":
        yield
        return
    from alpasim_plugin.runtime.executors.ray_backend import connected

    with connected(executor.where or None):
        yield


@contextmanager
def opened_backend(executor: Executor, assignment: Assignment[Any], folder: Path) -> Iterator[Backend[Any]]:
    """Open the workers of an executor that is not ``local`` for the block; at its end, however it ends, no worker is left.

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
            from alpasim_plugin.runtime.executors.ray_backend import RayBackend

            backend: Backend[Any] = RayBackend(assignment)
        else:
            from alpasim_plugin.runtime.executors.slurm_backend import SlurmBackend

            backend = SlurmBackend(assignment, executor.where, folder)
        with closing(backend):
            yield backend
