"""What workers on other nodes are given, and what must be the same there: Python, libraries, simrun's code, code and files of parts.

A node that differs would give other results, so it is refused before it gets work.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.plugins.parts import PartSpec
from alpasim_plugin.plugins.parts.source import OWN_ROOT, code_digest
from alpasim_plugin.runtime.executors.base import Resources, Work
from alpasim_plugin.runtime.executors.node_files import Contents
from alpasim_plugin.runtime.provenance import versions

J = TypeVar("J")

CODE = "code of simrun"
MISSING = "not there"


def identity_of(targets: Sequence[str]) -> dict[str, str]:
    """Return name -> version or digest, as this machine has it.

    Args:
        targets: Of `targets_of`.
    """
    own = {f"code of {target}": _digest_of(target) for target in targets}
    return versions() | {CODE: _own_code()} | own


def targets_of(parts: Sequence[PartSpec]) -> tuple[str, ...]:
    """Return the modules or files of those parts that are not simrun's own."""
    modules = dict.fromkeys(part.target.rpartition(":")[0] for part in parts)
    return tuple(module for module in modules if module.partition(".")[0] not in OWN_PACKAGES)


def differences(expected: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """Say what a node has that the driver has not, one text each.

    Example:
        >>> differences({"numpy": "2.1.0", "python": "3.11.9"}, {"numpy": "2.2.0", "python": "3.11.9"})
        ['numpy is 2.2.0, the driver has 2.1.0']
    """
    names = list(dict.fromkeys([*expected, *found]))
    pairs = [(name, expected.get(name, MISSING), found.get(name, MISSING)) for name in names]
    return [f"{name} is {there}, the driver has {here}" for name, here, there in pairs if here != there]


@lru_cache(maxsize=1)
def _own_code() -> str:
    """Return a digest of all source files of simrun, with their names."""
    hashed = hashlib.sha256()
    for package in sorted(OWN_PACKAGES):
        for path in sorted(Path(OWN_ROOT, package).rglob("*.py")):
            hashed.update(path.relative_to(OWN_ROOT).as_posix().encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return hashed.hexdigest()[:12]


def _digest_of(target: str) -> str:
    """Return the digest of a module, by dotted name or file, and of what it imports; `MISSING` where it is not installed."""
    if target.endswith(".py"):
        return code_digest(target)[:12] if Path(target).is_file() else MISSING
    try:
        spec = importlib.util.find_spec(target)
    except ImportError:
        return MISSING
    if spec is None:
        return MISSING
    return code_digest(spec.origin)[:12] if spec.origin and spec.origin.endswith(".py") else "compiled"


@dataclass(frozen=True)
class Assignment(Generic[J]):
    """Work for a pool, and what its workers must be and have.

    Attributes:
        work: The work; ``work.key(job)`` names a job for a later driver.
        contents: What it may fetch.
        targets: Modules of parts that are not simrun's (`targets_of`).
        expected: What `identity_of` must say on a node.
        resources: Of each worker.
        workers: Most workers at a time.
        notify: Called with a line for whatever a person should know.
    """

    work: Work[J, Any]
    contents: Contents
    targets: Sequence[str]
    expected: Mapping[str, str]
    resources: Resources
    workers: int
    notify: Callable[[str], None]


def assignment_as_here(
    work: Work[J, Any], contents: Contents, targets: Sequence[str], resources: Resources, workers: int, notify: Callable[[str], None]
) -> Assignment[J]:
    """Return an assignment for nodes that are as this machine is. Arguments are those of `Assignment`."""
    return Assignment(work, contents, tuple(targets), identity_of(targets), resources, workers, notify)
