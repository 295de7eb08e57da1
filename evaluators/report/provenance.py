"""What is needed to make a run again, and what it did not model."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from alpasim_plugin.run_folder.reader import Run

MAX_SCENES = 1000


@dataclass(frozen=True)
class SceneSource:
    """Where a scene came from."""

    scene: str
    source: str
    content_hash: str
    notes: tuple[str, ...]
    map_href: str | None


@dataclass(frozen=True)
class Provenance:
    """What is needed to make the run again, and what it did not model."""

    command: str
    facts: tuple[tuple[str, str], ...]
    hardware: tuple[tuple[str, str], ...]
    versions: tuple[tuple[str, str], ...]
    weights: tuple[tuple[str, str], ...]
    scenes: tuple[SceneSource, ...]
    more_scenes: int  # that are not among them
    left_out: tuple[str, ...]
    config: str


def provenance(run: Run) -> Provenance:
    """Collect provenance from ``run.json``."""
    info = run.info
    facts = {
        "preset": run.summary.get("preset") or info.get("preset"),
        "started": info.get("started_at"),
        "commit": commit_text(info),
        "simrun": info.get("version"),
        "run key": info.get("key"),
        "seeds": ", ".join(str(s) for s in info.get("seeds") or []),
        "schema": info.get("schema_version"),
    }
    scenes, of_run = [], info.get("scenes") or {}
    for name, entry in list(of_run.items())[:MAX_SCENES]:
        path = run.scene_path(name)
        notes = tuple(str(n) for n in entry.get("notes") or ())
        href = path.relative_to(run.folder).as_posix() if path else None
        scenes.append(SceneSource(name, str(entry.get("source") or ""), str(entry.get("content_hash") or ""), notes, href))
    command = info.get("command") or []
    return Provenance(
        shlex.join(str(word) for word in command) if isinstance(command, list) else str(command),
        tuple((k, str(v)) for k, v in facts.items() if v not in (None, "")),
        _pairs(info.get("hardware")),
        _pairs(info.get("versions")),
        _pairs(info.get("weights")),
        tuple(scenes),
        len(of_run) - len(scenes),
        tuple(str(note) for note in info.get("left_out") or ()),
        json.dumps(info.get("config") or {}, indent=2),
    )


def commit_text(info: Mapping[str, Any]) -> str:
    """Name the project's commit of a ``run.json``, with a word where files differed from it; empty where there is none."""
    project = info.get("project") or {}
    return f"{project['commit']}{', files changed' if project.get('dirty') else ''}" if project.get("commit") else ""


def _pairs(value: Any) -> tuple[tuple[str, str], ...]:
    if not isinstance(value, Mapping):
        return ()
    return tuple((str(k), "none" if v is None else v if isinstance(v, str) else json.dumps(v)) for k, v in value.items())
