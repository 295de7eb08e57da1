"""What a run measures of a machine before it computes there: once for all processes of the run on a node.

Processes that measured each for itself would slow each other down while they do, and could choose differently. The first one that needs
a measurement takes it, the others wait and read it:

    FOLDER/NAME.json    FOLDER/NAME.lock
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from alpasim_plugin.io.atomic import write_json
from alpasim_plugin.io.lock import one_writer
from alpasim_plugin.io.reading.files import read_json_object

DOING = "measuring the machine"
KEPT_S = 7 * 86400.0  # a folder of an earlier run, which nobody else removes

_taken: dict[tuple[Path | None, str], Mapping[str, Any]] = {}
_folder: Path | None = None


def share_measurements(folder: Path | None) -> None:
    """Share what this process measures from now on with the others that name the same folder; None: with nobody.

    Args:
        folder: Of the run, on a file system of this node.
    """
    global _folder
    _folder = folder


def measured(name: str, measure: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return a measurement, taken by this process unless another one of the run on this node has.

    Args:
        name: What is measured; part of a file name.
        measure: Takes it; its values must fit into JSON.

    Raises:
        InfrastructureError: The folder cannot be written.
        InputError: The file was damaged.
    """
    folder = _folder
    if (folder, name) not in _taken:
        _taken[folder, name] = measure() if folder is None else _once(folder, name, measure)
    return _taken[folder, name]


def _once(folder: Path, name: str, measure: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
    path = folder / f"{name}.json"
    with one_writer(folder / f"{name}.lock", DOING, f"{name} of this machine", wait=True, waiting=lambda said: None):
        if not path.exists():
            _forget(folder.parent)
            write_json(path, measure(), DOING)
        return read_json_object(path, DOING)


def _forget(root: Path) -> None:
    """Remove folders of runs that began long ago."""
    for folder in root.iterdir():
        if folder.is_dir() and time.time() - folder.stat().st_mtime > KEPT_S:
            shutil.rmtree(folder, ignore_errors=True)  # another process may do the same
