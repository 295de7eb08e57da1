"""The trend page: one offline HTML file with the report's look."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from alpasim_plugin.io.atomic import write_text
from evaluators.report.charts import Chart
from evaluators.report.html import asset
from evaluators.report.metric_info import meaning
from evaluators.report.numbers import plural
from evaluators.report.tables import PairRow
from evaluators.runs.charts import trend_chart
from evaluators.runs.choose import shown_folder
from evaluators.runs.entry import RunEntry
from evaluators.runs.steps import StepRow, changed_text, pair_row, setting_text, step_rows, whole_text
from evaluators.runs.trend import Line, Series, Step, Trend

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
    environment = Environment(
        loader=PackageLoader("evaluators.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    style = "\n".join(asset(environment, name) for name in ("theme.css", "report.css", "trend.css"))
    script = "\n".join(asset(environment, name) for name in ("theme.js", "report.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    names = dict.fromkeys(line.renderer for series in found.series for line in series.lines)
    colours = {name: k for k, name in enumerate(names)}
    sections = [_section(series, colours) for series in found.series]
    steps = [step for series in found.series for line in series.lines for step in line.steps]
    moved = _moved(found, colours)
    return environment.get_template("trend.html.j2").render(
        style=Markup(style), script=Markup(script), script_hash=digest, plural=plural, sections=sections, colours=colours,
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


def _section(series: Series, colours: dict[str, int]) -> Section:
    parts = []
    for metric in dict.fromkeys(line.metric for line in series.lines):
        lines = tuple((line, whole_text(line), tuple(step_rows(series, line))) for line in series.lines if line.metric == metric)
        parts.append(MetricPart(metric, meaning(metric), trend_chart(series, metric, colours), lines))
    return Section(setting_text(series), series, tuple(parts))


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
