"""The kinds of parts, and what a run knows of a part: enough to build it anywhere, and to tell whether it is still the same."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.metric_types import MetricInfo
from alpasim_plugin.plugins import interfaces
from alpasim_plugin.plugins.parts.loading import make_importable
from alpasim_plugin.plugins.parts.source import code_digest

MODES = "simrun.fixer_modes"  # entry points of what calls a fixer of blocks: (runner, make_fixer, settings, first) -> Renderer
KindName = Literal["renderer", "fixer", "policy", "controller", "evaluator", "source"]


@dataclass(frozen=True)
class Kind:
    """One kind of part.

    Attributes:
        name: Singular word for messages and specs.
        group: Entry-point group through which other packages add parts.
        interface: What a built part is.
        arguments: Parameters by which a factory may ask for what is known when a part is built.
    """

    name: KindName
    group: str
    interface: Any
    arguments: tuple[str, ...]


SESSION = ("seed", "device", "threads")
KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("renderer", "simrun.renderers", interfaces.Renderer, ("scenario", *SESSION, "address")),
        Kind("fixer", "simrun.fixers", interfaces.Fixer, ("settings", "scene_id", *SESSION)),
        Kind("policy", "simrun.policies", interfaces.Policy, ("scenario", "address")),
        Kind("controller", "simrun.controllers", interfaces.Controller, ("vehicle", "address", "scene_id")),
        Kind("evaluator", "simrun.evaluators", interfaces.Evaluator, ("preset",)),
        Kind("source", "simrun.sources", interfaces.Source, ()),
    )
}


@dataclass(frozen=True)
class PartSpec:
    """A part, resolved.

    Attributes:
        kind: Its kind.
        name: As a user named it, with everything that was left out filled in: ``onefixer@2``.
        target: ``package.module:attribute`` or ``/path/file.py:attribute`` of its factory.
        settings: Validated settings; None where the part takes none.
        digest: SHA-256 of its code, settings and files. None: its behaviour is decided elsewhere, so nothing it did may be reused.
        note: What it is in a few words: "trained", "untrained (identity)".
        trained: Whether its weights were learned; None where it has none.
        files: SHA-256 of every file that it declares, by path.
        metrics: An evaluator's own metrics.
        controller: A policy's controller.
        address: What follows ``scheme://`` in the name of a remote part.
        missing: What must be given before it can be built; empty where nothing is missing.
    """

    kind: KindName
    name: str
    target: str
    settings: BaseModel | None = None
    digest: str | None = None
    note: str = ""
    trained: bool | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    metrics: Mapping[str, MetricInfo] = field(default_factory=dict)
    controller: str = ""
    address: str | None = None
    missing: str = ""

    @property
    def label(self) -> str:
        """Give the part and its weights in a few words: "onefixer, trained"."""
        own = getattr(self.settings, "name", "") or self.name
        return f"{own}, {self.note}" if self.note else own

    def as_dict(self) -> dict[str, Any]:
        """Return everything for ``run.json``."""
        return {
            "name": self.name,
            "target": self.target,
            "label": self.label,
            "digest": self.digest,
            "trained": self.trained,
            "files": dict(self.files),
            "settings": None if self.settings is None else self.settings.model_dump(mode="json"),
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the target before the rest: settings may be objects of a module that only `make_importable` lets be found."""
        return _restored, (self.target, pickle.dumps(dict(vars(self))))


def _restored(target: str, rest: bytes) -> PartSpec:
    make_importable(target)
    return PartSpec(**pickle.loads(rest))


def digest(value: object) -> str:
    """Return a SHA-256 over the canonical JSON of a value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


def file_digest(path: Path, what: str) -> str:
    """Return the SHA-256 of a file that a part names as its own.

    Raises:
        InputError: It cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        do = "correct the path, or install the part again with its files"
        raise InputError("reading a file that a part declares", f"{what}: {path}", error.strerror or str(error), do) from error


def part_digest(modules: Sequence[Path], attribute: str, settings: BaseModel | None, files: Mapping[str, str]) -> str:
    """Return the digest of a part.

    Args:
        modules: Source files of the module that was named and of the one that defines the factory; none for an extension module.
        attribute: The factory in the module.
        settings: Its settings.
        files: SHA-256 by name; a name that is a dotted key of the settings takes the place of the path that stands there.
    """
    content = None if settings is None else settings.model_dump(mode="json")
    for name in files:
        _blank(content, name.split("."))
    return digest([[code_digest(module) for module in modules], attribute, content, dict(files)])


def _blank(content: Any, keys: list[str]) -> None:
    for key in keys[:-1]:
        content = content.get(key) if isinstance(content, dict) else None
    if isinstance(content, dict) and keys[-1] in content:
        content[keys[-1]] = None
