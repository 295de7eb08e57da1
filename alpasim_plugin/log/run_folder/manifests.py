"""The files that state what a run folder holds, so that nothing damaged is trusted: each ends with
the checksum of its own content.

``manifest.json`` of a rollout says what it is, how it went, and states the digests of its files; it
is written last. ``run.json`` describes the run. ``contents.json`` states the tables, the scene
files, AlpaSim's aggregation and the checksum of every manifest, and holds a copy of ``run.json``.
It is removed when a run begins and written last: a folder without it is unfinished.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from alpasim_plugin.core.checksums import (
    FileFacts,
    checksums_of,
    problem_of,
    read_sealed,
    write_sealed,
)
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading.files import as_shape
from alpasim_plugin.log.run_folder.schema import (
    AGGREGATE,
    CONTENTS,
    DERIVED,
    DRIVEN,
    MANIFEST,
    RUN_INFO,
    SCENES,
    STEPS_NAME,
    TABLES,
)
from alpasim_plugin.log.run_folder.shapes import (
    REQUIRED_OF_RUN,
    ContentsFile,
    ManifestFile,
    RunInfo,
)

AGAIN = "give the command of the run again: finished rollouts are kept"
DOING_ROLLOUT, DRIVE_AGAIN = "reading a rollout", "simrun check RUN --repair runs the rollout again"

RepairAction = Literal["none", "score", "drive"]


@dataclass(frozen=True)
class Damage:
    """One damaged or missing file of a run folder.

    Attributes:
        cell: Folder of the rollout below the run folder; empty for a file of the run itself.
        file: Its name.
        problem: What is wrong with it.
    """

    cell: str
    file: str
    problem: str

    def __str__(self) -> str:
        return f"{f'{self.cell}/' if self.cell else ''}{self.file}: {self.problem}"


@dataclass(frozen=True)
class RolloutState:
    """A rollout's folder as it is found.

    Attributes:
        manifest: None where it is missing or damaged.
        checksum: Of the manifest; empty without one.
        damage: Damaged files; a rollout without a manifest that was never finished is unfinished,
            not damaged.
    """

    manifest: dict[str, Any] | None
    checksum: str
    damage: tuple[Damage, ...]

    @property
    def action(self) -> RepairAction:
        """Say what makes the rollout whole again: nothing, scoring its log, or driving."""
        if self.manifest is None or any(one.file not in DERIVED for one in self.damage):
            return "drive"
        return "score" if self.damage else "none"


@dataclass(frozen=True)
class Contents:
    """What `read_contents` found.

    Attributes:
        files: Path below the run folder -> size, time and digest.
        rollouts: Folder of a rollout below the run folder -> checksum of its manifest, in the order
            of the tables.
        run: A copy of ``run.json``.
    """

    files: Mapping[str, FileFacts]
    rollouts: Mapping[str, str]
    run: Mapping[str, Any]


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write the manifest of a rollout with the digests of the files that are there; those of a
    failed rollout are not stated.

    Raises:
        InfrastructureError: The disk refuses.
    """
    files = checksums_of(folder, [*DRIVEN, *DERIVED]) if manifest.get("status") == "ok" else {}
    write_sealed(folder / MANIFEST, {**manifest, "files": files})


def read_manifest(folder: Path) -> tuple[dict[str, Any], str]:
    """Read a manifest and its checksum.

    Raises:
        InputError: It is missing, damaged, or lacks what every manifest has.
    """
    path = folder / MANIFEST
    manifest, checksum = read_sealed(path, DRIVE_AGAIN)
    as_shape(ManifestFile, manifest, path, DRIVE_AGAIN)
    others = sorted(set(manifest["files"]) - {*DRIVEN, *DERIVED})
    if others:
        raise InputError(f"{path}: it states {others[0]!r}, which no rollout has", DRIVE_AGAIN)
    if manifest["status"] == "ok" and STEPS_NAME not in manifest["files"]:
        raise InputError(f"{path}: it does not state {STEPS_NAME}", DRIVE_AGAIN)
    return manifest, checksum


def inspect_rollout(root: Path, cell: str, full: bool = False, known: bool = False) -> RolloutState:
    """Compare a rollout's folder with its manifest.

    Args:
        root: The run folder.
        cell: The rollout's folder below it.
        full: Read every file, whatever its size and time.
        known: The rollout was finished once, so that a missing manifest is damage.
    """
    folder = root / cell
    if not (folder / MANIFEST).exists():
        return RolloutState(None, "", (Damage(cell, MANIFEST, "missing"),) if known else ())
    try:
        manifest, checksum = read_manifest(folder)
    except InputError as error:
        return RolloutState(None, "", (Damage(cell, MANIFEST, error.message),))
    return RolloutState(manifest, checksum, tuple(_damage(folder, cell, manifest["files"], full)))


def write_run_json(root: Path, info: Mapping[str, Any]) -> None:
    """Write ``run.json`` with its checksum."""
    write_sealed(root / RUN_INFO, info)


def read_run_json(root: Path) -> dict[str, Any]:
    """Read ``run.json``, as far as commands rely on it.

    Raises:
        InputError: It is missing, damaged, or a member is missing or has another type.
    """
    path = root / RUN_INFO
    info, _ = read_sealed(path, AGAIN)
    as_shape(RunInfo, info, path, AGAIN)
    missing = [name for name in REQUIRED_OF_RUN if name not in info]
    if missing:
        raise InputError(f"{path}: {missing[0]}: missing", AGAIN)
    return info


def write_contents(root: Path, rollouts: Mapping[str, str]) -> None:
    """State what a run folder holds; the last write of a run.

    Args:
        root: The run folder.
        rollouts: As in `Contents`.

    Raises:
        InfrastructureError: The disk refuses.
        InputError: ``run.json`` is not as it was written.
    """
    more = sorted(
        path.relative_to(root).as_posix()
        for name in (SCENES, AGGREGATE)
        for path in (root / name).glob("*.*")
    )
    run, _ = read_sealed(root / RUN_INFO, AGAIN)
    stated = {"files": checksums_of(root, [*TABLES, *more]), "rollouts": dict(rollouts), "run": run}
    write_sealed(root / CONTENTS, stated)


def read_contents(root: Path) -> Contents:
    """Read what `write_contents` wrote.

    Raises:
        InputError: It is missing or damaged.
    """
    path = root / CONTENTS
    found, _ = read_sealed(path, AGAIN)
    contents = as_shape(ContentsFile, cast(ContentsFile, found), path, AGAIN)
    for name in (*contents["files"], *contents["rollouts"]):
        if not (root / name).resolve().is_relative_to(root.resolve()):
            raise InputError(f"{path}: {name!r} leads out of the run folder", AGAIN)
    return Contents(contents["files"], contents["rollouts"], contents["run"])


def find_contents(root: Path) -> Contents | None:
    """Return the contents of a run folder; None where they are missing or damaged."""
    try:
        return read_contents(root)
    except InputError:
        return None


def damaged_files(root: Path, contents: Contents, full: bool = False) -> list[Damage]:
    """Return the damaged tables and scene files of a run folder; ``full`` as for
    `inspect_rollout`.
    """
    return _damage(root, "", contents.files, full)


def _damage(folder: Path, cell: str, files: Mapping[str, FileFacts], full: bool) -> list[Damage]:
    found = [(name, problem_of(folder / name, facts, full)) for name, facts in files.items()]
    return [Damage(cell, name, problem) for name, problem in found if problem is not None]
