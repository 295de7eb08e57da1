"""Stages of a long experiment: each is one command of simrun in a folder of its own.

A stage's key is a digest of what makes its results: the words of its command, what else it states,
and the keys of the stages that it reads. Its folder is OUT/stages/NAME-KEY, in which `MARKER` is
written last. So a changed stage and all that read it are made again, and nothing else is.
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
from alpasim_plugin.core.files import read_json_object
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.parts.source import package_digest

MARKER = "stage.json"
FOLDER = "stages"
KEY_DIGITS = 12
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
    """

    name: str
    command: tuple[str, ...]
    reads: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    effort: tuple[str, ...] = ()
    budget: str = ""


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


def run_stages(placed: Sequence[Placed], execute: Execute, report: Report) -> None:
    """Run the stages that are not complete, in order; a begun one goes on from its checkpoints.

    Args:
        placed: The stages.
        execute: Runs the words of a command, and raises where it fails.
        report: Called with every stage and its state before it is run or reused.

    Raises:
        InfrastructureError: A command ended without an error, and without results.
        InputError: A marker is of another stage.
    """
    for item in placed:
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
                "command": ["simrun", *item.words],
                "facts": dict(item.stage.facts),
                "reads": list(item.stage.reads),
                "program": package_digest(),
                "core_s_of_last_call": round(core_seconds() - began_core_s, 1),
                "s_of_last_call": round(time.monotonic() - began_s, 1),
                "was_resumed": state == "begun",
            },
        )


def core_seconds() -> float:
    """Return the processor time of this process and of its ended children, seconds."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
