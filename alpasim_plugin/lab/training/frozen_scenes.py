"""The test scenes as they were frozen before training began: hashes of their files, and the check
that they are still those.

``configs/fixers/test-scenes.json`` holds, by split, the SHA-256 of every scenario file by its name,
and one of all of them. Numbers on other scenes are not comparable with published ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_json_as

RECORD = Path(__file__).parents[3] / "configs" / "fixers" / "test-scenes.json"


@dataclass(frozen=True)
class FrozenSplit:
    """One split.

    Attributes:
        sha256: Of the lines ``NAME HASH`` of all scenes in order of name.
        scenes: File name without suffix to the SHA-256 of the file's bytes.
    """

    sha256: str
    scenes: Mapping[str, str]


class FrozenEntry(TypedDict):
    """A `FrozenSplit` in the record."""

    sha256: str
    scenes: dict[str, str]


def hash_scenes(folder: Path) -> FrozenSplit:
    """Hash the scenario files of a folder.

    Raises:
        InputError: There are none.
    """
    scenes = {
        path.stem: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("*.yaml"))
    }
    if not scenes:
        raise InputError(
            f"{folder}: no scenario",
            f"write them with 'simrun train scenes --split {folder.name}'",
        )
    lines = "".join(f"{name} {digest}\n" for name, digest in scenes.items())
    return FrozenSplit(hashlib.sha256(lines.encode()).hexdigest(), scenes)


def check_scenes(folder: Path, record: Path = RECORD) -> dict[str, FrozenSplit]:
    """Compare the splits below a folder of scenes with the record.

    Returns:
        The splits, which are those of the record.

    Raises:
        InputError: Another scene, one too few or one too many, or no readable record.
    """
    do_this = "give the record that ships: configs/fixers/test-scenes.json"
    entries = read_json_as(dict[str, FrozenEntry], record, do_this=do_this)
    recorded = {split: FrozenSplit(**entry) for split, entry in entries.items()}
    for split, frozen in recorded.items():
        hashes = hash_scenes(folder / split)
        differ = sorted({name for name, _ in frozen.scenes.items() ^ hashes.scenes.items()})
        if differ or hashes.sha256 != frozen.sha256:
            examples = ", ".join(differ[:5]) or "the hash of all scenes"
            raise InputError(
                f"{folder / split} against {record}: {max(len(differ), 1)} differ: {examples}",
                f"write the scenes again with 'simrun train scenes --split {split}', into an empty folder",
            )
    return recorded
