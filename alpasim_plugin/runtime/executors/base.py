"""What executors share: work that can be done on any node, what a worker needs, and what says more of a node than of the work."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

R = TypeVar("R")
A_contra = TypeVar("A_contra", contravariant=True)
R_co = TypeVar("R_co", covariant=True)


@dataclass(frozen=True)
class Node:
    """The node that a piece of work runs on.

    Attributes:
        name: Name of its machine, for messages.
        fetch: Gives the bytes of a content by its SHA-256 (`alpasim_plugin.runtime.executors.placing`).
    """

    name: str
    fetch: Callable[[str], bytes]


class Work(Protocol[A_contra, R_co]):
    """Work that is pickled once and done anywhere."""

    def __call__(self, item: A_contra, node: Node) -> R_co:
        """Do one item."""
        ...

    def key(self, item: A_contra) -> str:
        """Return what names an item, also in a later process."""
        ...

    def needs(self, item: A_contra) -> Sequence[str]:
        """Return the SHA-256 of the contents that an item may fetch."""
        ...


@dataclass(frozen=True)
class Faulty(Generic[R]):
    """A result that tells of its node rather than of its item: a full disk, a missing library. Another node may do better.

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
class Limits:
    """How work is executed.

    Attributes:
        workers: Most workers at a time; None: as many as there is room for.
        resources: Of each.
        limit_s: Seconds that one item may take; None: no limit.
    """

    workers: int | None
    resources: Resources = Resources()
    limit_s: float | None = None


def nothing_known(item: object) -> None:
    """Know of no item that it is done."""
