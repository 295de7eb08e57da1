"""Stages of a long experiment: each is one command of simrun in a folder of its own.

A stage's key is a digest of what makes its results: the words of its command, what else it states,
and the keys of the stages that it reads. Its folder is OUT/stages/NAME-KEY, in which `MARKER` is
written last. So a changed stage and all that read it are made again, and nothing else is.

A stage that names its `products` can be kept: they and the marker lie in KEPT/NAME, and stand for the
stage wherever its key is the same, on another machine too. What only made them is then not made.
"""

from __future__ import annotations

import hashlib
import json
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.files import read_bytes, read_json_object
from alpasim_plugin.core.files.atomic import write_bytes, write_json
from alpasim_plugin.core.parts.source import package_digest

MARKER = "stage.json"
FOLDER = "stages"
KEY_DIGITS = 12
WEIGHTS = (".safetensors", ".pt")
OWN = "out"  # the placeholder of a stage's folder
State = Literal["done", "begun", "open"]
Execute = Callable[[Sequence[str]], None]
Report = Callable[["Placed", State], None]


@dataclass(frozen=True)
class Stage:
    """One command, and what its results depend on.

    Attributes:
        name: Unique among the stages.
        command: Words after ``simrun`` that determine the results; ``{out}`` stands for the stage's
            folder, ``{NAME}`` for that of a stage which it reads.
        reads: Names of the stages whose results it uses.
        facts: What else determines the results, such as versions and digests of files.
        effort: Further words of the command on which the results do not depend, such as the number
            of processes.
        budget: What it costs, in words.
        products: Files of its folder that are all that other stages and the tables read; none where
            the stage is made again on every machine.
    """

    name: str
    command: tuple[str, ...]
    reads: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    effort: tuple[str, ...] = ()
    budget: str = ""
    products: tuple[str, ...] = ()

    @property
    def is_training(self) -> bool:
        """Whether its products are weights."""
        return any(name.endswith(WEIGHTS) for name in self.products)

    @property
    def is_measurement(self) -> bool:
        """Whether its products are records for the tables."""
        return bool(self.products) and not self.is_training


@dataclass(frozen=True)
class Placed:
    """A stage with its key and its place on disk.

    Attributes:
        stage: The stage.
        key: Digest of what makes its results.
        folder: Where they lie.
        words: The whole command after ``simrun``, with paths.
    """

    stage: Stage
    key: str
    folder: Path
    words: tuple[str, ...]

    @property
    def state(self) -> State:
        """Whether its results are complete, begun, or not there."""
        if (self.folder / MARKER).is_file():
            return "done"
        return "begun" if self.folder.is_dir() else "open"

    @property
    def record(self) -> Mapping[str, Any]:
        """Read the marker of a complete stage.

        Raises:
            InputError: There is none, or it is of another stage.
        """
        marker = read_json_object(self.folder / MARKER)
        if marker.get("key") != self.key:
            raise InputError(
                f"{self.folder / MARKER}: key {marker.get('key')!r}, not {self.key!r}",
                "Remove the folder; the same command makes it again.",
            )
        return marker


def place(stages: Sequence[Stage], out: Path) -> list[Placed]:
    """Return stages with their keys and folders below ``OUT/stages``.

    Args:
        stages: In an order in which each stands after those that it reads.
        out: Folder of the experiment.

    Raises:
        InputError: Two of one name, or one that reads a stage which does not stand before it.
    """
    placed: dict[str, Placed] = {}
    for stage in stages:
        absent = [name for name in stage.reads if name not in placed]
        if stage.name in placed or absent:
            problem = f"it reads {absent[0]}" if absent else "there are two of that name"
            raise InputError(
                f"stage {stage.name}: {problem}", "Name every stage once, after those it reads."
            )
        facts = [
            stage.name,
            stage.command,
            {name: placed[name].key for name in stage.reads},
            dict(stage.facts),
        ]
        text = json.dumps(facts, sort_keys=True)
        key = hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]
        folder = out / FOLDER / f"{stage.name}-{key}"
        folders = {name: str(placed[name].folder) for name in stage.reads}
        words = [
            word.format_map({OWN: str(folder), **folders})
            for word in (*stage.command, *stage.effort)
        ]
        placed[stage.name] = Placed(stage, key, folder, tuple(words))
    return list(placed.values())


def needed(placed: Sequence[Placed]) -> list[Placed]:
    """Return the stages whose results are wanted: those that no other reads, and what a wanted stage
    reads that is not complete.

    Args:
        placed: The stages, each after those that it reads.
    """
    read_by_any = {name for item in placed for name in item.stage.reads}
    wanted = {item.stage.name for item in placed} - read_by_any
    for item in reversed(placed):
        if item.stage.name in wanted and item.state != "done":
            wanted.update(item.stage.reads)
    return [item for item in placed if item.stage.name in wanted]


def run_stages(
    placed: Sequence[Placed],
    execute: Execute,
    report: Report,
    finished: Callable[[Placed], None] = lambda item: None,
) -> None:
    """Run the stages that are needed and not complete, in order; a begun one goes on from its
    checkpoints.

    Args:
        placed: The stages.
        execute: Runs the words of a command, and raises where it fails.
        report: Called with every stage and its state before it is run or reused.
        finished: Called with every stage that was run.

    Raises:
        InfrastructureError: A command ended without an error, and without results.
        InputError: A marker is of another stage.
    """
    for item in needed(placed):
        state = item.state
        report(item, state)
        if state == "done":
            _ = item.record
            continue
        began_s = time.monotonic()
        began_core_s = core_seconds()
        execute(item.words)
        if not item.folder.is_dir():
            raise InfrastructureError(
                f"stage {item.stage.name}: no folder {item.folder} after its command",
                "Run the command by itself: simrun " + " ".join(item.words),
            )
        write_json(
            item.folder / MARKER,
            {
                "stage": item.stage.name,
                "key": item.key,
                "command": ["simrun", *item.stage.command],
                "effort": list(item.stage.effort),
                "facts": dict(item.stage.facts),
                "reads": list(item.stage.reads),
                "program": package_digest(),
                "core_s_of_last_call": round(core_seconds() - began_core_s, 1),
                "s_of_last_call": round(time.monotonic() - began_s, 1),
                "was_resumed": state == "begun",
            },
        )
        finished(item)


def keep_stage(item: Placed, kept: Path) -> None:
    """Copy the products and the marker of a complete stage to KEPT/NAME, unless they are there; nothing
    of a stage without products.
    """
    if item.stage.products and item.state == "done" and not is_kept(item, kept):
        _copy(item.stage.products, item.folder, kept / item.stage.name)


def is_kept(item: Placed, kept: Path) -> bool:
    """Whether a kept folder has a stage with the same key."""
    path = kept / item.stage.name / MARKER
    return (
        bool(item.stage.products)
        and path.is_file()
        and read_json_object(path).get("key") == item.key
    )


def restore(item: Placed, kept: Path) -> None:
    """Copy the products and the marker of a kept stage with the same key to the stage's folder,
    unless it is complete.

    Raises:
        InputError: A product is missing, or the marker cannot be read.
    """
    if item.state != "done" and is_kept(item, kept):
        _copy(item.stage.products, kept / item.stage.name, item.folder)


def _copy(products: Sequence[str], source: Path, target: Path) -> None:
    for name in (*products, MARKER):
        write_bytes(target / name, read_bytes(source / name))


def why_not_restored(item: Placed, kept: Path) -> str:
    """Return in words why a kept folder does not stand for a stage."""
    path = kept / item.stage.name / MARKER
    if not path.is_file():
        return f"no {path}"
    marker = read_json_object(path)
    theirs = list(marker["command"][1:])
    ours = list(item.stage.command)
    if theirs == ours:
        return f"{path} is of the same command, on other weights or data"
    differing = [
        f"{' '.join(ours[max(i - 1, 0) : i + 1])}, kept {theirs[i]}"
        for i in range(min(len(ours), len(theirs)))
        if ours[i] != theirs[i]
    ]
    return f"{path} is of another command: {differing[0] if differing else ' '.join(theirs)}"


def core_seconds() -> float:
    """Return the processor time of this process and of its ended children, seconds."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
