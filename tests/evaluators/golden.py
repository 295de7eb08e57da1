"""Read the golden logs for parity tests: a log with its scene, and AlpaSim's own scores of it.

``python -m tests.evaluators.golden DATA/alpasim-golden`` prints the parity table over all its logs;
with a second folder, in which another version of AlpaSim's evaluation has scored ``rollouts``, it
compares with that one, under the preset that is named third.
"""

import json
import sys
from collections import Counter, defaultdict
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from alpasim_plugin.log import read_asl
from evaluators import PRESETS, score
from evaluators.alpasim import (
    EvalSettings,
    ScoredRollout,
    load_settings,
    over_sweeps,
    reduce_run,
    scene_score,
)
from tests.scenarios.usdz_scene import read_usdz_scene

RUN = ("00000000-0000-4000-8000-00000000000a", "golden-dev")
CASES = ("failed-rollout", "no-actors", "rails-stripped", "no-map", "no-road-edges")
SETS = ("rollouts", "other-settings", *CASES)


read_log = lru_cache(maxsize=64)(read_asl)
read_scene = lru_cache(maxsize=32)(read_usdz_scene)


def read_case(log, scene, rails=True):
    """Return a log and its scene; several settings score the same ones."""
    return read_log(log), read_scene(scene, rails)


@lru_cache(maxsize=128)
def scored(log, archive, preset, rails=True):
    """Score a log against its scene; several tests look at the same series."""
    return tuple(score(*read_case(log, archive, rails), preset))


def close(got, want):
    """Compare as the goldens do: 1e-4 absolute or 1e-5 relative, since poses are float32 there."""
    same = got == want or (np.isnan(got) and np.isnan(want))
    return same or abs(got - want) <= max(1e-4, 1e-5 * abs(want))


def expected(folder):
    """Return AlpaSim's table in a log's folder: metric -> times, values, valid; the placeholder row
    of an empty metric is left out.
    """
    table = pq.read_table(folder / "expected_metrics.parquet").to_pydict()
    out = {}
    for name, t, value, valid in zip(
        table["name"], table["timestamps_us"], table["values"], table["valid"], strict=True
    ):
        rows = out.setdefault(name, [])
        if t is not None:
            rows.append((t, value, valid))
    empty = (np.zeros(0),) * 3
    return {
        name: tuple(np.array(column) for column in zip(*rows, strict=True)) if rows else empty
        for name, rows in out.items()
    }


@dataclass(frozen=True)
class GoldenSet:
    """Logs that AlpaSim scored with one settings file."""

    name: str
    folder: Path  # holds its tables
    logs: tuple[Path, ...]
    scenes: Path
    settings: EvalSettings
    aggregate: str
    rails: bool = True

    def series(self, log):
        return scored(
            log, self.scenes / f"{log.parent.parent.name}.usdz", self.settings.preset(), self.rails
        )

    def run(self):
        return [
            ScoredRollout(log.parent.parent.name, log.parent.name, self.series(log), *RUN)
            for log in self.logs
        ]

    def table(self, log):
        """Give the folder with AlpaSim's table of a log."""
        return self.folder / "rollouts" / log.parent.parent.name / log.parent.name


def golden_set(root, name):
    """Return the main set ("rollouts"), "other-settings", or one of the cases."""
    if name == "rollouts":
        logs = sorted(root.glob("rollouts/*/*/rollout.asl"))
        return GoldenSet(
            name,
            root,
            tuple(logs),
            root / "scenes",
            load_settings(root / "eval-config.yaml"),
            "aggregate",
        )
    if name == "other-settings":
        folder = root / name
        logs = [
            root / table.relative_to(folder).with_name("rollout.asl")
            for table in sorted(folder.glob("rollouts/*/*/*.parquet"))
        ]
        return GoldenSet(
            name,
            folder,
            tuple(logs),
            root / "scenes",
            load_settings(folder / "eval-config.yaml"),
            "aggregate",
        )
    folder = root / "cases" / name
    unscored = (folder / "aggregate-no-scene-score").exists()
    settings = load_settings(
        folder / ("eval-config-no-scene-score.yaml" if unscored else "eval-config.yaml")
    )
    aggregate = "aggregate-no-scene-score" if unscored else "aggregate"
    logs = sorted(folder.glob("rollouts/*/*/rollout.asl"))
    return GoldenSet(
        name, folder, tuple(logs), folder / "scenes", settings, aggregate, name != "rails-stripped"
    )


class Tally:
    """Count of compared values, of equal ones, and the largest difference."""

    def __init__(self):
        self.logs, self.values, self.equal, self.largest = 0, 0, 0, 0.0

    def add(self, got, want):
        got = np.asarray(got, dtype=float)
        want = np.asarray(want, dtype=float)
        same = (got == want) | (np.isnan(got) & np.isnan(want))
        off = np.where(same, 0.0, np.abs(np.where(same, 0.0, got) - np.where(same, 0.0, want)))
        self.logs, self.values, self.equal = (
            self.logs + 1,
            self.values + len(want),
            self.equal + int(same.sum()),
        )
        self.largest = max(self.largest, float(off.max(initial=0.0)))

    def row(self, name):
        return f"| {name} | {self.logs} | {self.values} | {self.equal} | {self.largest:.1e} |"


def parity_table(root):
    """Compare every step of every metric, and every value of the tables over sweeps, of all golden
    sets.
    """
    steps = defaultdict(Tally)
    tables = defaultdict(Tally)
    for name in SETS:
        one = golden_set(root, name)
        for log in one.logs:
            found = {series.name: series for series in one.series(log)}
            for metric, (_, value, _) in expected(one.table(log)).items():
                steps[metric].add(found[metric].value, value)
        reduced = reduce_run(one.run(), one.settings.preset())
        want = pq.read_table(one.folder / one.aggregate / "metrics_results.parquet").to_pylist()[0]
        numbers = {key: value for key, value in over_sweeps(reduced).items() if key in want}
        assert set(numbers) == set(want) - {"run_uuid", "run_name"}
        both = [(numbers[key], want[key]) for key in numbers if want[key] is not None]
        tables[f"over sweeps, {name}"].add(*np.array(both, dtype=float).T)
        rows = json.loads((one.folder / one.aggregate / "results-summary.json").read_text())[
            "rollouts"
        ]
        marks = {(row["clipgt_id"], row["rollout_id"]): row.get("score") for row in rows}
        kept = [r for r in reduced if not r.dropped and one.settings.scene_score.enabled]
        if kept:
            scores = [scene_score(r.values, one.settings.scene_score).score for r in kept]
            tables[f"scene score, {name}"].add(
                np.array(scores), np.array([marks[r.scored.scene, r.scored.rollout] for r in kept])
            )
    lines = [
        "| metric | logs | values | exactly equal | largest difference |",
        "|---|---|---|---|---|",
    ]
    lines += [tally.row(f"`{metric}`") for metric, tally in sorted(steps.items())]
    lines += [
        "",
        "| table | tables | values | exactly equal | largest difference |",
        "|---|---|---|---|---|",
    ]
    return "\n".join([*lines, *(tally.row(name) for name, tally in tables.items())])


@dataclass
class Compared:
    """What the comparison with another version of the evaluation gave.

    Attributes:
        values: How many step values both have.
        unequal: Of these, how many differ by metric (`close`).
        only: Rows that one side alone has, by side and metric.
        scores: Number of scene scores that both have.
        unequal_scores: Scene and rollout, theirs and ours, of those that differ.
    """

    values: int
    unequal: Counter[str]
    only: Counter[tuple[str, str]]
    scores: int
    unequal_scores: list[tuple[str, str, float | None, float | None]]


def compare_with(root, evaluated, version=PRESETS["alpasim"]):
    """Compare the scores of the logs of ``rollouts`` with those of another version of AlpaSim's
    evaluation.

    Args:
        root: Folder of the golden logs.
        evaluated: Its ``rollouts/*/*/metrics.parquet``, ``aggregate/results-summary.json`` and
            ``eval-config.yaml``; logs that it lacks are not compared.
        version: Which rules of ours.
    """
    settings = load_settings(evaluated / "eval-config.yaml")
    chosen = settings.preset(version)
    compared = Compared(0, Counter(), Counter(), 0, [])
    rollouts = []
    for table in sorted(evaluated.glob("rollouts/*/*/metrics.parquet")):
        scene, name = table.parts[-3:-1]
        log = root / "rollouts" / scene / name / "rollout.asl"
        series = scored(log, root / "scenes" / f"{scene}.usdz", chosen)
        rollouts.append(ScoredRollout(scene, name, series, *RUN))
        compare_steps(compared, series, table)
    summary = json.loads((evaluated / "aggregate/results-summary.json").read_text())
    theirs = {
        (row["clipgt_id"], row["rollout_id"]): row.get("score") for row in summary["rollouts"]
    }
    ours = {
        (reduced.scored.scene, reduced.scored.rollout): None
        if reduced.dropped
        else scene_score(reduced.values, settings.scene_score).score
        for reduced in reduce_run(rollouts, chosen)
    }
    for key in sorted(theirs.keys() | ours.keys()):
        pair = theirs.get(key), ours.get(key)
        compared.scores += None not in pair
        if None in pair or not close(*pair):
            compared.unequal_scores.append((*key, *pair))
    return compared


def compare_steps(compared, series, table):
    """Count the equal step values of one log."""
    ours = {
        (one.name, int(t_us)): float(value)
        for one in series
        for t_us, value in zip(one.t_us, one.value, strict=True)
    }
    columns = pq.read_table(table, columns=["name", "timestamps_us", "values"]).to_pydict()
    theirs = {
        (name, int(t_us)): value
        for name, t_us, value in zip(*columns.values(), strict=True)
        if t_us is not None
    }
    compared.only.update(("theirs", name) for name, _ in theirs.keys() - ours.keys())
    compared.only.update(("ours", name) for name, _ in ours.keys() - theirs.keys())
    both = theirs.keys() & ours.keys()
    compared.values += len(both)
    compared.unequal.update(key[0] for key in both if not close(ours[key], theirs[key]))


if __name__ == "__main__":
    folders = [Path(argument) for argument in sys.argv[1:3]]
    if len(folders) == 1:
        print(parity_table(folders[0]))
    else:
        print(compare_with(*folders, *(PRESETS[name] for name in sys.argv[3:])))
