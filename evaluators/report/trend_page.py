"""The trend page: one offline HTML file with the report's look."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import matplotlib as mpl
import numpy as np

from alpasim_plugin.io.atomic import write_text
from evaluators.report.charts import MARKERS, MUTED, N_COLOURS, RC, VARIANT, Chart, new_axes, themed_svg
from evaluators.report.html import render_page
from evaluators.report.numbers import finite, interval
from evaluators.report.runs import RunEntry, shown_folder
from evaluators.report.tables import PairRow
from evaluators.report.trend import Line, Series, Step, Trend
from evaluators.report.trend_tables import StepRow, changed_text, pair_row, setting_text, step_rows, whole_text

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
    lines: tuple[tuple[Line, str, tuple[StepRow, ...]], ...]  # with the sentence over the whole line


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
    write_text(path, render_trend(found, roots, path.parent), DOING)


def render_trend(found: Trend, roots: Sequence[Path], beside: Path) -> str:
    """Return the page; links to the runs' reports are relative to the folder ``beside``."""
    names = dict.fromkeys(line.renderer for series in found.series for line in series.lines)
    colours = {name: k for k, name in enumerate(names)}
    sections = []
    for series in found.series:
        parts = []
        for metric in dict.fromkeys(line.metric for line in series.lines):
            lines = tuple((line, whole_text(line), tuple(step_rows(series, line))) for line in series.lines if line.metric == metric)
            meaning = series.runs[-1].table.shown(metric).help
            parts.append(MetricPart(metric, meaning, trend_chart(series, metric, colours), lines))
        sections.append(Section(setting_text(series), series, tuple(parts)))
    steps = [step for series in found.series for line in series.lines for step in line.steps]
    moved = _moved(found, colours)
    return render_page(
        "trend.html.j2", ("theme", "report", "trend"), ("theme", "report"), sections=sections, colours=colours,
        moved=moved[:MOST_MOVED], more_moved=max(0, len(moved) - MOST_MOVED), n_steps=len(steps), false_alarms=0.05 * len(steps),
        n_runs=len({id(run) for series in found.series for run in series.runs}), by_commit=found.by_commit,
        open_rows=OPEN_ROWS, most_rows=MOST_ROWS,
        left_out=[(shown_folder(entry.folder, roots), why) for entry, why in found.left_out], where=", ".join(map(str, roots)),
        folder=lambda run: shown_folder(run.folder, roots), href=lambda run: report_href(run, beside),
    )  # fmt: skip


def report_href(run: RunEntry, beside: Path) -> str | None:
    """Return the address of a run's report relative to a folder; None where it has none."""
    report = run.folder / "report.html"
    return quote(os.path.relpath(report.resolve(), beside.resolve())) if report.is_file() else None


def _moved(found: Trend, colours: dict[str, int]) -> list[MovedRow]:
    """List the steps that moved a metric, the newest first, and those whose rollouts differ although nothing else does."""
    rows = []
    for section, series in enumerate(found.series):
        place = {id(run): k for k, run in enumerate(series.runs)}
        for line in series.lines:
            for step in line.steps:
                if step.moved or step.unexplained:
                    row = MovedRow(line, step, colours[line.renderer], pair_row(line, step), changed_text(step, most=8), section)
                    rows.append((section, -place[id(step.after)], row))
    return [row for *_, row in sorted(rows, key=lambda one: one[:2])]


WIDTH_IN, HEIGHT_IN = 9.6, 3.0
MOST_TICKS = 14
ASIDE = 0.16  # between the renderers of one run, in runs
NAME_LETTERS = 12
DENSE = 120  # runs; with more, marks and bars would cover one another: lines and bands


def trend_chart(series: Series, metric: str, colours: Mapping[str, int]) -> Chart:
    """Draw means with their 95 % intervals over the runs of a series, a line for each renderer. A ring marks a step that moved it.

    Args:
        series: Comparable runs.
        metric: Its name.
        colours: Renderer -> number of its colour.
    """
    lines = [line for line in series.lines if line.metric == metric]
    place = {id(run): k for k, run in enumerate(series.runs)}
    facts = [run.metric(metric, line.renderer, series.setting.policy) for line in lines for run in line.runs]
    unit = next((str(one["unit"]) for one in facts if one.get("unit")), "")
    scale = 100.0 if series.runs[-1].table.shown(metric).in_percent else 1.0
    is_dense = len(series.runs) > DENSE
    with mpl.rc_context(RC):
        figure, axes = new_axes(HEIGHT_IN, 0.85, 0.7, WIDTH_IN)
        for number, line in enumerate(lines):
            colour = VARIANT[colours[line.renderer] % N_COLOURS]
            x = np.array([place[id(run)] for run in line.runs]) + ASIDE * (number - (len(lines) - 1) / 2)
            means, bars = _values(series, line, scale)
            low, high = np.array([(np.nan, np.nan) if one is None else one for one in bars]).T
            if is_dense:
                axes.plot(x, means, color=colour, linewidth=1.2)
                axes.fill_between(x, low, high, color=colour, alpha=0.16, linewidth=0)
            else:
                marker = MARKERS[colours[line.renderer] % len(MARKERS)]
                axes.plot(x, means, color=colour, linewidth=1.5, marker=marker, markersize=4.5)
                axes.vlines(x, low, high, color=colour, linewidth=1.2, alpha=0.55)
            moved = [k + 1 for k, step in enumerate(line.steps) if step.moved]
            axes.plot(
                x[moved], np.asarray(means)[moved], "o", markersize=13, markerfacecolor="none", markeredgecolor=colour, markeredgewidth=1.6
            )
        every = max(1, -(-len(series.runs) // MOST_TICKS))
        ticks = range(0, len(series.runs), every)
        axes.set_xticks(list(ticks), [label_of(series.runs[k]) for k in ticks], rotation=30, ha="right", fontsize=9)
        axes.set_xlim(-0.5, len(series.runs) - 0.5)
        axes.set_ylabel("%" if scale == 100.0 else unit, color=MUTED)
        axes.tick_params(length=0)
        axes.margins(y=0.12)
        svg = themed_svg(figure)
    direction = next((str(one["direction"]) for one in facts if one.get("direction")), "none")
    better = {"lower": "Lower is better. ", "higher": "Higher is better. "}.get(direction, "")
    note = f"{better}{'Bands' if is_dense else 'Bars'}: 95 % over scenes. A ring: moved against the run before it, on the same cells."
    return Chart(metric, note, svg)


def label_of(run: RunEntry) -> str:
    """Name a run on an axis: by its commit, else by its folder."""
    name = run.folder.name
    return run.commit_text or (name if len(name) <= NAME_LETTERS else f"\u2026{name[-NAME_LETTERS + 1 :]}")


def _values(series: Series, line: Line, scale: float) -> tuple[list[float], list[tuple[float, float] | None]]:
    """Return the means, NaN where there is none, and the bounds."""
    found = [run.metric(line.metric, line.renderer, series.setting.policy) for run in line.runs]
    means = [finite(one.get("mean")) for one in found]
    bounds = [interval(one.get("ci95_clustered")) for one in found]
    scaled = [None if one is None else (one[0] * scale, one[1] * scale) for one in bounds]
    return [float("nan") if one is None else one * scale for one in means], scaled
