"""The trend page: one offline HTML file with the report's look."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np

from alpasim_plugin.core.atomic import write_text
from evaluators.report.charts import MARKERS, N_COLOURS, VARIANT, Axes, Chart
from evaluators.report.html import render_page
from evaluators.report.numbers import finite, interval
from evaluators.report.runs import RunEntry, shown_folder
from evaluators.report.tables import PairRow
from evaluators.report.trend import Line, Series, Step, Trend
from evaluators.report.trend_tables import (
    StepRow,
    changed_text,
    pair_row,
    setting_text,
    step_rows,
    whole_text,
)

DOING = "writing a trend page"
OPEN_ROWS = 12  # of a table that is open at once; longer ones are a click away
MOST_MOVED, MOST_ROWS = 40, 150  # the newest; `simrun runs --steps --json` has all


@dataclass(frozen=True)
class MovedRow:
    """A step that moved a metric."""

    line: Line
    step: Step
    colour: int
    pair: PairRow
    changed: str
    section: int


@dataclass(frozen=True)
class MetricPart:
    """One metric of a series: its chart, and a table of the same numbers for each renderer."""

    metric: str
    meaning: str
    chart: Chart
    lines: tuple[
        tuple[Line, str, tuple[StepRow, ...]], ...
    ]  # with the sentence over the whole line


@dataclass(frozen=True)
class Section:
    """One series."""

    title: str
    series: Series
    parts: tuple[MetricPart, ...]


def write_trend(found: Trend, roots: Sequence[Path], path: Path) -> None:
    """Write the page.

    Args:
        found: At least one series.
        roots: Where runs were looked for.
        path: The file; replaced.

    Raises:
        InfrastructureError: The disk refuses.
    """
    write_text(path, render_trend(found, roots, path.parent))


def render_trend(found: Trend, roots: Sequence[Path], beside: Path) -> str:
    """Return the page; links to the runs' reports are relative to the folder ``beside``."""
    names = dict.fromkeys(line.renderer for series in found.series for line in series.lines)
    colours = {name: k for k, name in enumerate(names)}
    sections = []
    for series in found.series:
        parts = []
        for metric in dict.fromkeys(line.metric for line in series.lines):
            lines = tuple(
                (line, whole_text(line), tuple(step_rows(series, line)))
                for line in series.lines
                if line.metric == metric
            )
            meaning = series.runs[-1].table.shown(metric).help
            parts.append(MetricPart(metric, meaning, trend_chart(series, metric, colours), lines))
        sections.append(Section(setting_text(series), series, tuple(parts)))
    steps = [step for series in found.series for line in series.lines for step in line.steps]
    moved = _moved(found, colours)
    return render_page(
        "trend.html.j2",
        ("theme", "report", "trend"),
        ("theme", "report"),
        sections=sections,
        colours=colours,
        moved=moved[:MOST_MOVED],
        more_moved=max(0, len(moved) - MOST_MOVED),
        n_steps=len(steps),
        false_alarms=0.05 * len(steps),
        n_runs=len({id(run) for series in found.series for run in series.runs}),
        by_commit=found.by_commit,
        open_rows=OPEN_ROWS,
        most_rows=MOST_ROWS,
        left_out=[(shown_folder(entry.folder, roots), why) for entry, why in found.left_out],
        where=", ".join(map(str, roots)),
        folder=lambda run: shown_folder(run.folder, roots),
        href=lambda run: report_href(run, beside),
    )


def report_href(run: RunEntry, beside: Path) -> str | None:
    """Return the address of a run's report relative to a folder; None where it has none."""
    report = run.folder / "report.html"
    return quote(os.path.relpath(report.resolve(), beside.resolve())) if report.is_file() else None


def _moved(found: Trend, colours: dict[str, int]) -> list[MovedRow]:
    """List the steps that moved a metric, the newest first, and those whose rollouts differ
    although nothing else does.
    """
    rows = []
    for section, series in enumerate(found.series):
        place = {id(run): k for k, run in enumerate(series.runs)}
        for line in series.lines:
            for step in line.steps:
                if step.moved or step.unexplained:
                    row = MovedRow(
                        line,
                        step,
                        colours[line.renderer],
                        pair_row(line, step),
                        changed_text(step, most=8),
                        section,
                    )
                    rows.append((section, -place[id(step.after)], row))
    return [row for *_, row in sorted(rows, key=lambda one: one[:2])]


WIDTH_PT, HEIGHT_PT = 691.2, 216.0
MOST_TICKS = 14
ASIDE = 0.16  # between the renderers of one run, in runs
NAME_LETTERS = 12
DENSE = 120  # runs; with more, marks and bars would cover one another: lines and bands


def trend_chart(series: Series, metric: str, colours: Mapping[str, int]) -> Chart:
    """Draw means with their 95 % intervals over the runs of a series, a line for each renderer. A
    ring marks a step that moved it.

    Args:
        series: Comparable runs.
        metric: Its name.
        colours: Renderer -> number of its colour.
    """
    lines = [line for line in series.lines if line.metric == metric]
    place = {id(run): k for k, run in enumerate(series.runs)}
    facts = [
        run.metric(metric, line.renderer, series.setting.policy)
        for line in lines
        for run in line.runs
    ]
    unit = next((str(one["unit"]) for one in facts if one.get("unit")), "")
    scale = 100.0 if series.runs[-1].table.shown(metric).in_percent else 1.0
    is_dense = len(series.runs) > DENSE
    axes = Axes(HEIGHT_PT, 61.0, 50.0, WIDTH_PT)
    for number, line in enumerate(lines):
        colour = VARIANT[colours[line.renderer] % N_COLOURS]
        x = np.array([place[id(run)] for run in line.runs]) + ASIDE * (
            number - (len(lines) - 1) / 2
        )
        means, bars = _values(series, line, scale)
        low, high = np.array([(np.nan, np.nan) if one is None else one for one in bars]).T
        axes.line(x, means, colour, 1.2 if is_dense else 1.5)
        if is_dense:
            axes.band(x, low, high, colour)
        else:
            axes.points(x, means, colour, MARKERS[colours[line.renderer] % len(MARKERS)], 4.5)
            for at, *bar in zip(x, low, high, strict=True):
                axes.line([at, at], bar, colour, 1.2, opacity=0.55)
        moved = [k + 1 for k, step in enumerate(line.steps) if step.moved]
        axes.points(x[moved], np.asarray(means)[moved], colour, size=13.0, ring=1.6)
    every = max(1, -(-len(series.runs) // MOST_TICKS))
    axes.ticks[0] = [
        (float(k), label_of(series.runs[k])) for k in range(0, len(series.runs), every)
    ]
    axes.limits[0], axes.tilted, axes.room[1] = (-0.5, len(series.runs) - 0.5), True, 0.12
    axes.labels[1] = "%" if scale == 100.0 else unit
    direction = next((str(one["direction"]) for one in facts if one.get("direction")), "none")
    better = {"lower": "Lower is better. ", "higher": "Higher is better. "}.get(direction, "")
    note = f"{better}{'Bands' if is_dense else 'Bars'}: 95 % over scenes. A ring: moved against the run before it, on the same cells."
    return Chart(metric, note, axes.svg())


def label_of(run: RunEntry) -> str:
    """Name a run on an axis: by its commit, else by its folder."""
    name = run.folder.name
    return run.commit_text or (
        name if len(name) <= NAME_LETTERS else f"\u2026{name[-NAME_LETTERS + 1 :]}"
    )


def _values(
    series: Series, line: Line, scale: float
) -> tuple[list[float], list[tuple[float, float] | None]]:
    """Return the means, NaN where there is none, and the bounds."""
    found = [run.metric(line.metric, line.renderer, series.setting.policy) for run in line.runs]
    means = [finite(one.get("mean")) for one in found]
    bounds = [interval(one.get("ci95_clustered")) for one in found]
    scaled = [None if one is None else (one[0] * scale, one[1] * scale) for one in bounds]
    return [float("nan") if one is None else one * scale for one in means], scaled
