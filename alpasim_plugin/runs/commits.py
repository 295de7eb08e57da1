"""A finished rollout on its way from a node to the run folder: its manifest and its files, and the
store that keeps them: bytes by key.

A store is a folder, or an object store through fsspec. A key appears whole or not at all, and can
be made to appear only once. Nothing here lists keys: that would be slow with a million of them, and
some stores show new keys late in lists.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

from alpasim_plugin.core.atomic import disk_error, temporary_path, write_bytes
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.log.run_folder.manifests import read_manifest, write_manifest
from alpasim_plugin.log.run_folder.schema import DERIVED, DRIVEN, MANIFEST, OUTPUT_NAME
from alpasim_plugin.runs.cell import run_cell
from alpasim_plugin.runs.plan import Cell, RunOptions
from scenarios.suite import ScenarioRef

T = TypeVar("T")

DOING, READING = "using a store", "reading a rollout from a store"
PATIENCE_S = 300.0  # for a store that does not answer
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 10.0  # between tries


class Objects(Protocol):
    """Bytes by key; keys are relative paths."""

    def read(self, key: str) -> bytes | None:
        """Return a key's bytes; None where it is not there."""
        ...

    def write(self, key: str, data: bytes) -> None:
        """Write a key, whole or not at all; what was there is replaced."""
        ...

    def create(self, key: str, data: bytes) -> bool:
        """Write a key, whole or not at all, unless it is there; return whether this call made it.

        A store may say False to the one that made it, if its first answer was lost: read the key to
        know what is there.
        """
        ...


def open_objects(url: str) -> Objects:
    """Open the store of a URL: a path, ``file://``, or what fsspec knows (``s3://BUCKET/PREFIX``).

    Raises:
        InputError: The URL has a scheme that no installed library knows.
    """
    if "://" not in url or url.startswith("file://"):
        return FolderObjects(Path(url.removeprefix("file://")))
    fsspec = require_library("fsspec", f"--store {url}", "pip install 'alpasim-onefixer[s3]'")
    try:
        system, root = fsspec.core.url_to_fs(url, use_listings_cache=False)
    except (ValueError, ImportError) as error:
        raise InputError(
            f"--store {url}: {error}",
            "write a path or s3://BUCKET/PREFIX; s3 needs the extra [s3]",
        ) from error
    return RemoteObjects(system, root, url)


class FolderObjects:
    """Keys as files of a folder, also on NFS: a new name is linked, which only one process can
    do.
    """

    def __init__(self, root: Path) -> None:
        self._root = root.absolute()

    def read(self, key: str) -> bytes | None:
        """See `Objects`."""
        try:
            return (self._root / key).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise disk_error(self._root / key, error) from error

    def write(self, key: str, data: bytes) -> None:
        """See `Objects`."""
        write_bytes(self._root / key, data)

    def create(self, key: str, data: bytes) -> bool:
        """See `Objects`."""
        path = self._root / key
        partial = temporary_path(path)
        write_bytes(partial, data)
        try:
            os.link(partial, path)
        except FileExistsError:
            return False
        except OSError as error:
            raise disk_error(path, error) from error
        finally:
            partial.unlink(missing_ok=True)
        return True


class RemoteObjects:
    """Keys of an object store. A store that does not answer is asked again for five minutes.

    Args:
        system: A file system of fsspec whose ``pipe_file`` knows ``mode="create"``.
        root: Its path for the empty key.
        url: For messages.
    """

    def __init__(self, system: Any, root: str, url: str, patience_s: float = PATIENCE_S) -> None:
        self._system, self._root, self._url, self._patience_s = (
            system,
            root.rstrip("/"),
            url,
            patience_s,
        )

    def read(self, key: str) -> bytes | None:
        """See `Objects`."""

        def ask() -> bytes | None:
            try:
                return bytes(self._system.cat_file(f"{self._root}/{key}"))
            except FileNotFoundError:
                return None

        return self._patiently(key, ask)

    def write(self, key: str, data: bytes) -> None:
        """See `Objects`."""
        self._patiently(key, lambda: self._system.pipe_file(f"{self._root}/{key}", data))

    def create(self, key: str, data: bytes) -> bool:
        """See `Objects`."""

        def ask() -> bool:
            try:
                self._system.pipe_file(f"{self._root}/{key}", data, mode="create")
            except FileExistsError:
                return False
            return True

        return self._patiently(key, ask)

    def _patiently(self, key: str, ask: Callable[[], T]) -> T:
        """Ask until there is an answer.

        Raises:
            InfrastructureError: The store refuses, or there was no answer for `PATIENCE_S`.
        """
        until_s, wait_s = time.monotonic() + self._patience_s, FIRST_WAIT_S
        while True:
            try:
                return ask()
            except (
                PermissionError,
                FileNotFoundError,
            ) as error:  # no right, no bucket: asking again would not help
                raise InfrastructureError(
                    f"{self._url}/{key}: {type(error).__name__}: {error}",
                    "check the address, the bucket and the credentials, on the nodes too",
                ) from error
            # libraries of object stores have families of errors for a network that is down
            except Exception as error:
                if time.monotonic() + wait_s > until_s:
                    raise InfrastructureError(
                        f"{self._url}/{key}: no answer for {self._patience_s:g} s: {type(error).__name__}: {error}",
                        "give the same command again when the store is back; finished rollouts are kept",
                    ) from error
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, LONGEST_WAIT_S)


NAMES = (*DRIVEN, *DERIVED)


@dataclass(frozen=True)
class RolloutResult:
    """A rollout.

    Attributes:
        manifest: As the node wrote it; ``files`` has the digests of ``files``.
        files: Content by name.
    """

    manifest: dict[str, Any]
    files: Mapping[str, bytes]


def pack(folder: Path, node: str) -> RolloutResult:
    """Read a rollout's folder, whose manifest was just written.

    Raises:
        InputError: The manifest is damaged.
        OSError: A file cannot be read.
    """
    manifest, _ = read_manifest(folder)
    names = list(manifest["files"]) or [
        OUTPUT_NAME
    ]  # of a failed rollout only what its parts printed
    files = {name: (folder / name).read_bytes() for name in names if (folder / name).exists()}
    return RolloutResult({"node": node, **manifest}, files)


def unpack(result: RolloutResult, root: Path) -> dict[str, Any]:
    """Write a rollout below a run folder, its manifest last, and return the manifest.

    Raises:
        InfrastructureError: A file is not what the node wrote, or the disk refuses.
    """
    folder = root / result.manifest["path"]
    for name, facts in result.manifest["files"].items():
        if hashlib.sha256(result.files[name]).hexdigest() != facts["sha256"]:
            raise InfrastructureError(
                f"{result.manifest['path']}/{name} from {result.manifest['node']}: not the content that the node wrote",
                "give the same command again",
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (MANIFEST, *NAMES):  # the manifest first: without it nothing is trusted
            (folder / name).unlink(missing_ok=True)
        for name, data in result.files.items():
            (folder / name).write_bytes(data)
    except OSError as error:
        raise disk_error(folder, error) from error
    manifest = {name: value for name, value in result.manifest.items() if name != "files"}
    write_manifest(folder, manifest)
    return manifest


PART_KEYS, PART_S = 1000, 60.0  # a part of the index is written after so many keys or seconds


class Commits:
    """The rollouts of a store."""

    def __init__(self, url: str, objects: Objects | None = None) -> None:
        self.url = url
        self._objects = objects or open_objects(url)
        self.index = Index(self._objects)

    def find(self, key: str) -> RolloutResult | None:
        """Return a committed rollout; None where there is none.

        Raises:
            InfrastructureError: A file is missing or not what was committed, or the store does not
                answer.
        """
        stated = self._objects.read(_name(key))
        return None if stated is None else self._result(key, json.loads(stated))

    def commit(self, key: str, result: RolloutResult) -> RolloutResult:
        """Commit a rollout and return what is committed: this one, or the one that came first."""
        attempt = f"attempts/{result.manifest['path']}/{os.urandom(8).hex()}"
        for name, data in result.files.items():
            self._objects.write(f"{attempt}/{name}", data)
        stated = {"attempt": attempt, "files": sorted(result.files), "manifest": result.manifest}
        data = json.dumps(stated, allow_nan=False).encode()
        if self._objects.create(_name(key), data):
            return result
        there = self._objects.read(_name(key))
        if there == data:  # the answer to our own commit was lost
            return result
        if there is None:
            raise InfrastructureError(
                f"{self.url}/{_name(key)}: it exists, and cannot be read",
                "try again",
            )
        return self._result(key, json.loads(there))

    def publish(self, root: Path, names: Sequence[str]) -> None:
        """Copy files of a finished run folder to the store; ``latest`` names them when all are
        there.
        """
        attempt = f"tables/{os.urandom(8).hex()}"
        for name in names:
            self._objects.write(f"{attempt}/{name}", (root / name).read_bytes())
        self._objects.write("latest", attempt.encode())

    def _result(self, key: str, stated: dict[str, Any]) -> RolloutResult:
        files = {}
        for name in stated["files"]:
            data = self._objects.read(f"{stated['attempt']}/{name}")
            facts = stated["manifest"]["files"].get(name)
            if data is None or (facts and hashlib.sha256(data).hexdigest() != facts["sha256"]):
                raise InfrastructureError(
                    f"{self.url}/{_name(key)}: {name} is {'missing' if data is None else 'not what was committed'}",
                    "remove that commit; the same command then drives the rollout again",
                )
            files[name] = data
        return RolloutResult(stated["manifest"], files)


def _name(key: str) -> str:
    return f"commits/{key[:2]}/{key}.json"


@dataclass
class Index:
    """Which keys are committed, so that a restarted driver need not ask for each. Written by
    drivers, also by several at once.

    A key that is committed but in no part is found by the worker that is about to drive it.
    """

    objects: Objects
    keys: set[str] = field(default_factory=set)
    _new: list[str] = field(default_factory=list)
    _parts: int = 0
    _written_s: float = field(default_factory=time.monotonic)

    def load(self) -> None:
        """Read the parts that are there and were not read yet: one question a part, and one
        more.
        """
        while (part := self.objects.read(_part(self._parts))) is not None:
            self.keys |= set(json.loads(part))
            self._parts += 1

    def add(self, keys: Iterable[str]) -> None:
        """Take in committed keys, and write a part when it is due."""
        self._new += [key for key in keys if key not in self.keys]
        self.keys |= set(self._new)
        if len(self._new) >= PART_KEYS or (
            self._new and time.monotonic() - self._written_s >= PART_S
        ):
            self.flush()

    def flush(self) -> None:
        """Write what is new as a part; a number that another driver took is read instead."""
        while self._new:
            if self.objects.create(_part(self._parts), json.dumps(self._new).encode()):
                self._new = []
                self._parts += 1
            else:
                self.load()
        self._written_s = time.monotonic()


def _part(number: int) -> str:
    return f"index/{number:06d}.json"


class KnownCommits:
    """The driver's view of a store: what it knows to be committed.

    Args:
        commits: The store.
        options: Of the run.
        reuse_undigested: Also reuse rollouts with parts that have no digest.
    """

    def __init__(self, commits: Commits, options: RunOptions, reuse_undigested: bool) -> None:
        self.commits, self._options = commits, options
        self.fresh = "" if reuse_undigested else os.urandom(8).hex()
        commits.index.load()

    def find(self, cell: Cell) -> RolloutResult | None:
        """Return a rollout that the index names."""
        key = commit_key(cell, self._options, self.fresh)
        return self.commits.find(key) if key in self.commits.index.keys else None

    def add(self, cell: Cell, manifest: Mapping[str, Any]) -> None:
        """Take in a rollout that a worker has committed."""
        if manifest["status"] == "ok":
            self.commits.index.add([commit_key(cell, self._options, self.fresh)])


def commit_key(cell: Cell, options: RunOptions, fresh: str = "") -> str:
    """Return the name of a rollout in a store: a digest of everything that decides its log and its
    pictures.

    Args:
        cell: The rollout.
        options: Of the run.
        fresh: Makes the key of a rollout with a part that has no digest another one, so that it is
            driven again; empty: it may be reused.
    """
    return digest(
        [cell.rollout_key, options.video, cell.stops_at_path_end, fresh if cell.undigested else ""]
    )


def run_stored_cell(
    cell: Cell,
    options: RunOptions,
    root: Path,
    threads: int,
    store: str,
    fresh: str = "",
    load: Callable[[ScenarioRef], Scenario] | None = None,
) -> dict[str, Any]:
    """Take a cell from the store, or run and commit it; return its manifest. Failed rollouts are
    not committed.

    Args:
        cell, options, root, threads, load: As for `alpasim_plugin.runs.cell.run_cell`.
        store: URL.
        fresh: As for `commit_key`.

    Raises:
        InfrastructureError: The store does not answer, or holds a damaged rollout.
    """
    commits, key = opened(store), commit_key(cell, options, fresh)
    known = commits.find(key)
    if known is not None:
        return unpack(known, root)
    manifest = run_cell(cell, options, root, threads, load=load)
    if manifest["status"] != "ok":
        return manifest
    own = pack(root / cell.folder, socket.gethostname())
    first = commits.commit(key, own)
    return manifest if first is own else unpack(first, root)


@lru_cache(maxsize=4)
def opened(store: str) -> Commits:
    """Return the store of a URL, opened once per process."""
    return Commits(store)
