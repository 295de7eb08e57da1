"""A finished rollout on its way from a node to the run folder: its manifest and its files."""

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
from typing import Any

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.io.atomic import disk_error
from alpasim_plugin.plugins.parts import digest
from alpasim_plugin.run_folder.manifests import read_manifest, write_manifest
from alpasim_plugin.run_folder.schema import DERIVED, DRIVEN, MANIFEST, OUTPUT_NAME
from alpasim_plugin.runtime.cell import run_cell
from alpasim_plugin.runtime.objects import Objects, open_objects
from alpasim_plugin.runtime.plan import Cell, RunOptions
from scenarios.suite import ScenarioRef

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
    names = list(manifest["files"]) or [OUTPUT_NAME]  # of a failed rollout only what its parts printed
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
            where = f"{result.manifest['path']}/{name} from {result.manifest['node']}"
            raise InfrastructureError("receiving a rollout", where, "not the content that the node wrote", "give the same command again")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (MANIFEST, *NAMES):  # the manifest first: without it nothing is trusted
            (folder / name).unlink(missing_ok=True)
        for name, data in result.files.items():
            (folder / name).write_bytes(data)
    except OSError as error:
        raise disk_error(folder, error, "writing a rollout") from error
    manifest = {name: value for name, value in result.manifest.items() if name != "files"}
    write_manifest(folder, manifest)
    return manifest


DOING = "reading a rollout from a store"
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
            InfrastructureError: A file is missing or not what was committed, or the store does not answer.
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
            raise InfrastructureError("committing a rollout", f"{self.url}/{_name(key)}", "it exists, and cannot be read", "try again")
        return self._result(key, json.loads(there))

    def publish(self, root: Path, names: Sequence[str]) -> None:
        """Copy files of a finished run folder to the store; ``latest`` names them when all are there."""
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
                found = f"{name} is {'missing' if data is None else 'not what was committed'}"
                do_this = "remove that commit; the same command then drives the rollout again"
                raise InfrastructureError(DOING, f"{self.url}/{_name(key)}", found, do_this)
            files[name] = data
        return RolloutResult(stated["manifest"], files)


def _name(key: str) -> str:
    return f"commits/{key[:2]}/{key}.json"


@dataclass
class Index:
    """Which keys are committed, so that a restarted driver need not ask for each. Written by drivers, also by several at once.

    A key that is committed but in no part is found by the worker that is about to drive it.
    """

    objects: Objects
    keys: set[str] = field(default_factory=set)
    _new: list[str] = field(default_factory=list)
    _parts: int = 0
    _written_s: float = field(default_factory=time.monotonic)

    def load(self) -> None:
        """Read the parts that are there and were not read yet: one question a part, and one more."""
        while (part := self.objects.read(_part(self._parts))) is not None:
            self.keys |= set(json.loads(part))
            self._parts += 1

    def add(self, keys: Iterable[str]) -> None:
        """Take in committed keys, and write a part when it is due."""
        self._new += [key for key in keys if key not in self.keys]
        self.keys |= set(self._new)
        if len(self._new) >= PART_KEYS or (self._new and time.monotonic() - self._written_s >= PART_S):
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
    """Return the name of a rollout in a store: a digest of everything that decides its log and its pictures.

    Args:
        cell: The rollout.
        options: Of the run.
        fresh: Makes the key of a rollout with a part that has no digest another one, so that it is driven again; empty: it may be reused.
    """
    return digest([cell.rollout_key, options.video, cell.stops_at_path_end, fresh if cell.undigested else ""])


def run_stored_cell(
    cell: Cell,
    options: RunOptions,
    root: Path,
    threads: int,
    store: str,
    fresh: str = "",
    load: Callable[[ScenarioRef], Scenario] | None = None,
) -> dict[str, Any]:
    """Take a cell from the store, or run and commit it; return its manifest. Failed rollouts are not committed.

    Args:
        cell, options, root, threads, load: As for `alpasim_plugin.runtime.cell.run_cell`.
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
