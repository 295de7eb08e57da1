"""The determinism certificate: whether a repeated rollout is bit-identical."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from alpasim_plugin.run_folder.reader import Run
from evaluators.report.numbers import duration, finite, plural


@dataclass(frozen=True)
class Component:
    """One component of the repeated rollout."""

    name: str
    same: bool
    digest: str
    repeated: str


@dataclass(frozen=True)
class Certificate:
    """Result of the repeated rollout as the page shows it."""

    word: str  # badge
    tone: str
    text: str
    components: tuple[Component, ...]


def certificate(run: Run) -> Certificate:
    """Read the certificate of a run; a run without one says so."""
    entry = run.summary.get("determinism")
    fork = run.info.get("fork")
    if isinstance(fork, Mapping):
        said = f"{fork.get('of')} was made again up to the change and is the same as its log there, to the bit"
        after = {"equal": ", and so is what follows"}.get(str(fork.get("continuation")), "")
        return Certificate("equal", "better", f"{said}{after}.", ())
    if not isinstance(entry, Mapping):
        return Certificate("none", "unclear", "This run has no certificate: nothing was driven, or an older version made it.", ())
    if entry.get("status") == "skipped":
        return Certificate("not made", "unclear", f"No rollout was repeated: {entry.get('reason')}.", ())
    cell = entry.get("cell") or {}
    wall = finite(entry.get("wall_s"))
    what = f"{cell.get('renderer')} · {cell.get('policy')} · {cell.get('scene')} · seed {cell.get('seed')}"
    steps = f"{plural(int(entry.get('steps') or 0), 'step')}" + (f", {duration(wall)}" if wall is not None else "")
    digests, repeated = entry.get("digests") or {}, entry.get("repeated") or {}
    components = tuple(Component(name, repeated.get(name) == value, value, repeated.get(name, "")) for name, value in digests.items())
    if entry.get("status") == "equal":
        return Certificate("equal", "better", f"{what} was made again ({steps}) and is the same to the bit.", components)
    return Certificate("different", "worse", f"{what} was made again ({steps}) and differs first in {_first(entry)}.", components)


def certificate_caution(run: Run) -> list[str]:
    """Say at the head of the report that results cannot be repeated, where that was found."""
    entry = run.summary.get("determinism") or {}
    if entry.get("status") != "different":
        return []
    return [f"The run is not deterministic: a repeated rollout differs first in {_first(entry)}. Paired differences hold that noise too."]


def _first(entry: Mapping[str, Any]) -> str:
    first = entry.get("first_difference") or {}
    at = f" at step {first['step']}" if first.get("step") is not None else ""
    return f"{first.get('component')}{at} ({first.get('what')})"
