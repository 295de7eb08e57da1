"""Run folders, also unfinished or damaged ones: described by ``run.json`` and ``summary.json``,
found below a folder, and chosen.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
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
from alpasim_plugin.core.json_types import JsonView
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
from evaluators.numbers import DASH, decimals, finite, fixed, interval

CHECK = "simrun check run RUN says what is damaged"

State = Literal["finished", "running", "unfinished", "damaged"]
STYLES = {"finished": "", "running": "cyan", "unfinished": "yellow", "damaged": "red"}
PROBLEM_LETTERS = 90
MARKS = frozenset((RUN_INFO, LOCK))  # the first file of a run folder is its lock
SKIPPED = frozenset(("node_modules", "__pycache__", "site-packages"))


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
    info: JsonView

    @property
    def started_at(self) -> datetime | None:
        """Give when the run was begun, in UTC where it names no zone."""
        try:
            return as_utc(datetime.fromisoformat(str(self.info.get("started_at"))))
        except ValueError:
            return None

    @property
    def commit_text(self) -> str:
        """Give the project's commit for a table: seven digits, and ``+`` where files differed from
        it; "" without one.
        """
        project = self.info.get("project") or {}
        commit = str(project.get("commit") or "")[:7]
        return f"{commit}+" if commit and project.get("dirty") else commit

    @property
    def outcome(self) -> JsonView:
        """Give ``n_rollouts`` and ``n_failed``, from ``run.json``."""
        if self.state != "finished":
            return {}
        stated: JsonView = self.info.get("outcome") or {}
        return stated

    @property
    def planned(self) -> int | None:
        """Give how many rollouts were planned; None for scored logs that are not finished, and
        without ``run.json``.
        """
        if "n_rollouts" in self.outcome:
            return int(self.outcome["n_rollouts"])
        if not self.info or self.info.get("kind") == "score":
            return None
        axes = ("renderers", "policies", "scenes", "seeds")
        return math.prod(len(self.info.get(axis) or ()) for axis in axes)

    @cached_property
    def summary(self) -> JsonView:
        """Give ``summary.json``, read on first use; empty where the run is not finished.

        Raises:
            InputError: A finished run without a readable one.
        """
        if self.state != "finished":
            return {}
        summary: JsonView = read_json_as(Summary, self.folder / SUMMARY, do_this=CHECK)
        return summary

    def metric(self, metric: str, renderer: str, policy: str) -> JsonView:
        """Return the entry of a metric in ``summary.json``; empty where it has none."""
        table = self.summary.get("metrics") or {}
        alone = renderer if len(self.info.get("policies") or ()) == 1 else ""
        entries = table.get(cell_name(renderer, policy)) or table.get(alone) or {}
        return entries.get(metric) or {}

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        info = self.info
        scenes = info.get("scenes") or {}
        lists = ("renderers", "policies", "seeds", "asked")
        return {
            "folder": str(self.folder),
            "state": self.state,
            "problem": self.problem,
            "kind": info.get("kind") or "run",
            "project": info.get("project") or None,
            **{name: info.get(name) for name in ("key", "started_at", "version", "preset")},
            **{name: list(info.get(name) or ()) for name in lists},
            "scenes": {name: facts.get("content_hash") or "" for name, facts in scenes.items()},
            "weights": dict(info.get("weights") or {}),
            "rollouts": self.planned,
            "failed": self.outcome.get("n_failed"),
        }


def as_utc(time: datetime) -> datetime:
    """Return a time in UTC where it names no zone."""
    return time if time.tzinfo is not None else time.replace(tzinfo=UTC)


def read_entry(folder: Path, with_summary: bool = False) -> RunEntry:
    """Describe a run folder; what is wrong with it is part of the description.

    Args:
        folder: The run folder.
        with_summary: Read ``summary.json`` too, so that damage of it is noticed here; its size
            makes it five times slower.
    """
    finished = os.path.isfile(folder / SUMMARY)  # False too in a folder that cannot be read
    info: JsonView = {}
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
        if with_summary:
            entry.summary  # noqa: B018 - read now, so that damage is a fact of the entry
    except InputError as error:
        return RunEntry(folder, "damaged", f"{SUMMARY}: {error.message}", info)
    return entry


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
        if not os.path.isdir(root):
            raise InputError(
                f"{root}: not a folder",
                "name the folder that holds the run folders; simrun run writes them below runs/",
            )
        for folder in _run_folders(root, set()):
            state = folder.stat()
            found.setdefault((state.st_dev, state.st_ino), folder)

    entries = [read_entry(folder, with_summary) for folder in found.values()]
    never = datetime.min.replace(tzinfo=UTC)
    entries.sort(key=lambda entry: str(entry.folder))
    return sorted(entries, key=lambda entry: entry.started_at or never, reverse=True)


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
        if not entry.name.startswith(".") and entry.name not in SKIPPED and os.path.isdir(entry):
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
        began = entry.started_at
        return (
            _each_is_named(self.renderers, entry.info.get("renderers") or ())
            and _each_is_named(self.policies, entry.info.get("policies") or ())
            and (self.since is None or (began is not None and began >= self.since))
        )


def _each_is_named(patterns: Sequence[str], names: Sequence[str]) -> bool:
    return all(any(fnmatchcase(name, pattern) for name in names) for pattern in patterns)


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
        return as_utc(datetime.fromisoformat(text))
    except (ValueError, OverflowError):
        raise InputError(
            f"{option} {text}: neither a date nor an age",
            "write 2026-03-01, 2026-03-01T18:00, 7d or 12h",
        ) from None


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
    for entry in entries:
        variants = variants_of(entry)
        names = [[escape(variant[axis]) for variant in variants] for axis in (0, 1)]
        texts = [", ".join(dict.fromkeys(column)) for column in names]
        if metrics:
            texts = ["\n".join(column) for column in names]
            texts += [
                "\n".join(value_text(entry, metric, *variant) for variant in variants)
                for metric in metrics
            ]
        began = entry.started_at
        table.add_row(
            Text(escape(shown_folder(entry.folder, roots)), style="bold"),
            began.strftime("%Y-%m-%d %H:%M") if began is not None else DASH,
            entry.commit_text or DASH,
            Text(scenes_text(entry)),
            Text(escape(str(entry.info.get("preset") or DASH))),
            _state(entry),
            *(Text(text or DASH) for text in texts),
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
    scenes = entry.info.get("scenes") or {}
    names = [str(name) for name in entry.info.get("asked") or scenes]
    if names and Path(names[0]).is_absolute():
        names[0] = Path(names[0]).name.removesuffix(".yaml")
    more = f" + {len(names) - 1}" if len(names) > 1 else ""
    seeds = entry.info.get("seeds") or ()
    return f"{len(scenes)} x {len(seeds)} {escape(''.join(names[:1]))}{more}"


def value_text(entry: RunEntry, metric: str, renderer: str, policy: str) -> str:
    """Print a metric's mean with its 95 % interval over scenes, both as `summary.json` has them; a
    dash where there is no mean.
    """
    numbers = entry.metric(metric, renderer, policy)
    mean = finite(numbers.get("mean"))
    if mean is None:
        return DASH
    facts = MetricTable.of_run(entry.info).shown(metric)
    scale, unit = (100.0, "%") if facts.in_percent else (1.0, str(numbers.get("unit") or ""))
    values = [value * scale for value in (mean, *(interval(numbers.get("ci95_clustered")) or ()))]
    places = 1 if facts.in_percent else decimals(*values)
    texts = [fixed(value, places) for value in values]
    spread = f"({' to '.join(texts[1:])})" if len(texts) > 1 else ""
    return " ".join(filter(None, (texts[0], unit, spread)))


def _state(entry: RunEntry) -> Text:
    planned = "" if entry.planned is None else str(entry.planned)
    if entry.state == "finished":
        failed = int(entry.outcome.get("n_failed") or 0)
        return Text(planned) + Text(f", {failed} failed" if failed else "", style="red")
    text = Text(entry.state, style=STYLES[entry.state])
    if planned and entry.state != "damaged":
        text += Text(f", {planned} planned")
    if entry.problem:
        text += Text(f"\n{escape(shorten(entry.problem, PROBLEM_LETTERS))}", style="dim")
    return text
