"""The manifest of a rollout: what it is, how it went, and the digests of its files. A rollout is trusted only as far as they agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.checksums import FileFacts, checksums_of, problem_of, read_sealed, write_sealed
from alpasim_plugin.io.reading.files import as_shape
from alpasim_plugin.runtime.pictures import STRIP_NAME, VIDEO_NAME
from alpasim_plugin.runtime.recorder import FRAMES_NAME, LOG_NAME, OUTPUT_NAME

MANIFEST, STEPS_NAME = "manifest.json", "steps.parquet"
DRIVEN = (LOG_NAME, FRAMES_NAME, STRIP_NAME, VIDEO_NAME, OUTPUT_NAME)  # files that only driving makes
DERIVED = (STEPS_NAME,)  # files that scoring makes from the log
DOING, DO_THIS = "reading a rollout", "simrun check RUN --repair runs the rollout again"

Remedy = Literal["none", "score", "drive"]


class _Shape(TypedDict):
    files: dict[str, FileFacts]
    renderer: str
    policy: str
    scene: str
    path: str
    status: str


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
        seal: Of the manifest; empty without one.
        damage: Damaged files; a rollout without a manifest that nobody vouched for is unfinished, not damaged.
    """

    manifest: dict[str, Any] | None
    seal: str
    damage: tuple[Damage, ...]

    @property
    def remedy(self) -> Remedy:
        """Say what makes the rollout whole again: nothing, scoring its log, or driving."""
        if self.manifest is None or any(one.file not in DERIVED for one in self.damage):
            return "drive"
        return "score" if self.damage else "none"


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write the manifest of a rollout, which vouches for the files that are there; those of a failed rollout it does not.

    Raises:
        InfrastructureError: The disk refuses.
    """
    files = checksums_of(folder, [*DRIVEN, *DERIVED]) if manifest.get("status") == "ok" else {}
    write_sealed(folder / MANIFEST, {**manifest, "files": files}, "writing a rollout's manifest")


def read_manifest(folder: Path) -> tuple[dict[str, Any], str]:
    """Read a manifest and its seal.

    Raises:
        InputError: It is missing, damaged, or lacks what every manifest has.
    """
    manifest, seal = read_sealed(folder / MANIFEST, DOING, DO_THIS)
    as_shape(_Shape, manifest, folder / MANIFEST, DOING, DO_THIS)
    others = sorted(set(manifest["files"]) - {*DRIVEN, *DERIVED})
    if others:
        raise InputError(DOING, str(folder / MANIFEST), f"it vouches for {others[0]!r}, which no rollout has", DO_THIS)
    if manifest["status"] == "ok" and STEPS_NAME not in manifest["files"]:
        raise InputError(DOING, str(folder / MANIFEST), f"it does not vouch for {STEPS_NAME}", DO_THIS)
    return manifest, seal


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
        manifest, seal = read_manifest(folder)
    except InputError as error:
        return RolloutState(None, "", (Damage(cell, MANIFEST, error.found),))
    found = ((name, problem_of(folder / name, facts, full)) for name, facts in manifest["files"].items())
    return RolloutState(manifest, seal, tuple(Damage(cell, name, problem) for name, problem in found if problem is not None))
