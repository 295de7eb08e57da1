"""A metric from run to run, and what differs between two runs that could have moved it: code,
weights, settings, scenes, versions, machine.

Only comparable runs are joined, and each is compared with the one before it, cell by cell.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

from alpasim_plugin.log.run_folder.schema import ROLLOUTS, ROLLOUTS_TABLE, columns_of
from alpasim_plugin.log.run_folder.sides import Row, Side
from evaluators.report.runs import CHECK, RunEntry, as_time
from evaluators.statistics.paired import compare
from evaluators.statistics.verdicts import difference

# Options that change nothing in a rollout or its scores: what is kept, what is compared, and how
# many processes work.
NO_EFFECT = frozenset(
    ("workers", "threads_per_worker", "baseline", "video", "preset", "fixer")
)  # the last two stand elsewhere
RECONSTRUCTED = "3dgs"
MOST_LETTERS = 60


@dataclass(frozen=True)
class Change:
    """One fact that differs.

    Attributes:
        what: Its name, such as ``policy lane-camera: code``.
        before: In the earlier run; "" where it had none.
        after: In the later run.
    """

    what: str
    before: str
    after: str

    def __str__(self) -> str:
        return (
            self.what
            if self.before == self.after
            else f"{self.what} {self.before or 'none'} \u2192 {self.after or 'none'}"
        )

    def as_dict(self) -> dict[str, str]:
        """Return the fields, for JSON."""
        return asdict(self)


def changes(before: RunEntry, after: RunEntry, renderer: str, policy: str) -> tuple[Change, ...]:
    """List what differs between two runs of one renderer and policy, the likeliest cause first.

    A part is named where its digest differs, which covers its code, the code that it imports, its
    settings and its files; so a commit that differs without anything else changed nothing that
    these rollouts use. Where settings or weights of a part differ, its digest does not tell whether
    its code does too. Parts of other renderers and policies are left out.

    Args:
        before: The earlier run.
        after: The later one.
        renderer: Whose line it is.
        policy: Behind what it drives.
    """
    sides = (before, after)
    options = []
    for one in sides:
        config = one.info.get("config") or {}
        driven = {f"--{name}": value for name, value in config.items() if name not in NO_EFFECT}
        options.append(driven if one.kind == "run" else config)
    found = [
        *_differences("weights", *(_weights(one, renderer, policy) for one in sides)),
        *(one for key in ("settings", "digest") for one in _parts(*sides, renderer, policy, key)),
        *_differences("code of the", *(one.info.get("code") or {} for one in sides)),
        *_differences("", *(_scenes(one, renderer) for one in sides)),
        *_differences("", *options),
        *_differences(
            "",
            *(
                {"commit": one.commit_text or None, "simrun": one.info.get("version")}
                for one in sides
            ),
        ),
        *_differences("version of", *(one.info.get("versions") or {} for one in sides)),
        *_differences("machine:", *(one.info.get("hardware") or {} for one in sides)),
    ]
    return tuple(found)


def _differences(prefix: str, before: Mapping[str, Any], after: Mapping[str, Any]) -> list[Change]:
    names = [*before, *(name for name in after if name not in before)]
    pairs = (
        (name, _text(before.get(name)), _text(after.get(name)))
        for name in names
        if before.get(name) != after.get(name)
    )
    return [Change(f"{prefix} {name}".strip(), *pair) for name, *pair in pairs]


def _text(value: Any) -> str:
    text = "" if value is None else value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= MOST_LETTERS else f"{text[: MOST_LETTERS - 1]}\u2026"


def _own_parts(entry: RunEntry, renderer: str, policy: str) -> dict[str, Mapping[str, Any]]:
    """Return the parts that shape one line: its renderer, the one below it and the fixer, the
    policy, all controllers and evaluators.
    """
    parts: Mapping[str, Mapping[str, Any]] = entry.info.get("parts") or {}
    fixer = ((entry.info.get("fixers") or {}).get(renderer) or {}).get("name")
    base = (entry.info.get("bases") or {}).get(renderer) or renderer
    wanted = {f"renderer {base}", f"policy {policy}", *([f"fixer {fixer}"] if fixer else [])}
    return {
        name: part
        for name, part in parts.items()
        if name in wanted or name.startswith(("controller ", "evaluator "))
    }


def _weights(entry: RunEntry, renderer: str, policy: str) -> dict[str, str]:
    """Return file name -> beginning of its SHA-256, of the parts of one line; of all where
    ``run.json`` has no parts.
    """
    parts = _own_parts(entry, renderer, policy)
    files = (
        [pair for part in parts.values() for pair in (part.get("files") or {}).items()]
        if parts
        else (entry.info.get("weights") or {}).items()
    )
    named: dict[str, set[str]] = {}
    for path, digest in files:
        named.setdefault(str(path).replace("\\", "/").rpartition("/")[2], set()).add(
            str(digest)[:12]
        )
    return {name: ", ".join(sorted(digests)) for name, digests in sorted(named.items())}


def _parts(
    before: RunEntry, after: RunEntry, renderer: str, policy: str, key: str
) -> Iterable[Change]:
    """List parts whose settings differ, one change a setting, or whose digest does although
    settings and files are the same.
    """
    here, there = (_own_parts(one, renderer, policy) for one in (before, after))
    for name in [*here, *(name for name in there if name not in here)]:
        old, new = here.get(name) or {}, there.get(name) or {}
        settings = [_flat(one.get("settings") or {}) for one in (old, new)]
        if key == "settings":
            yield from _differences(f"{name}:", *settings)
        elif (
            old.get("digest") != new.get("digest")
            and settings[0] == settings[1]
            and _digests(old) == _digests(new)
        ):
            yield Change(
                f"{name}: code", *(str(one.get("digest") or "")[:12] for one in (old, new))
            )


def _digests(part: Mapping[str, Any]) -> list[str]:
    return sorted(map(str, (part.get("files") or {}).values()))


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return dotted key -> value; paths of weight files are left out, since their digests tell."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{name}.")
        elif not (isinstance(value, str) and ("/" in value or "\\" in value)):
            flat[name] = value
    return flat


def _scenes(entry: RunEntry, renderer: str) -> dict[str, Any]:
    """Return the content of the scenes, and for `3dgs` which reconstruction of it was drawn: it is
    fitted to the scene's content.
    """
    found: dict[str, Any] = {
        f"content of {name}": digest[:12] for name, digest in entry.scenes.items()
    }
    if ((entry.info.get("bases") or {}).get(renderer) or renderer) == RECONSTRUCTED:
        scenes = entry.info.get("scenes") or {}
        found |= {
            f"reconstruction of {name}": (facts.get("reconstruction") or "")[:12] or None
            for name, facts in scenes.items()
        }
    return found


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
        entry: What `evaluators.statistics.paired.compare` gives, later minus earlier.
        changes: What differs between the two; empty where nothing does.
    """

    before: RunEntry
    after: RunEntry
    entry: Mapping[str, Any]
    changes: tuple[Change, ...]

    @property
    def moved(self) -> bool:
        """Tell whether these scenes, which both runs drove, show a difference: the 95 % interval
        leaves out zero and the test rejects.
        """
        return (
            difference(self.entry["ci95"], self.entry["p_value"], self.entry["direction"])
            != "none shown"
        )

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
        by_commit: Whether the runs are in the order of their commits; otherwise in that of their
            starts.
    """

    series: tuple[Series, ...]
    left_out: tuple[tuple[RunEntry, str], ...]
    by_commit: bool


def trend(entries: Sequence[RunEntry], metrics: Sequence[str]) -> Trend:
    """Join comparable runs into lines and compare each with the one before it.

    Two runs are comparable where scenes (by content hash), seeds, policy and preset are the same;
    renderers need not be, each has a line through the runs that drove it. What is compared are the
    cells that have a valid value on both sides (`evaluators.statistics.paired`).

    Args:
        entries: Runs, as `find_runs` gives them.
        metrics: Which metrics.

    Raises:
        InputError: A table of a run is damaged, or a metric is not the same quantity in two runs
            that are compared.
    """
    left_out: list[tuple[RunEntry, str]] = []
    groups: dict[Setting, list[RunEntry]] = {}
    for entry in entries:
        if entry.state != "finished":
            left_out.append((entry, entry.state))
        elif entry.kind == "fork":
            left_out.append((entry, "a fork of one rollout"))
        elif not entry.scenes or not all(entry.scenes.values()):
            left_out.append((entry, "no content hash of its scenes"))
        else:
            for setting in _settings(entry):
                groups.setdefault(setting, []).append(entry)
    refused = {id(one) for one, _ in left_out}
    joined = {id(one): one for runs in groups.values() if len(runs) > 1 for one in runs}
    alone = [one for one in entries if id(one) not in joined and id(one) not in refused]
    left_out += [(one, "no other run has its scenes, seeds, policy and preset") for one in alone]
    by_commit = bool(joined) and all(
        as_time(one.project.get("committed_at")) is not None for one in joined.values()
    )
    tables = _Tables(metrics)

    def order(entry: RunEntry) -> tuple[float, float, str]:
        """Sort by commit where all runs have the time of theirs, then by start."""
        times = as_time(entry.project.get("committed_at")) if by_commit else None, entry.started_at
        committed, began = (0.0 if time is None else time.timestamp() for time in times)
        return committed, began, str(entry.folder)

    series = [
        _series(setting, sorted(runs, key=order), metrics, tables)
        for setting, runs in groups.items()
        if len(runs) > 1
    ]
    return Trend(tuple(sorted(series, key=lambda one: -len(one.runs))), tuple(left_out), by_commit)


def _settings(entry: RunEntry) -> list[Setting]:
    info, scenes = entry.info, frozenset(entry.scenes.items())
    seeds = tuple(sorted(int(seed) for seed in info.get("seeds") or ()))
    return [
        Setting(entry.kind, str(policy), str(info.get("preset")), scenes, seeds)
        for policy in info.get("policies") or ()
    ]


def _series(
    setting: Setting, runs: Sequence[RunEntry], metrics: Sequence[str], tables: _Tables
) -> Series:
    renderers = dict.fromkeys(str(name) for one in runs for name in one.info.get("renderers") or ())
    lines = []
    for metric in metrics:
        for renderer in renderers:
            have = [one for one in runs if tables.has(one, renderer, setting.policy, metric)]
            if len(have) > 1:
                steps = tuple(
                    _step(before, after, metric, renderer, setting.policy, tables)
                    for before, after in pairwise(have)
                )
                whole = (
                    steps[0]
                    if len(steps) == 1
                    else _step(have[0], have[-1], metric, renderer, setting.policy, tables)
                )
                lines.append(Line(metric, renderer, tuple(have), steps, whole))
    return Series(setting, tuple(runs), tuple(lines))


def _step(
    before: RunEntry, after: RunEntry, metric: str, renderer: str, policy: str, tables: _Tables
) -> Step:
    there, here = (tables.rows(one, renderer, policy) for one in (before, after))
    known = after.table.joined(before.table, [metric], f"{before.folder} and {after.folder}")
    entry = compare(here, there, known.info(metric), before.folder.name, listed=0)
    return Step(before, after, entry, changes(before, after, renderer, policy))


class _Tables:
    """The rollouts of runs by renderer and policy: of each run's table only the columns of some
    metrics, read once.
    """

    def __init__(self, metrics: Sequence[str]) -> None:
        self._metrics = metrics
        self._read: dict[int, dict[tuple[str, str], list[Row]]] = {}
        self._sides: dict[tuple[int, str, str], Side] = {}

    def rows(self, entry: RunEntry, renderer: str, policy: str) -> Side:
        """Return the rollouts of a renderer and policy, sorted into cells."""
        key = (id(entry), renderer, policy)
        if key not in self._sides:
            self._sides[key] = Side.of(self._split(entry)[renderer, policy])
        return self._sides[key]

    def has(self, entry: RunEntry, renderer: str, policy: str, metric: str) -> bool:
        """Tell whether a run's renderer and policy have a metric, valid or not."""
        rows = self._split(entry).get((renderer, policy), [])
        return bool(rows) and metric in rows[0]

    def _split(self, entry: RunEntry) -> dict[tuple[str, str], list[Row]]:
        if id(entry) not in self._read:
            stated = {
                name for table in (entry.summary.get("metrics") or {}).values() for name in table
            }
            metrics = [name for name in self._metrics if name in stated]
            columns = [*ROLLOUTS_TABLE.required, *(column.name for column in columns_of(metrics))]
            split: dict[tuple[str, str], list[Row]] = {}
            for row in ROLLOUTS_TABLE.read(entry.folder / ROLLOUTS, CHECK, columns).to_pylist():
                split.setdefault((row["renderer"], row["policy"]), []).append(row)
            self._read[id(entry)] = split
        return self._read[id(entry)]
