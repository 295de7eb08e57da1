"""What a pool of workers is given, whichever pool it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from alpasim_plugin.runtime.executors.base import Resources, Work
from alpasim_plugin.runtime.executors.identity import identity_of
from alpasim_plugin.runtime.executors.placing import Contents

A = TypeVar("A")


@dataclass(frozen=True)
class Assignment(Generic[A]):
    """Work for a pool, and what its workers must be and have.

    Attributes:
        work: The work; ``work.key(item)`` names an item for a later driver.
        contents: What it may fetch.
        targets: Modules of parts that are not simrun's (`alpasim_plugin.runtime.executors.identity.targets_of`).
        expected: What `identity_of` must say on a node.
        resources: Of each worker.
        most: Most workers at a time.
        noticed: Called with a line for whatever a person should know.
    """

    work: Work[A, Any]
    contents: Contents
    targets: Sequence[str]
    expected: Mapping[str, str]
    resources: Resources
    most: int
    noticed: Callable[[str], None]


def assignment_as_here(
    work: Work[A, Any], contents: Contents, targets: Sequence[str], resources: Resources, most: int, noticed: Callable[[str], None]
) -> Assignment[A]:
    """Return an assignment for nodes that are as this machine is. Arguments are those of `Assignment`."""
    return Assignment(work, contents, tuple(targets), identity_of(targets), resources, most, noticed)
