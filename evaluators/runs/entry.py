"""What one run folder is, as far as its ``run.json`` and ``summary.json`` tell: also a folder that is unfinished or damaged."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.checksums import read_sealed
from alpasim_plugin.io.lock import holder_of
from alpasim_plugin.io.reading.files import as_shape, read_json_as
from alpasim_plugin.run_folder.schema import CONTENTS, LOCK, ROLLOUTS, RUN_INFO, SUMMARY, cell_name
from alpasim_plugin.run_folder.shapes import RunInfo, Summary
from evaluators.metrics import MetricTable

DOING = "listing runs"
CHECK = "simrun check RUN says what is damaged"

State = Literal["finished", "running", "unfinished", "damaged"]
STATES: tuple[State, ...] = get_args(State)


@dataclass(frozen=True)
class RunEntry:
    """A run folder in a list.

    Attributes:
        folder: Its path, as found.
        state: ``finished``; ``running`` where a process writes it; ``unfinished`` where none does any more; ``damaged`` where it cannot be
            read.
        problem: Why it is damaged, else empty.
        info: ``run.json``, or its copy in ``contents.json`` where it is damaged; empty where there is neither.
    """

    folder: Path
    state: State
    problem: str
    info: Mapping[str, Any]

    @cached_property
    def table(self) -> MetricTable:
        """Give what the run's metrics are, as the run itself says."""
        return MetricTable.of_run(self.info)

    @property
    def kind(self) -> str:
        """Give what the folder holds: ``run``, ``score`` (of logs) or ``fork``."""
        return str(self.info.get("kind") or "run")

    @property
    def started_at(self) -> datetime | None:
        """Give when the run was begun."""
        return as_time(self.info.get("started_at"))

    @property
    def project(self) -> Mapping[str, Any]:
        """Give what `alpasim_plugin.runtime.provenance.Project` names; empty for a run of an earlier version."""
        return self.info.get("project") or {}

    @property
    def commit(self) -> str:
        """Give the project's commit, or ""."""
        return str(self.project.get("commit") or "")

    @property
    def commit_text(self) -> str:
        """Give the commit for a table: seven digits, and ``+`` where files differed from it; "" without one."""
        return self.commit[:7] + ("+" if self.commit and self.project.get("dirty") else "")

    @property
    def weights(self) -> frozenset[tuple[str, str]]:
        """Give name of a weight file and its SHA-256; where the file lay does not matter."""
        return frozenset((Path(path).name, str(digest)) for path, digest in (self.info.get("weights") or {}).items())

    @property
    def scenes(self) -> dict[str, str]:
        """Give scene id -> content hash."""
        return {name: str(facts.get("content_hash") or "") for name, facts in (self.info.get("scenes") or {}).items()}

    @property
    def outcome(self) -> Mapping[str, Any]:
        """Give ``n_rollouts`` and ``n_failed``, from ``run.json`` or, for a run of an earlier version, from the summary; else empty."""
        if self.state != "finished":
            return {}
        stated: Mapping[str, Any] = self.info.get("outcome") or self.summary.get("failures") or {}
        return stated

    @property
    def planned(self) -> int | None:
        """Give how many rollouts were planned; None for scored logs that are not finished, and without ``run.json``."""
        if "n_rollouts" in self.outcome:
            return int(self.outcome["n_rollouts"])
        if not self.info or self.kind == "score":
            return None
        sizes = [len(self.info.get(name) or ()) for name in ("renderers", "policies", "scenes", "seeds")]
        return sizes[0] * sizes[1] * sizes[2] * sizes[3]

    @cached_property
    def summary(self) -> Mapping[str, Any]:
        """Give ``summary.json``, read on first use; empty where the run is not finished.

        Raises:
            InputError: A finished run without a readable one.
        """
        if self.state != "finished":
            return {}
        summary: Mapping[str, Any] = read_json_as(Summary, self.folder / SUMMARY, DOING, do_this=CHECK)
        return summary

    def metric(self, metric: str, renderer: str, policy: str) -> Mapping[str, Any]:
        """Return the entry of a metric in ``summary.json``; empty where it has none."""
        table = self.summary.get("metrics") or {}
        of = table.get(cell_name(renderer, policy)) or (table.get(renderer) if len(self.info.get("policies") or ()) == 1 else None) or {}
        return of.get(metric) or {}

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        info = self.info
        listed = {name: list(info.get(name) or ()) for name in ("renderers", "policies", "seeds", "asked")}
        return {
            "folder": str(self.folder), "state": self.state, "problem": self.problem, "kind": self.kind, "key": info.get("key"),
            "started_at": info.get("started_at"), "project": dict(self.project) or None, "version": info.get("version"),
            "preset": info.get("preset"), **listed, "scenes": self.scenes, "weights": dict(info.get("weights") or {}),
            "rollouts": self.planned, "failed": self.outcome.get("n_failed"),
        }  # fmt: skip


def as_time(text: object) -> datetime | None:
    """Return a time of ISO 8601, in UTC where it names no zone; None where it is no time."""
    try:
        found = datetime.fromisoformat(str(text))
    except ValueError:
        return None
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)


def read_entry(folder: Path, with_summary: bool = False) -> RunEntry:
    """Describe a run folder; what is wrong with it is part of the description.

    Args:
        folder: The run folder.
        with_summary: Read ``summary.json`` too, so that damage of it is noticed here; its size makes it five times slower.
    """
    finished = os.path.isfile(folder / CONTENTS)  # False too where the folder may not be looked into
    info: Mapping[str, Any] = {}
    problem = ""
    try:
        info = _run_info(folder / RUN_INFO)
    except InputError as error:
        problem = f"{RUN_INFO}: {error.found}"
        info = _copy_of(folder) if finished else info
    if problem or not finished:
        if holder_of(folder / LOCK) is not None:
            return RunEntry(folder, "running", "", info)
        return RunEntry(folder, "damaged" if problem else "unfinished", problem, info)
    lost = [name for name in (SUMMARY, ROLLOUTS) if not os.path.isfile(folder / name)]
    if lost:
        return RunEntry(folder, "damaged", f"{lost[0]}: missing", info)
    entry = RunEntry(folder, "finished", "", info)
    try:
        if with_summary or "outcome" not in info:
            entry.summary  # noqa: B018 - read now, so that damage is a fact of the entry
    except InputError as error:
        return RunEntry(folder, "damaged", f"{SUMMARY}: {error.found}", info)
    return entry


def _run_info(path: Path) -> Mapping[str, Any]:
    info, _ = read_sealed(path, DOING, CHECK)
    shaped: Mapping[str, Any] = as_shape(RunInfo, info, path, DOING, CHECK)
    return shaped


def _copy_of(folder: Path) -> Mapping[str, Any]:
    """Return the copy of a damaged ``run.json``; empty where it is damaged too."""
    try:
        contents, _ = read_sealed(folder / CONTENTS, DOING, CHECK)
        copy: Mapping[str, Any] = as_shape(RunInfo, contents.get("run") or {}, folder / CONTENTS, DOING, CHECK)
    except InputError:
        return {}
    return copy
