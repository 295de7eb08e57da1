"""What the stages measured, by row of the paper's tables: values by scene, distances between sets of
clips, and the closed loop.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_json_object
from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.paper.printed import printed
from alpasim_plugin.lab.video_metrics.facts import MS
from evaluators.results import Difference, Mean, read_summary

QUALITY_FILE = "quality.json"
SUMMARY_FILE = "summary.json"


@dataclass(frozen=True)
class Quality:
    """Open-loop quality.

    Attributes:
        by_scene: ROW -> METRIC -> SCENE -> value.
        sets: ROW -> METRIC -> distance of its clips from the true ones.
    """

    by_scene: Mapping[str, Mapping[str, Mapping[str, float]]]
    sets: Mapping[str, Mapping[str, Mapping[str, Any]]]

    def differences(self, row: str, other: str, metric: str) -> F64:
        """Return ``row`` minus ``other`` on the scenes ``(N,)`` that carry the metric in both."""
        ours = self.by_scene[row].get(metric, {})
        theirs = self.by_scene[other].get(metric, {})
        return np.array([ours[scene] - theirs[scene] for scene in ours if scene in theirs])

    def with_times_of(self, times: Quality | None) -> Quality:
        """Return the record with the times of another, which measured all rows side by side; without
        times where that is None. Its own are of stages that ran at other hours, on machines that may
        differ.
        """
        by_scene: dict[str, Mapping[str, Mapping[str, float]]] = {}
        for row, metrics in self.by_scene.items():
            by_scene[row] = {name: values for name, values in metrics.items() if name != MS}
            if times is not None and MS in times.by_scene.get(row, {}):
                by_scene[row] = {**by_scene[row], MS: times.by_scene[row][MS]}
        return Quality(by_scene, self.sets)


@dataclass(frozen=True)
class ClosedLoop:
    """A driven run, its renderers by their rows in the table.

    Attributes:
        means: ROW -> METRIC -> mean.
        minus_raw: ROW -> METRIC -> the difference from the raw render.
    """

    means: Mapping[str, Mapping[str, Mean]] = field(default_factory=dict)
    minus_raw: Mapping[str, Mapping[str, Difference]] = field(default_factory=dict)


def read_quality(files: Sequence[Path]) -> Quality:
    """Read records of ``simrun bench quality``.

    Args:
        files: ``quality.json`` of each, which together hold every variant once; the truth may be in
            several.

    Raises:
        InputError: No such file, or one that an older program wrote.
    """
    by_scene: dict[str, Any] = {}
    sets: dict[str, Any] = {}
    for path in files:
        record = read_json_object(path)
        if "by_scene" not in record:
            raise InputError(
                f"{path}: no member by_scene", "Make it again with 'simrun bench quality'."
            )
        by_scene |= record["by_scene"]
        sets |= record["sets"]
    return Quality(by_scene, sets)


def read_drive_spreads(path: Path) -> dict[str, float]:
    """Return the largest spread between scenes of a paired difference, by metric of the paper.

    A metric without a spread, such as an event that no rollout had, is left out: it says nothing
    of other scenes.

    Args:
        path: ``summary.json`` of a run, or the document of ``simrun compare --json``.

    Raises:
        InputError: No such file, or no paired differences in it.
    """
    record = read_json_object(path)
    if not record.get("paired"):
        raise InputError(
            f"{path}: no paired differences",
            "Name the summary.json of a run with a baseline, or a document of 'simrun compare --json'.",
        )
    spreads: dict[str, float] = {}
    for name, facts in printed().metrics.items():
        values = [
            float(table[ours]["spread"])
            for table in record["paired"].values()
            for ours in facts.ours
            if ours in table and table[ours]["spread"]
        ]
        if values:
            spreads[name] = max(values)
    return spreads


def read_closed_loop(path: Path, rows: Sequence[str]) -> ClosedLoop:
    """Read the summary of a run.

    Args:
        path: Its ``summary.json``.
        rows: Names in the table, in the order of the run's renderers, the raw render first.

    Raises:
        InputError: It does not hold as many renderers.
    """
    summary = read_summary(path, "Drive it again.")
    names = list(summary.metrics)
    if len(names) != len(rows):
        raise InputError(
            f"{path}: renderers {', '.join(names)}; wanted {', '.join(rows)}",
            "Drive exactly these.",
        )
    row_of = dict(zip(names, rows, strict=True))
    return ClosedLoop(
        {row_of[name]: table for name, table in summary.metrics.items()},
        {row_of[name]: table for name, table in summary.paired.items()},
    )
