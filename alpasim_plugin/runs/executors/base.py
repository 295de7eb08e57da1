"""What the pool and its backends share: jobs, what became of them, and what a backend of workers
does.

No numerical library is imported here: a worker sets the number of their threads first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

R = TypeVar("R")
J_contra = TypeVar("J_contra", contravariant=True)
R_co = TypeVar("R_co", covariant=True)

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


@dataclass(frozen=True)
class Node:
    """The node that a piece of work runs on.

    Attributes:
        name: Name of its machine, for messages.
        fetch: Gives the bytes of a content by its SHA-256
            (`alpasim_plugin.runs.executors.assignment`).
    """

    name: str
    fetch: Callable[[str], bytes]


class Work(Protocol[J_contra, R_co]):
    """Work that is pickled once and done anywhere."""

    def __call__(self, job: J_contra, node: Node) -> R_co:
        """Do one job."""
        ...

    def key(self, job: J_contra) -> str:
        """Return what names a job, also in a later process."""
        ...

    def needs(self, job: J_contra) -> Sequence[str]:
        """Return the SHA-256 of the contents that a job may fetch."""
        ...


@dataclass(frozen=True)
class Faulty(Generic[R]):
    """A result that tells of its node rather than of its job: a full disk, a missing library.
    Another node may do better.

    Attributes:
        value: What stands if none does.
        found: What is wrong with the node.
    """

    value: R
    found: str


@dataclass(frozen=True)
class Resources:
    """What one worker needs.

    Attributes:
        cores: Processor cores.
        gpus: Share of a GPU; 0.5 lets two workers share one.
        memory_gib: Memory; None declares none.
    """

    cores: int = 1
    gpus: float = 0.0
    memory_gib: float | None = None


@dataclass(frozen=True)
class Lost:
    """What stands for the result of a job that has none.

    Attributes:
        found: What became of its worker.
        hung: It was ended because it exceeded the time limit.
        do_this: One action that would help; empty where the caller knows better.
    """

    found: str
    hung: bool = False
    do_this: str = ""


@dataclass(frozen=True)
class Rules:
    """How the pool treats the jobs of a backend.

    Attributes:
        chunk_s: Seconds that the jobs handed over together should take: long against the time to
            hand them over. 0: each goes alone.
        most_losses: A job that so many workers died of is given up.
        copies: Whether a late job is given to a second worker.
        after_hanging: What helps a job that exceeded its time limit.
        after_dying: What helps a job that is given up.
    """

    chunk_s: float
    most_losses: int = 3
    copies: bool = True
    after_hanging: str = "look at what hangs, or raise --time-limit"
    after_dying: str = (
        "run it alone with --executor local --workers 1, and look at the memory it takes"
    )


@dataclass(frozen=True)
class Place:
    """A free worker, and the node that it is on (empty where nobody knows before the work is
    done).
    """

    worker: int
    node: str


@dataclass(frozen=True)
class Done:
    """A worker has answered: one answer per job, an exception where the work raised."""

    worker: int
    node: str
    answers: Sequence[Any]


@dataclass(frozen=True)
class Died:
    """A worker is gone. ``of_node``: its jobs are not to blame, it went with its node or before it
    began them.
    """

    worker: int
    node: str
    found: str
    of_node: bool = False


Event = Done | Died


class Backend(Protocol[J_contra]):
    """Workers somewhere: it starts them, hands them jobs and says what became of them. The pool
    decides everything else.
    """

    rules: Rules

    def inherited(self, jobs: Sequence[J_contra]) -> Iterable[tuple[int, Any]]:
        """Yield index and result of jobs that the workers of an earlier driver have done; none
        where workers end with their driver.
        """
        return ()

    def free(self, wanted: int) -> Sequence[Place]:
        """Start workers where there is room and return those without work.

        Args:
            wanted: Workers that there are jobs for; starting more is of use only for copies of late
                jobs.

        Raises:
            InfrastructureError: Every node was refused.
        """
        ...

    def start(self, worker: int, jobs: Sequence[J_contra]) -> None:
        """Hand jobs to a free worker."""
        ...

    def wait(self, timeout_s: float) -> Sequence[Event]:
        """Wait until workers answer or end, at most ``timeout_s`` seconds."""
        ...

    def end(self, worker: int) -> None:
        """End a worker and what it does, without an event."""
        ...

    def nodes(self) -> frozenset[str]:
        """Return the nodes that are in use; none where there is only this machine."""
        return frozenset()

    def set_aside(self, node: str, why: str) -> None:
        """Use a node no more, and say why; what runs there ends with a `Died` of the node."""
        return None

    def close(self) -> None:
        """End all workers."""
        ...
