"""Drive a cell unless the store has it, and commit it there: the work of a worker, wherever it runs, of a run with ``--store``."""

from __future__ import annotations

import socket
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from alpasim_plugin.core.types import Scenario
from alpasim_plugin.plugins.parts import digest
from alpasim_plugin.runtime.cell import run_cell
from alpasim_plugin.runtime.executors.parcel import pack, unpack
from alpasim_plugin.runtime.plan import Cell, RunOptions
from alpasim_plugin.runtime.stores.commits import Commits
from scenarios.suite import ScenarioRef


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
