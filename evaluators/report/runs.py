"""Run folders, also unfinished or damaged ones: described by ``run.json`` and ``summary.json``,
found below a folder, and chosen.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from rich import box
from rich.table import Table
from rich.text import Text

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import shorten
from alpasim_plugin.core.escape import terminal as escape
from alpasim_plugin.core.lock import is_locked
from alpasim_plugin.core.reading.files import read_json_as
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.log.run_folder.schema import (
    LOCK,
    ROLLOUTS,
    RUN_INFO,
    SUMMARY,
    cell_name,
)
from alpasim_plugin.log.run_folder.shapes import Summary
from evaluators.metrics import MetricTable
from evaluators.report.numbers import DASH, decimals, finite, fixed, interval

CHECK = "simrun check run RUN says what is damaged"

State = Literal["finished", "running", "unfinished", "damaged"]
STYLES = {"finished": "", "running": "cyan", "unfinished": "yellow", "damaged": "red"}
PROBLEM_LETTERS = 90


@dataclass(frozen=True)
class RunEntry:
    """A run folder in a list.

    Attributes:
        folder: Its path, as found.
        state: ``finished``; ``running`` where a process writes it; ``unfinished`` where none does
            any more; ``damaged`` where it cannot be read.
        problem: Why it is damaged, else empty.
        info: ``run.json``; empty where it cannot be read.
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
        """Give what `alpasim_plugin.runs.provenance.Project` names; empty for a run of an earlier
        version.
        """
        return self.info.get("project") or {}

    @property
    def commit(self) -> str:
        """Give the project's commit, or ""."""
        return str(self.project.get("commit") or "")

    @property
    def commit_text(self) -> str:
        """Give the commit for a table: seven digits, and ``+`` where files differed from it; ""
        without one.
        """
        return self.commit[:7] + ("+" if self.commit and self.project.get("dirty") else "")

    @property
    def weights(self) -> frozenset[tuple[str, str]]:
        """Give name of a weight file and its SHA-256; where the file lay does not matter."""
        return frozenset(
            (Path(path).name, str(digest))
            for path, digest in (self.info.get("weights") or {}).items()
        )

    @property
    def scenes(self) -> dict[str, str]:
        """Give scene id -> content hash."""
        return {
            name: str(facts.get("content_hash") or "")
            for name, facts in (self.info.get("scenes") or {}).items()
        }

    @property
    def outcome(self) -> Mapping[str, Any]:
        """Give ``n_rollouts`` and ``n_failed``, from ``run.json`` or, for a run of an earlier
        version, from the summary; else empty.
        """
        if self.state != "finished":
            return {}
        stated: Mapping[str, Any] = self.info.get("outcome") or self.summary.get("failures") or {}
        return stated

    @property
    def planned(self) -> int | None:
        """Give how many rollouts were planned; None for scored logs that are not finished, and
        without ``run.json``.
        """
        if "n_rollouts" in self.outcome:
            return int(self.outcome["n_rollouts"])
        if not self.info or self.kind == "score":
            return None
        sizes = [
            len(self.info.get(name) or ()) for name in ("renderers", "policies", "scenes", "seeds")
        ]
        return sizes[0] * sizes[1] * sizes[2] * sizes[3]

    @cached_property
    def summary(self) -> Mapping[str, Any]:
        """Give ``summary.json``, read on first use; empty where the run is not finished.

        Raises:
            InputError: A finished run without a readable one.
        """
        if self.state != "finished":
            return {}
        summary: Mapping[str, Any] = read_json_as(Summary, self.folder / SUMMARY, do_this=CHECK)
        return summary

    def metric(self, metric: str, renderer: str, policy: str) -> Mapping[str, Any]:
        """Return the entry of a metric in ``summary.json``; empty where it has none."""
        table = self.summary.get("metrics") or {}
        of = (
            table.get(cell_name(renderer, policy))
            or (table.get(renderer) if len(self.info.get("policies") or ()) == 1 else None)
            or {}
        )
        return of.get(metric) or {}

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        info = self.info
        listed = {
            name: list(info.get(name) or ()) for name in ("renderers", "policies", "seeds", "asked")
        }
        return {
            "folder": str(self.folder),
            "state": self.state,
            "problem": self.problem,
            "kind": self.kind,
            "key": info.get("key"),
            "started_at": info.get("started_at"),
            "project": dict(self.project) or None,
            "version": info.get("version"),
            "preset": info.get("preset"),
            **listed,
            "scenes": self.scenes,
            "weights": dict(info.get("weights") or {}),
            "rollouts": self.planned,
            "failed": self.outcome.get("n_failed"),
        }


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
        with_summary: Read ``summary.json`` too, so that damage of it is noticed here; its size
            makes it five times slower.
    """
    finished = os.path.isfile(folder / SUMMARY)  # False too in a folder that cannot be read
    info: Mapping[str, Any] = {}
    problem = ""
    try:
        info = read_run_json(folder)
    except InputError as error:
        problem = error.message
    if problem or not finished:
        if is_locked(folder / LOCK):
            return RunEntry(folder, "running", "", info)
        return RunEntry(folder, "damaged" if problem else "unfinished", problem, info)
    if not os.path.isfile(folder / ROLLOUTS):
        return RunEntry(folder, "damaged", f"{ROLLOUTS}: missing", info)
    entry = RunEntry(folder, "finished", "", info)
    try:
        if with_summary or "outcome" not in info:
            entry.summary  # noqa: B018 - read now, so that damage is a fact of the entry
    except InputError as error:
        return RunEntry(folder, "damaged", f"{SUMMARY}: {error.message}", info)
    return entry


MARKS = frozenset((RUN_INFO, LOCK))  # the first file of a run folder is its lock
SKIPPED = frozenset(("node_modules", "__pycache__", "site-packages"))


def find_runs(roots: Sequence[Path], with_summary: bool = False) -> list[RunEntry]:
    """Describe every run folder below some folders, or those folders themselves, the newest first.

    A folder that a killed run left behind is one too. Nothing is searched inside a run folder, so
    forks inside a run are part of it.

    Args:
        roots: Folders; one that is reached twice is listed once.
        with_summary: As for `read_entry`.

    Raises:
        InputError: A root is not a folder.
    """
    found: dict[tuple[int, int], Path] = {}
    for root in roots:
        if not root.is_dir():
            what = "a file" if root.exists() else "no such folder"
            raise InputError(
                f"{root}: {what}",
                "name the folder that holds the run folders; simrun run writes them below runs/",
            )
        for folder in _run_folders(root, set()):
            state = folder.stat()
            found.setdefault((state.st_dev, state.st_ino), folder)

    def newest_first(entry: RunEntry) -> tuple[float, str]:
        """Sort by start; a folder that does not say when it was begun comes last."""
        began = entry.started_at
        return (-began.timestamp() if began is not None else float("inf"), str(entry.folder))

    return sorted((read_entry(folder, with_summary) for folder in found.values()), key=newest_first)


def _run_folders(folder: Path, seen: set[tuple[int, int]]) -> Iterator[Path]:
    """Yield the run folders below a folder, in the order of names; links are followed, circles are
    not.
    """
    state = folder.stat()
    if (state.st_dev, state.st_ino) in seen:
        return
    seen.add((state.st_dev, state.st_ino))
    try:
        with os.scandir(folder) as scanned:
            entries = sorted(scanned, key=lambda entry: entry.name)
    except PermissionError:
        yield folder  # it may be one: listed as what cannot be read
        return
    if any(entry.name in MARKS for entry in entries):
        yield folder
        return
    for entry in entries:
        if not entry.name.startswith(".") and entry.name not in SKIPPED and entry.is_dir():
            yield from _run_folders(Path(entry.path), seen)


@dataclass(frozen=True)
class Choice:
    """What a run must be; an empty member asks for nothing. Names may hold ``*`` and ``?``.

    Attributes:
        renderers: The run has a renderer that each of these names.
        policies: Likewise.
        since: Begun at or after.
    """

    renderers: tuple[str, ...] = ()
    policies: tuple[str, ...] = ()
    since: datetime | None = None

    def takes(self, entry: RunEntry) -> bool:
        """Tell whether a run is all that is asked for."""
        info = entry.info
        began = entry.started_at
        return (
            _each_is_named(self.renderers, info.get("renderers") or ())
            and _each_is_named(self.policies, info.get("policies") or ())
            and (self.since is None or (began is not None and began >= self.since))
        )


def _each_is_named(asked: Sequence[str], known: Sequence[str]) -> bool:
    return all(any(fnmatchcase(name, one) for name in known) for one in asked)


def as_day(text: str, option: str, now: datetime) -> datetime:
    """Read a date, a time, or an age such as ``7d`` or ``12h``; without a zone it is UTC, as in
    ``run.json``.

    Example:
        >>> as_day("2d", "--since", datetime(2026, 3, 10, 12, tzinfo=UTC)).isoformat()
        '2026-03-08T12:00:00+00:00'
        >>> as_day("2026-03-01", "--since", datetime(2026, 3, 10, tzinfo=UTC)).isoformat()
        '2026-03-01T00:00:00+00:00'

    Raises:
        InputError: None of these.
    """
    hours = {"h": 1, "d": 24, "w": 168}.get(text[-1:])
    try:
        if hours is not None:
            return now - timedelta(hours=hours * float(text[:-1]))
        found = datetime.fromisoformat(text)
    except (ValueError, OverflowError):
        raise InputError(
            f"{option} {text}: neither a date nor an age",
            "write 2026-03-01, 2026-03-01T18:00, 7d or 12h",
        ) from None
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)


def shown_folder(folder: Path, roots: Sequence[Path]) -> str:
    """Return a folder's path below the root that it was found in, where there is one root, else as
    it was found.
    """
    if len(roots) == 1 and folder != roots[0] and folder.is_relative_to(roots[0]):
        return folder.relative_to(roots[0]).as_posix()
    return str(folder)


def runs_table(
    entries: Sequence[RunEntry], roots: Sequence[Path], metrics: Sequence[str] = ()
) -> Table:
    """Lay out one run a row, in the order given; a metric's cell has a line for each renderer and
    policy.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("run", overflow="fold")
    for name in ("begun (UTC)", "commit", "scenes x seeds", "preset", "rollouts"):
        table.add_column(name)
    for name in ("renderer", "policy"):
        table.add_column(name, overflow="fold")
    for metric in metrics:
        table.add_column(Text(escape(metric)), no_wrap=True, justify="right")
    between = "\n" if metrics else ", "
    for entry in entries:
        variants = variants_of(entry)
        names = [[escape(variant[number]) for variant in variants] for number in (0, 1)]
        began = entry.started_at
        table.add_row(
            Text(escape(shown_folder(entry.folder, roots)), style="bold"),
            Text(began.strftime("%Y-%m-%d %H:%M") if began is not None else DASH),
            Text(entry.commit_text or DASH),
            Text(scenes_text(entry)),
            Text(escape(str(entry.info.get("preset") or DASH))),
            _state(entry),
            *(
                Text(between.join(column if metrics else dict.fromkeys(column)) or DASH)
                for column in names
            ),
            *(
                Text("\n".join(value_text(entry, metric, *one) for one in variants) or DASH)
                for metric in metrics
            ),
        )
    return table


def variants_of(entry: RunEntry) -> list[tuple[str, str]]:
    """List renderer and policy of each line of a run."""
    return [
        (str(r), str(p))
        for p in entry.info.get("policies") or ()
        for r in entry.info.get("renderers") or ()
    ]


def scenes_text(entry: RunEntry) -> str:
    """Count a run's scenes and seeds, and name the first thing that the command named, else the
    first scene.
    """
    if not entry.info:
        return DASH
    asked = [str(name) for name in entry.info.get("asked") or ()]
    names = [
        Path(name).name.removesuffix(".yaml") if Path(name).is_absolute() else name
        for name in asked or entry.scenes
    ]
    more = f" + {len(names) - 1}" if len(names) > 1 else ""
    return f"{len(entry.scenes)} x {len(entry.info.get('seeds') or ())} {escape(''.join(names[:1]))}{more}"


def value_text(entry: RunEntry, metric: str, renderer: str, policy: str) -> str:
    """Print a metric's mean with its 95 % interval over scenes, both as `summary.json` has them; a
    dash where there is no mean.
    """
    found = entry.metric(metric, renderer, policy)
    mean, bounds = finite(found.get("mean")), interval(found.get("ci95_clustered"))
    if mean is None:
        return DASH
    percent = entry.table.shown(metric).in_percent
    scale, tail = (
        (100.0, " %") if percent else (1.0, f" {found['unit']}" if found.get("unit") else "")
    )
    places = 1 if percent else decimals(*(value * scale for value in (mean, *(bounds or ()))))
    spread = (
        ""
        if bounds is None
        else f" ({fixed(bounds[0] * scale, places)} to {fixed(bounds[1] * scale, places)})"
    )
    return f"{fixed(mean * scale, places)}{tail}{spread}"


def _state(entry: RunEntry) -> Text:
    planned = "" if entry.planned is None else str(entry.planned)
    if entry.state == "finished":
        failed = int(entry.outcome.get("n_failed") or 0)
        return Text(planned) + Text(f", {failed} failed" if failed else "", style="red")
    text = (
        f"{entry.state}, {planned} planned" if planned and entry.state != "damaged" else entry.state
    )
    return Text(text, style=STYLES[entry.state]) + Text(
        f"\n{escape(shorten(entry.problem, PROBLEM_LETTERS))}" if entry.problem else "", style="dim"
    )
