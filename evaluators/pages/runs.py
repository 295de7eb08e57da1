"""Run folders, also unfinished or damaged ones: described by ``run.json`` and ``summary.json``, and
found below a folder.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from rich import box
from rich.table import Table
from rich.text import Text

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import shorten
from alpasim_plugin.core.escape import terminal as escape
from alpasim_plugin.core.files.lock import is_locked
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.log.run_folder.records import RunInfo, ScoreConfig, json_of
from alpasim_plugin.log.run_folder.schema import LOCK, ROLLOUTS, RUN_INFO, SUMMARY, cell_name
from evaluators.metrics import MetricTable
from evaluators.results import Mean, Summary, read_summary
from evaluators.statistics.numbers import DASH, plural, printed

CHECK = "simrun check run RUN says what is damaged"

State = Literal["finished", "running", "unfinished", "damaged"]
STYLES = {"finished": "", "running": "cyan", "unfinished": "yellow", "damaged": "red"}
PROBLEM_LETTERS = 90
# Stands for a run.json that cannot be read.
NO_INFO = RunInfo("", (), ScoreConfig({}, None), "", (), (), (), {})
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
        info: ``run.json``; None where it cannot be read.
        summary: ``summary.json``; None where the run is not finished.
    """

    folder: Path
    state: State
    problem: str
    info: RunInfo | None
    summary: Summary | None

    @property
    def started_at(self) -> datetime:
        """Give when the run was begun, in UTC where it names no zone; the first day where that is
        not known.
        """
        try:
            started_at = None if self.info is None else self.info.started_at
            time = datetime.fromisoformat(str(started_at))
            return time if time.tzinfo is not None else time.replace(tzinfo=UTC)
        except ValueError:
            return datetime.min.replace(tzinfo=UTC)

    @property
    def rollouts(self) -> tuple[int | None, int]:
        """Give how many rollouts were planned and failed; None for scored logs that are not
        finished, and without ``run.json``.
        """
        info = self.info
        if info is None:
            return None, 0
        if self.state == "finished" and info.outcome is not None:
            return info.outcome.n_rollouts, info.outcome.n_failed
        if info.is_of_logs:
            return None, 0
        axes = (info.renderers, info.policies, info.scenes, info.seeds)
        return math.prod(len(axis) for axis in axes), 0

    @property
    def variants(self) -> list[tuple[str, str]]:
        """List renderer and policy of each line of the run."""
        if self.info is None:
            return []
        return [
            (renderer, policy) for policy in self.info.policies for renderer in self.info.renderers
        ]

    def metric(self, metric: str, renderer: str, policy: str) -> Mean | None:
        """Return the mean of a metric in ``summary.json``; None where it has none."""
        if self.summary is None or self.info is None:
            return None
        is_alone = len(self.info.policies) == 1
        variant = renderer if is_alone else cell_name(renderer, policy)
        return self.summary.metrics.get(variant, {}).get(metric)

    def as_dict(self) -> JsonObject:
        """Return everything for JSON."""
        planned, failed = self.rollouts
        info = NO_INFO if self.info is None else self.info
        is_known = self.info is not None
        return {
            "folder": str(self.folder),
            "state": self.state,
            "problem": self.problem,
            "kind": info.kind or "run",
            "project": None if info.project is None else json_of(info.project),
            "key": info.key if is_known else None,
            "started_at": info.started_at,
            "version": info.version,
            "preset": info.preset if is_known else None,
            "renderers": list(info.renderers),
            "policies": list(info.policies),
            "seeds": list(info.seeds),
            "asked": list(info.asked or ()),
            "scenes": {name: facts.content_hash for name, facts in info.scenes.items()},
            "weights": info.weights,
            "rollouts": planned,
            "failed": failed if self.state == "finished" else None,
        }


def read_entry(folder: Path) -> RunEntry:
    """Describe a run folder; what is wrong with it is part of the description."""
    info: RunInfo | None = None
    is_running = is_locked(folder / LOCK)
    try:
        info = read_run_json(folder)
        if not os.path.isfile(folder / SUMMARY):
            return RunEntry(folder, "running" if is_running else "unfinished", "", info, None)
        if not os.path.isfile(folder / ROLLOUTS):
            return RunEntry(folder, "damaged", f"{ROLLOUTS}: missing", info, None)
        summary = read_summary(folder / SUMMARY, CHECK)
    except InputError as error:
        if is_running:
            return RunEntry(folder, "running", "", info, None)
        return RunEntry(folder, "damaged", error.message, info, None)
    return RunEntry(folder, "finished", "", info, summary)


def find_runs(roots: Sequence[Path]) -> list[RunEntry]:
    """Describe every run folder below some folders, or those folders themselves, the newest first.

    A folder that a killed run left behind is one too. Links are followed, circles are not. Nothing
    is searched inside a run folder, so forks inside a run are part of it.

    Args:
        roots: Folders; one that is reached twice is listed once.

    Raises:
        InputError: A root is not a folder.
    """
    visited_folders: set[str] = set()
    entries = []
    for root in roots:
        if not os.path.isdir(root):
            raise InputError(
                f"{root}: not a folder",
                "name the folder that holds the run folders; simrun run writes them below runs/",
            )
        for folder, names, files in os.walk(root, followlinks=True):
            place = os.path.realpath(folder)
            if place in visited_folders:
                names.clear()
            elif MARKS & {*files}:
                names.clear()
                entries.append(read_entry(Path(folder)))
            visited_folders.add(place)
            names[:] = [name for name in names if name[0] != "." and name not in SKIPPED]
    entries.sort(key=lambda entry: str(entry.folder))
    return sorted(entries, key=lambda entry: entry.started_at, reverse=True)


def runs_table(entries: Sequence[RunEntry], root: Path, metrics: Sequence[str]) -> Table:
    """Lay out one run a row, in the order given, named from the folder that holds ``root``; with
    metrics, its cells have a line for each renderer and policy.
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
        variants = entry.variants
        parts = [[escape(variant[axis]) for variant in variants] for axis in (0, 1)]
        texts = [", ".join(dict.fromkeys(column)) for column in parts]
        if metrics:
            texts = ["\n".join(column) for column in parts]
            for metric in metrics:
                texts.append("\n".join(value_text(entry, metric, *variant) for variant in variants))
        info = NO_INFO if entry.info is None else entry.info
        began = (info.started_at or DASH)[:16].replace("T", " ")
        table.add_row(
            Text(escape(os.path.relpath(entry.folder, root.parent)), style="bold"),
            Text(escape(began)),
            Text(escape(_commit(info))),
            Text(f"{len(info.scenes)} x {len(info.seeds)} {escape(first_scenario(info))}"),
            Text(escape(info.preset or DASH)),
            _state(entry),
            *(Text(text or DASH) for text in texts),
        )
    return table


def run_paragraph(entry: RunEntry, root: Path, metrics: Sequence[str]) -> list[Text]:
    """Lay out one run in lines, for a terminal in which `runs_table` would have to fold names.

    Args:
        entry: The run.
        root: The folder that was searched; the name begins at the folder that holds it.
        metrics: Names of metrics, each of which has a line for each variant.
    """
    info = NO_INFO if entry.info is None else entry.info
    name = Text(escape(os.path.relpath(entry.folder, root.parent)), style="bold")
    began = (info.started_at or DASH)[:16].replace("T", " ")
    size = f"{plural(len(info.scenes), 'scene')} x {plural(len(info.seeds), 'seed')}"
    scenes = f"{size} of {escape(first_scenario(info))}" if entry.info is not None else ""
    facts = [began, scenes, escape(info.preset), f"commit {escape(_commit(info))}"]
    state = Text("      ") + _state(entry)
    if entry.state == "finished":
        state += Text(" rollouts")
    lines = [name, Text("      " + ", ".join(filter(None, facts))), state]
    for renderer, policy in entry.variants:
        variant = f"{escape(renderer)} / {escape(policy)}"
        values = [f"{metric} {value_text(entry, metric, renderer, policy)}" for metric in metrics]
        lines.append(
            Text("      " + ": ".join([variant, *([", ".join(values)] if values else [])]))
        )
    return lines


def _commit(info: RunInfo) -> str:
    """Return the commit of the user's project, with a plus where files differ from it."""
    if info.project is None or info.project.commit is None:
        return DASH
    return info.project.commit[:7] + ("+" if info.project.dirty else "")


def first_scenario(info: RunInfo) -> str:
    """Return the first scenario that a command named, and how many more it named."""
    names = info.asked or tuple(info.scenes)
    if not names:
        return ""
    first = Path(names[0]).name if Path(names[0]).is_absolute() else names[0]
    return first if len(names) == 1 else f"{first} + {len(names) - 1}"


def value_text(entry: RunEntry, metric: str, renderer: str, policy: str) -> str:
    """Print a metric's mean with its 95 % interval over scenes, both as `summary.json` has them; a
    dash where there is no mean.
    """
    mean = entry.metric(metric, renderer, policy)
    if mean is None or mean.mean is None:
        return DASH
    stated = {} if entry.info is None else entry.info.metrics
    facts = MetricTable.of_run(stated).shown(metric)
    unit = "%" if facts.in_percent else mean.unit
    texts = printed(facts, mean.mean, *(mean.ci95_clustered or ()))
    spread = f"({' to '.join(texts[1:])})" if len(texts) > 1 else ""
    return " ".join(filter(None, (texts[0], unit, spread)))


def _state(entry: RunEntry) -> Text:
    planned, failed = entry.rollouts
    if entry.state == "finished":
        return Text(str(planned)) + Text(f", {failed} failed" if failed else "", style="red")
    text = Text(entry.state, style=STYLES[entry.state])
    if planned and entry.state != "damaged":
        text += Text(f", {planned} planned")
    if entry.problem:
        text += Text(f"\n{escape(shorten(entry.problem, PROBLEM_LETTERS))}", style="dim")
    return text
