"""``contents.json``: what a finished run folder holds. It is removed when a run begins and written last: a folder without it is unfinished.

It states size, time and SHA-256 of the tables, scene files and AlpaSim's aggregation, the seal of every rollout's manifest, and a copy of
``run.json``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.checksums import FileFacts, checksums_of, problem_of, read_sealed, write_sealed
from alpasim_plugin.io.reading.files import as_shape
from alpasim_plugin.runtime.manifests import Damage

CONTENTS, RUN_INFO, SCENES, AGGREGATE = "contents.json", "run.json", "scenes", "aggregate"
SUMMARY, ROLLOUTS, STEPS = "summary.json", "rollouts.parquet", "steps.parquet"
TABLES = (SUMMARY, ROLLOUTS, STEPS)  # made from the manifests
PAGES = ("report.html", "flips.html")
REPORTS = (*PAGES, "summary.md", "junit.xml")  # made from the tables; nothing reads them
DOING = "reading a run folder"
AGAIN = "give the command of the run again: finished rollouts are kept"


class _Shape(TypedDict):
    files: dict[str, FileFacts]
    rollouts: dict[str, str]
    run: dict[str, Any]


@dataclass(frozen=True)
class Contents:
    """What `read_contents` found.

    Attributes:
        files: Path below the run folder -> what is stated of it.
        rollouts: Folder of a rollout below the run folder -> seal of its manifest, in the order of the tables.
        run: A copy of ``run.json``.
    """

    files: Mapping[str, FileFacts]
    rollouts: Mapping[str, str]
    run: Mapping[str, Any]


def write_contents(root: Path, rollouts: Mapping[str, str]) -> None:
    """State what a run folder holds; the last write of a run.

    Args:
        root: The run folder.
        rollouts: As in `Contents`.

    Raises:
        InfrastructureError: The disk refuses.
        InputError: ``run.json`` is not as it was written.
    """
    more = sorted(path.relative_to(root).as_posix() for name in (SCENES, AGGREGATE) for path in (root / name).glob("*.*"))
    run, _ = read_sealed(root / RUN_INFO, DOING, AGAIN)
    stated = {"files": checksums_of(root, [*TABLES, *more]), "rollouts": dict(rollouts), "run": run}
    write_sealed(root / CONTENTS, stated, "writing the contents of a run")


def read_contents(root: Path) -> Contents:
    """Read what `write_contents` wrote.

    Raises:
        InputError: It is missing or damaged.
    """
    path = root / CONTENTS
    found, _ = read_sealed(path, DOING, AGAIN)
    shaped = as_shape(_Shape, found, path, DOING, AGAIN)
    for name in (*shaped["files"], *shaped["rollouts"]):
        if not (root / name).resolve().is_relative_to(root.resolve()):
            raise InputError(DOING, str(path), f"{name!r} leads out of the run folder", AGAIN)
    return Contents(shaped["files"], shaped["rollouts"], shaped["run"])


def find_contents(root: Path) -> Contents | None:
    """Return the contents of a run folder; None where they are missing or damaged."""
    try:
        return read_contents(root)
    except InputError:
        return None


def damaged_files(root: Path, contents: Contents, full: bool = False) -> list[Damage]:
    """Return the damaged tables and scene files of a run folder; ``full`` as in `alpasim_plugin.io.checksums.problem_of`."""
    found = ((name, problem_of(root / name, facts, full)) for name, facts in contents.files.items())
    return [Damage("", name, problem) for name, problem in found if problem is not None]


def write_run_json(root: Path, info: Mapping[str, Any]) -> None:
    """Write ``run.json`` with its seal."""
    write_sealed(root / RUN_INFO, info, "writing a run")


def read_run_json(root: Path) -> dict[str, Any]:
    """Read ``run.json``, as far as commands rely on it.

    Raises:
        InputError: It is missing, damaged, or a member has another type.
    """
    info, _ = read_sealed(root / RUN_INFO, DOING, AGAIN)
    return cast("dict[str, Any]", as_shape(_RunShape, info, root / RUN_INFO, DOING, AGAIN))


class _RunShape(TypedDict):
    key: str
    command: list[str]
    config: dict[str, Any]
    preset: str
    renderers: list[str]
    policies: list[str]
    seeds: list[int]
    scenes: dict[str, dict[str, Any]]
