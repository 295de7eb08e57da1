"""A metric from run to run: only comparable runs are joined, and each is compared with the one before it, cell by cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from typing import Any

from alpasim_plugin.run_folder.schema import ROLLOUTS, ROLLOUTS_TABLE, columns_of
from alpasim_plugin.run_folder.sides import RendererRows, Row
from evaluators.aggregate.paired import compare
from evaluators.runs.changes import Change, changes
from evaluators.runs.entry import CHECK, RunEntry, as_time

DOING = "comparing many runs"


@dataclass(frozen=True)
class Setting:
    """What two runs must share to be comparable: the same drives, apart from what is under test.

    Attributes:
        kind: ``run`` or ``score``.
        policy: Name of the policy.
        preset: Evaluator preset.
        scenes: Scene id and content hash of each.
        seeds: Rollout seeds.
    """

    kind: str
    policy: str
    preset: str
    scenes: frozenset[tuple[str, str]]
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Step:
    """The comparison of two runs.

    Attributes:
        before: The earlier run.
        after: The later one.
        entry: What `evaluators.aggregate.paired.compare` gives, later minus earlier.
        changes: What differs between the two; empty where nothing does.
    """

    before: RunEntry
    after: RunEntry
    entry: Mapping[str, Any]
    changes: tuple[Change, ...]

    @property
    def moved(self) -> bool:
        """Tell whether a difference is shown: the 95 % interval leaves out zero and the test rejects."""
        return bool(self.entry["difference"] != "none shown")

    @property
    def unexplained(self) -> bool:
        """Tell whether rollouts differ although nothing that `run.json` keeps does."""
        return not self.changes and bool(self.entry.get("diff"))


@dataclass(frozen=True)
class Line:
    """One metric behind one renderer over comparable runs.

    Attributes:
        metric: Its name.
        renderer: Its name.
        runs: In their order.
        steps: From each run to the next; one fewer.
        whole: From the first to the last; small steps that no single one shows add up here.
    """

    metric: str
    renderer: str
    runs: tuple[RunEntry, ...]
    steps: tuple[Step, ...]
    whole: Step


@dataclass(frozen=True)
class Series:
    """Comparable runs, and the lines through them."""

    setting: Setting
    runs: tuple[RunEntry, ...]
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Trend:
    """All comparable runs among some.

    Attributes:
        series: The longest first.
        left_out: Runs that are in none, and why.
        by_commit: Whether the runs are in the order of their commits; otherwise in that of their starts.
    """

    series: tuple[Series, ...]
    left_out: tuple[tuple[RunEntry, str], ...]
    by_commit: bool


def trend(entries: Sequence[RunEntry], metrics: Sequence[str]) -> Trend:
    """Join comparable runs into lines and compare each with the one before it.

    Two runs are comparable where scenes (by content hash), seeds, policy and preset are the same; renderers need not be, each has a line
    through the runs that drove it. What is compared are the cells that have a valid value on both sides (`evaluators.aggregate.paired`).

    Args:
        entries: Runs, as `find_runs` gives them.
        metrics: Which metrics.

    Raises:
        InputError: A table of a run is damaged, or a metric is not the same quantity in two runs that are compared.
    """
    usable, left_out = _usable(entries)
    groups: dict[Setting, list[RunEntry]] = {}
    for entry in usable:
        for setting in _settings(entry):
            groups.setdefault(setting, []).append(entry)
    joined = {id(one): one for runs in groups.values() if len(runs) > 1 for one in runs}
    left_out += [(one, "no other run has its scenes, seeds, policy and preset") for one in usable if id(one) not in joined]
    by_commit = bool(joined) and all(as_time(one.project.get("committed_at")) is not None for one in joined.values())
    tables = _Tables(metrics)
    ordered = ((setting, sorted(runs, key=lambda one: _order(one, by_commit))) for setting, runs in groups.items() if len(runs) > 1)
    series = [_series(setting, runs, metrics, tables) for setting, runs in ordered]
    return Trend(tuple(sorted(series, key=lambda one: -len(one.runs))), tuple(left_out), by_commit)


def _usable(entries: Sequence[RunEntry]) -> tuple[list[RunEntry], list[tuple[RunEntry, str]]]:
    usable: list[RunEntry] = []
    left_out: list[tuple[RunEntry, str]] = []
    for entry in entries:
        if entry.state != "finished":
            left_out.append((entry, entry.state))
        elif entry.kind == "fork":
            left_out.append((entry, "a fork of one rollout"))
        elif not entry.scenes or not all(entry.scenes.values()):
            left_out.append((entry, "no content hash of its scenes"))
        else:
            usable.append(entry)
    return usable, left_out


def _order(entry: RunEntry, by_commit: bool) -> tuple[float, float, str]:
    """Sort by commit where all runs have the time of theirs, then by start."""
    began, committed = entry.started_at, as_time(entry.project.get("committed_at")) if by_commit else None
    return _seconds(committed), _seconds(began), str(entry.folder)


def _seconds(time: datetime | None) -> float:
    return time.timestamp() if time is not None else 0.0


def _settings(entry: RunEntry) -> list[Setting]:
    info, scenes = entry.info, frozenset(entry.scenes.items())
    seeds = tuple(sorted(int(seed) for seed in info.get("seeds") or ()))
    return [Setting(entry.kind, str(policy), str(info.get("preset")), scenes, seeds) for policy in info.get("policies") or ()]


def _series(setting: Setting, runs: Sequence[RunEntry], metrics: Sequence[str], tables: _Tables) -> Series:
    renderers = dict.fromkeys(str(name) for one in runs for name in one.info.get("renderers") or ())
    lines = []
    for metric in metrics:
        for renderer in renderers:
            have = [one for one in runs if tables.has(one, renderer, setting.policy, metric)]
            if len(have) > 1:
                steps = tuple(_step(before, after, metric, renderer, setting.policy, tables) for before, after in pairwise(have))
                whole = steps[0] if len(steps) == 1 else _step(have[0], have[-1], metric, renderer, setting.policy, tables)
                lines.append(Line(metric, renderer, tuple(have), steps, whole))
    return Series(setting, tuple(runs), tuple(lines))


def _step(before: RunEntry, after: RunEntry, metric: str, renderer: str, policy: str, tables: _Tables) -> Step:
    there, here = (tables.rows(one, renderer, policy) for one in (before, after))
    known = after.table.joined(before.table, [metric], DOING, f"{before.folder} and {after.folder}")
    entry = compare(here, there, known.info(metric), before.folder.name, listed=0)
    return Step(before, after, entry, changes(before, after, renderer, policy))


class _Tables:
    """The rollouts of runs by renderer and policy: of each run's table only the columns of some metrics, read once."""

    def __init__(self, metrics: Sequence[str]) -> None:
        self._metrics = metrics
        self._read: dict[int, dict[tuple[str, str], list[Row]]] = {}
        self._sides: dict[tuple[int, str, str], RendererRows] = {}

    def rows(self, entry: RunEntry, renderer: str, policy: str) -> RendererRows:
        """Return the rollouts of a renderer and policy, sorted into cells."""
        key = (id(entry), renderer, policy)
        if key not in self._sides:
            self._sides[key] = RendererRows.of(self._of(entry)[renderer, policy])
        return self._sides[key]

    def has(self, entry: RunEntry, renderer: str, policy: str, metric: str) -> bool:
        """Tell whether a run's renderer and policy have a metric, valid or not."""
        rows = self._of(entry).get((renderer, policy), [])
        return bool(rows) and metric in rows[0]

    def _of(self, entry: RunEntry) -> dict[tuple[str, str], list[Row]]:
        if id(entry) not in self._read:
            self._read[id(entry)] = self._split(entry)
        return self._read[id(entry)]

    def _split(self, entry: RunEntry) -> dict[tuple[str, str], list[Row]]:
        stated = {name for table in (entry.summary.get("metrics") or {}).values() for name in table}
        metrics = [name for name in self._metrics if name in stated]
        columns = [*ROLLOUTS_TABLE.required, *(column.name for column in columns_of(metrics))]
        table = ROLLOUTS_TABLE.read(entry.folder / ROLLOUTS, DOING, CHECK, columns)
        split: dict[tuple[str, str], list[Row]] = {}
        for row in table.to_pylist():
            split.setdefault((row["renderer"], row["policy"]), []).append(row)
        return split
