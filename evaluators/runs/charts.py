"""The chart of one metric over comparable runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np

from evaluators.report.charts import MUTED, N_COLOURS, RC, VARIANT, Chart, new_axes, themed_svg
from evaluators.report.figures import MARKERS
from evaluators.report.metric_info import in_percent
from evaluators.report.numbers import finite, interval
from evaluators.runs.entry import RunEntry
from evaluators.runs.trend import Line, Series

WIDTH_IN, HEIGHT_IN = 9.6, 3.0
MOST_TICKS = 14
ASIDE = 0.16  # between the renderers of one run, in runs
NAME_LETTERS = 12
DENSE = 120  # runs; with more, marks and bars would cover one another: lines and bands


def trend_chart(series: Series, metric: str, colours: Mapping[str, int]) -> Chart:
    """Draw means with their 95 % intervals over the runs of a series, a line a renderer; a ring marks a step that moved the metric.

    Args:
        series: Comparable runs.
        metric: Its name.
        colours: Renderer -> number of its colour.
    """
    lines = [line for line in series.lines if line.metric == metric]
    place = {id(run): k for k, run in enumerate(series.runs)}
    facts = [run.metric(metric, line.renderer, series.setting.policy) for line in lines for run in line.runs]
    unit = next((str(one["unit"]) for one in facts if one.get("unit")), "")
    scale = 100.0 if in_percent(metric, unit) else 1.0
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
    better = {"lower": "Lower is better. ", "higher": "Higher is better. "}.get(_direction(facts), "")
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


def _direction(facts: Sequence[Mapping[str, object]]) -> str:
    return next((str(one["direction"]) for one in facts if one.get("direction")), "none")
