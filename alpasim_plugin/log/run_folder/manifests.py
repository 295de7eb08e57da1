"""The two descriptions in a run folder: ``run.json``, and ``manifest.json`` of each rollout.

A manifest is written last and holds the digests of the rollout's files. A rollout without one is
unfinished; one whose files differ from their digests is damaged. Both are driven again by the same
command.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parse_json, read_bytes, read_record, real
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.files.limits import JSON_BYTES
from alpasim_plugin.log.run_folder.checksums import (
    FileFacts,
    check_seal,
    checksums_of,
    problem_of,
    sealed,
)
from alpasim_plugin.log.run_folder.records import Manifest, RunInfo, json_of
from alpasim_plugin.log.run_folder.schema import (
    DERIVED,
    DRIVEN,
    MANIFEST,
    RUN_INFO,
    STEPS_NAME,
)

AGAIN = "Give the command of the run again: finished rollouts are kept."

Action = Literal["none", "score", "drive"]


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

    @property
    def path(self) -> Path:
        """Give the file's path below the run folder."""
        return Path(self.cell, self.file)

    def __str__(self) -> str:
        return f"{self.path}: {self.problem}"


@dataclass(frozen=True)
class RolloutState:
    """A rollout's folder as it is on disk.

    Attributes:
        manifest: None where the rollout is unfinished or its manifest is damaged.
        damage: Damaged files.
    """

    manifest: Manifest | None
    damage: tuple[Damage, ...] = ()

    @property
    def action(self) -> Action:
        """Return what completes the rollout: nothing, scoring its log, or driving."""
        if self.manifest is None or any(damage.file not in DERIVED for damage in self.damage):
            return "drive"
        return "score" if self.damage else "none"


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a rollout with the digests of its files; a failed rollout has none.

    Raises:
        InfrastructureError: The disk refuses.
    """
    files: dict[str, FileFacts] = {}
    if manifest.ok:
        files = checksums_of(folder, [*DRIVEN, *DERIVED])
    write_json(folder / MANIFEST, sealed(json_of(replace(manifest, files=files))))


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a rollout.

    Raises:
        InputError: It is missing, damaged, or names a file that no rollout has.
    """
    path = folder / MANIFEST
    data = read_bytes(path, JSON_BYTES, AGAIN)
    content = parse_json(data, path, AGAIN)
    manifest = read_record(Manifest, data, path, AGAIN)
    if "files" not in content:
        raise InputError(f"{path}: files: missing", AGAIN)
    check_seal(content, path, AGAIN)
    others = sorted(set(manifest.files) - {*DRIVEN, *DERIVED})
    if others:
        raise InputError(f"{path} names {others[0]!r}, which no rollout has.", AGAIN)
    if manifest.ok and STEPS_NAME not in manifest.files:
        raise InputError(f"{path} does not name {STEPS_NAME}.", AGAIN)
    return manifest


def inspect_rollout(root: Path, cell: str, full: bool = False) -> RolloutState:
    """Compare a rollout's folder with its manifest.

    Args:
        root: The run folder.
        cell: The rollout's folder below it.
        full: Read every file, even where size and time are as stated.

    Raises:
        InputError: A link leads out of the run folder, so nothing is read or written there.
    """
    folder = root / cell
    if not real(folder).is_relative_to(real(root)):
        raise InputError(
            f"{folder}: a link leads out of the run folder",
            "move what it leads to into the run folder, or drive it again into another one",
        )
    if not os.path.exists(folder / MANIFEST):
        return RolloutState(None)
    try:
        manifest = read_manifest(folder)
    except InputError as error:
        return RolloutState(None, (Damage(cell, MANIFEST, error.message),))
    damage = []
    if manifest.path != cell:
        damage.append(Damage(cell, MANIFEST, f"of another rollout, {manifest.path}"))
    for name, facts in manifest.files.items():
        problem = problem_of(folder / name, facts, full)
        if problem is not None:
            damage.append(Damage(cell, name, problem))
    return RolloutState(manifest, tuple(damage))


def write_run_json(root: Path, info: RunInfo) -> None:
    """Write ``run.json``. It is then the newest beside those of the folders beside, also where the
    clock was set back since they were written.
    """
    path = root / RUN_INFO
    write_json(path, json_of(info))
    folder = root.absolute()
    others = [file for file in folder.parent.glob(f"*/{RUN_INFO}") if file.parent != folder]
    latest_ns = max(map(_written_ns, others), default=0)
    if latest_ns >= _written_ns(path):
        os.utime(path, ns=(latest_ns + 1, latest_ns + 1))


def _written_ns(path: Path) -> int:
    """Return when a file was written, nanoseconds by the wall clock; 0 where it is gone."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def read_run_json(root: Path) -> RunInfo:
    """Read ``run.json``.

    Raises:
        InputError: It is missing or damaged, or a member is missing or has another type.
    """
    path = root / RUN_INFO
    data = read_bytes(path, JSON_BYTES, AGAIN)
    parse_json(data, path, AGAIN)  # refuses what no reader should take
    return read_record(RunInfo, data, path, AGAIN)
