"""Snapshots of a training: its averaged weights at equal intervals, and the processor time that
each took.

    FOLDER/snapshots/UPDATE.safetensors   a bundle each
    FOLDER/log.jsonl                      ``core_s``, the processor time of every update

An update that was repeated after an interruption has one row in the log, so it counts once.
"""

from __future__ import annotations

from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import read_json_lines
from alpasim_plugin.lab.training.trainer import CORE_S, LOG_FILE

SNAPSHOTS = "snapshots"
DOING = "reading the time of a training"


class Snapshot(NamedTuple):
    """Weights after ``step`` updates that took ``core_s`` seconds of processor time together."""

    step: int
    core_s: float
    path: Path


def snapshot_steps(updates: int, count: int) -> frozenset[int]:
    """Return the updates after which snapshots are kept: ``count`` of them at equal intervals, the
    last one included.

    Example:
        >>> sorted(snapshot_steps(20, 4)), sorted(snapshot_steps(3, 8)), sorted(snapshot_steps(20, 0))
        ([5, 10, 15, 20], [1, 2, 3], [])
    """
    return frozenset(step for k in range(1, count + 1) if (step := round(k * updates / count)) > 0)


def snapshot_file(folder: Path, step: int) -> Path:
    """Return where the snapshot after an update is kept."""
    return folder / SNAPSHOTS / f"{step:06d}.safetensors"


def core_seconds(folder: Path) -> list[float]:
    """Return the processor time that a training had taken after each of its updates; evaluation and
    set-up are not part of it.

    Raises:
        InputError: No log, or one without times of the processor.
    """
    path = folder / LOG_FILE
    rows = read_json_lines(path)
    if [row.get("step") for row in rows] != list(range(1, len(rows) + 1)):
        raise InputError(
            f"{path}: rows that are not one for each update in order",
            "train in another folder",
        )
    if not rows or any(CORE_S not in row for row in rows):
        raise InputError(
            f"{path}: updates without {CORE_S!r}",
            "train again: the log of an earlier version has no processor time",
        )
    return list(accumulate(float(row[CORE_S]) for row in rows))


def snapshots_of(folder: Path) -> list[Snapshot]:
    """Return a training's snapshots in order.

    Raises:
        InputError: There is none, or one of an update that is not in the log.
    """
    paths = sorted((folder / SNAPSHOTS).glob("*.safetensors"))
    times = core_seconds(folder)
    if not paths or int(paths[-1].stem) > len(times):
        found = (
            "no snapshots"
            if not paths
            else f"a snapshot of update {int(paths[-1].stem)} and a log of {len(times)}"
        )
        raise InputError(f"{folder / SNAPSHOTS}: {found}", "train with --snapshots 8")
    return [Snapshot(int(path.stem), times[int(path.stem) - 1], path) for path in paths]
