"""What workers on other nodes are given, and what must be the same there: Python, libraries,
simrun's code, code and files of parts.

A node that differs would give other results, so it is refused before it gets work.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import socket
import stat
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core import places
from alpasim_plugin.core.atomic import disk_error, write_bytes
from alpasim_plugin.core.cache import cached
from alpasim_plugin.core.checksums import sha256_of
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.parts import PartSpec
from alpasim_plugin.core.parts.source import OWN_ROOT, code_digest
from alpasim_plugin.core.processes import is_running
from alpasim_plugin.log.run_folder.writer import remove_left_overs
from alpasim_plugin.runs.executors.base import Node, Resources, Work
from alpasim_plugin.runs.provenance import versions

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
    return [
        f"{name} is {there}, the driver has {here}" for name, here, there in pairs if here != there
    ]


@lru_cache(maxsize=1)
def _own_code() -> str:
    """Return a digest of all source files of simrun, with their names."""
    hashed = hashlib.sha256()
    for package in sorted(OWN_PACKAGES):
        for path in sorted(Path(OWN_ROOT, package).rglob("*.py")):
            hashed.update(
                path.relative_to(OWN_ROOT).as_posix().encode()
                + b"\0"
                + hashlib.sha256(path.read_bytes()).digest()
            )
    return hashed.hexdigest()[:12]


def _digest_of(target: str) -> str:
    """Return the digest of a module, by dotted name or file, and of what it imports; `MISSING`
    where it is not installed.
    """
    if target.endswith(".py"):
        return code_digest(target)[:12] if Path(target).is_file() else MISSING
    try:
        spec = importlib.util.find_spec(target)
    except ImportError:
        return MISSING
    if spec is None:
        return MISSING
    return (
        code_digest(spec.origin)[:12] if spec.origin and spec.origin.endswith(".py") else "compiled"
    )


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
    work: Work[J, Any],
    contents: Contents,
    targets: Sequence[str],
    resources: Resources,
    workers: int,
    notify: Callable[[str], None],
) -> Assignment[J]:
    """Return an assignment for nodes that are as this machine is. Arguments are those of
    `Assignment`.
    """
    return Assignment(
        work, contents, tuple(targets), identity_of(targets), resources, workers, notify
    )


GONE_S = 5.0  # within which a killed process must be gone
KIND = "placed"
M = TypeVar("M", bound=BaseModel)


class Contents:
    """What the driver has to give, by SHA-256."""

    def __init__(self) -> None:
        self._held: dict[str, bytes | Path] = {}

    def add_bytes(self, data: bytes) -> str:
        """Take bytes in; return their SHA-256."""
        sha256 = hashlib.sha256(data).hexdigest()
        self._held[sha256] = data
        return sha256

    def add_file(self, path: Path) -> str:
        """Take a file in, which is read when it is asked for; return its SHA-256."""
        sha256 = sha256_of(path)
        self._held[sha256] = path
        return sha256

    def __contains__(self, sha256: str) -> bool:
        return sha256 in self._held

    def names(self) -> tuple[str, ...]:
        """Return the SHA-256 of all contents."""
        return tuple(self._held)

    def read(self, sha256: str) -> bytes:
        """Return a content."""
        held = self._held[sha256]
        return held if isinstance(held, bytes) else held.read_bytes()


def place(sha256: str, name: str, node: Node) -> Path:
    """Return the path of a content on this node, fetched if it is not there.

    Raises:
        InfrastructureError: It cannot be fetched, is not what was asked for, or cannot be written.
    """

    def make(folder: Path) -> None:
        data = node.fetch(sha256)
        found = hashlib.sha256(data).hexdigest()
        if found != sha256:
            raise InfrastructureError(
                f"{name} on {node.name}: SHA-256 {found}, not {sha256}",
                "try again",
            )
        write_bytes(folder / name, data)

    def read(folder: Path) -> Path:
        if sha_of_unchanged(folder / name) != sha256:
            raise InputError(
                f"{folder / name}: not the content of its name",
                "it is fetched again",
            )
        return folder / name

    return cached(KIND, sha256, make, read, f"{name} for {node.name}")


def placed_path(path: str, sha256: str, node: Node) -> str:
    """Return where this node has a file of the driver's: at the same path, in its own installation
    of simrun, or placed by content.
    """
    here = is_here(path, sha256)
    return here or str(place(sha256, Path(path).name, node))


def is_here(path: str, sha256: str) -> str:
    """Return where this machine has a file of the driver's, at the same path or in its own
    installation of simrun; empty if nowhere.
    """
    found = (
        there
        for there in (Path(path), in_own_installation(path))
        if sha_of_unchanged(there) == sha256
    )
    return str(next(found, ""))


def in_own_installation(path: str) -> Path:
    """Return the place of a driver's file in this machine's installation of simrun; the path itself
    where it is none of simrun's.
    """
    for mark in ("/configs/", "/policies/", "/alpasim_plugin/"):
        _, found, rest = path.rpartition(mark)
        if found:
            return Path(OWN_ROOT + mark + rest)
    return Path(path)


def sha_of_unchanged(path: Path) -> str:
    """Return a file's SHA-256, read again only if its size or time has changed; empty where it
    cannot be read.
    """
    try:
        state = path.stat()
        return _sha(str(path), state.st_size, state.st_mtime_ns)
    except OSError:
        return ""


@lru_cache(maxsize=1024)
def _sha(path: str, size: int, mtime_ns: int) -> str:
    return sha256_of(Path(path))


def paths_in(settings: BaseModel | None) -> set[str]:
    """Return every text and path among settings, nested ones too."""
    found: set[str] = set()
    for name in type(settings).model_fields if settings is not None else ():
        value = getattr(settings, name)
        found |= (
            paths_in(value)
            if isinstance(value, BaseModel)
            else {str(value)}
            if isinstance(value, str | Path)
            else set()
        )
    return found


def with_paths(settings: M, moved: dict[str, str]) -> M:
    """Return settings with paths replaced, in nested settings too."""
    changed: dict[str, Any] = {}
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        if isinstance(value, BaseModel):
            new: Any = with_paths(value, moved)
        elif isinstance(value, str | Path) and str(value) in moved:
            new = type(value)(moved[str(value)])
        else:
            continue
        changed[name] = new
    return settings.model_copy(update=changed)


def scratch_root() -> Path:
    """Return where this node drives (`alpasim_plugin.core.places.scratch`).

    Raises:
        InfrastructureError: No folder can be written, or another user could write this one.
    """
    found = places.scratch()
    if found.path is None or not places.is_private(found.path):
        reason = (
            "no folder can be written"
            if found.path is None
            else "it cannot be made, or another user could write it"
        )
        raise InfrastructureError(f"{found}: {reason}", f"name a folder in {places.SCRATCH}")
    return found.path


def measured_folder(run: str) -> Path | None:
    """Return where the processes of a run on this node share what they measure
    (`alpasim_plugin.core.cache`).

    None: nowhere, since the cache cannot be written, or another user could write there and decide
        what this run takes for its machine's
    speed.
    """
    kept = places.cache().path
    root = None if kept is None else kept / "measured" / socket.gethostname()
    return root / run if root is not None and places.is_private(root) else None


def sweep(pids: Sequence[int] = ()) -> None:
    """Remove what killed workers have left on this node, once these processes are gone.

    Only names that simrun gives are touched, and only those of processes that run no more.
    """
    until_s = time.monotonic() + GONE_S
    while any(is_running(pid) for pid in pids) and time.monotonic() < until_s:
        time.sleep(0.05)
    try:
        root = scratch_root()
    except InfrastructureError:  # where nothing can be driven, nothing was left
        return
    remove_left_overs(root)


def private_folder(path: Path) -> Path:
    """Make a folder that only this user can read and write, and return it: what is unpickled may
    lie in such a folder alone.

    Raises:
        InfrastructureError: It cannot be made, is a link, or another user could write it.
    """
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = path.lstat()
    except OSError as error:
        raise disk_error(path, error) from error
    owned = stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid()
    if not owned or state.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        found = (
            f"mode {stat.S_IMODE(state.st_mode):o} of user {state.st_uid}"
            if owned
            else f"a link, or of user {state.st_uid}"
        )
        raise InfrastructureError(
            f"{path}: not private to this user ({found})",
            "remove it, or name another folder",
        )
    return path
