"""The boundary at which variants start to fail: its sentence, and its section in the report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from alpasim_plugin.core.json_types import JsonView
from evaluators.pages.charts import MUTED, VARIANT, Chart, chart_of, new_axes
from evaluators.statistics.numbers import decimals, fixed, plural

if TYPE_CHECKING:  # slow to load
    from matplotlib.axes import Axes

POINTS = "Large dots: the rollout failed; small ones: it did not."


def sentence_of(record: JsonView) -> str:
    """Say in one line where each variant starts to fail, and how far the boundaries differ.

    Args:
        record: The member ``boundary`` of ``summary.json``.
    """
    is_area = isinstance(record["parameter"], list)
    unit = "%" if is_area else record["unit"]
    texts = []
    for name, facts in record["variants"].items():
        text = f"{name} has no boundary: {facts.get('reason')}"
        if "areas" in facts:
            text = f"{name} fails in {number(facts, unit)} of the rectangle"
            if facts["contradictions"]:
                text += f", where {plural(facts['contradictions'], 'point')} contradict others"
        elif "value" in facts:
            text = f"{name} fails {facts['fails']} {number(facts, unit)}"
            if facts.get("changes", 1) > 1:
                text += f", where its outcome changes {facts['changes']} times"
        outcomes = {has_failed for one in facts["outcomes"].values() for *_, has_failed in one}
        if "areas" in facts and len(outcomes) == 1:
            text = f"{name} {'fails everywhere' if outcomes.pop() else 'fails nowhere'}"
        texts.append(text)
    for name, facts in record["differences"].items():
        texts.append(f"{name} minus {facts['baseline']}: {number(facts, unit, sign=True)}")
    members = [record[name] for name in ("parameter", "range", "reachable")]
    where = [
        f"{key} from {low:g} to {high:g}"
        + (
            f" (the scene can be built from {least:g} to {most:g} only)"
            if (least, most) != (low, high)
            else ""
        )
        for key, (low, high), (least, most) in (
            zip(*members, strict=True) if is_area else [members]
        )
    ]
    if record["unreachable"]:
        texts.append(f"{plural(len(record['unreachable']), 'point')} cannot be built")
    share = 100 * record["rollouts"] / record["grid_rollouts"]
    stopped = f", stopped: {record['stopped']}" if record["stopped"] else ""
    return (
        f"{', '.join(where)}: {'; '.join(texts)}; "
        f"{record['rollouts']} rollouts, {share:.0f} % of a grid's{stopped}"
    )


def number(facts: JsonView, unit: str, sign: bool = False) -> str:
    """Write an estimate with its interval, such as ``6.4 m (6.1 to 6.8)``; a share in percent."""
    scale = 100 if unit == "%" else 1
    values = [scale * facts[name] for name in ("value", "low", "high")]
    places = decimals(*values)
    value, low, high = (fixed(one, places, sign=sign) for one in values)
    return f"{value} {unit} ({low} to {high})".replace("  ", " ")


def boundary_section(record: JsonView | None) -> dict[str, Any] | None:
    """Return the section of a run that searched for boundaries, None of any other."""
    if record is None:
        return None
    charts = [chart(record)] if isinstance(record["unit"], str) else area_charts(record)
    return {"title": record["sentence"], "charts": charts}


def chart(record: JsonView) -> Chart:
    """Draw every driven point, a row for each variant and seed, with boundaries and intervals."""
    names = list(record["variants"])
    axes = new_axes(_label(record["parameter"], record["unit"]), "")
    axes.set_yticks(range(len(names)), names, parse_math=False)
    for row, facts in enumerate(record["variants"].values()):
        colour = VARIANT[row % len(VARIANT)]
        seeds = list(facts["outcomes"].values())
        for seed, outcomes in enumerate(seeds):
            y = row + 0.6 * (seed + 1) / (len(seeds) + 1) - 0.3
            for value, has_failed in outcomes:
                _draw_point(axes, value, y, has_failed, colour)
        if "value" in facts:
            ends = [row - 0.35, row + 0.35]
            axes.fill_betweenx(ends, facts["low"], facts["high"], color=colour, alpha=0.16)
            axes.plot([facts["value"]] * 2, ends, color=colour)
    axes.set_ylim(-0.6, len(names) - 0.4)
    note = f"{POINTS} Line and band: the boundary and its interval of 95 %."
    return chart_of(axes, "Boundary", note)


def area_charts(record: JsonView) -> list[Chart]:
    """Draw of each variant every driven point, and the staircases between which the boundary of
    each seed runs.
    """
    charts = []
    labels = [_label(*one) for one in zip(record["parameter"], record["unit"], strict=True)]
    for row, (name, facts) in enumerate(record["variants"].items()):
        colour = VARIANT[row % len(VARIANT)]
        axes = new_axes(*labels)
        axes.use_sticky_edges = False  # points on an edge are not cut
        for outcomes in facts["outcomes"].values():
            for x, y, has_failed in outcomes:
                _draw_point(axes, x, y, has_failed, colour)
        for area in facts.get("areas", {}).values():
            low, high = record["reachable"][0]
            edges = np.linspace(low, high, len(area["lower"]) + 1)
            lower = area["lower"]
            upper = area["upper"]
            axes.stairs(upper, edges, baseline=lower, fill=True, color=colour, alpha=0.16)
            for one in (lower, upper):
                axes.stairs(one, edges, baseline=None, color=colour)
        note = f"{POINTS} Between the staircases of a seed the outcome is undecided."
        charts.append(chart_of(axes, f"Where {name} fails", note))
    return charts


def _label(parameter: str, unit: str) -> str:
    return f"{parameter}, {unit}" if unit else parameter


def _draw_point(axes: Axes, x: float, y: float, has_failed: bool, colour: str) -> None:
    shade, size = (colour, 6.0) if has_failed else (MUTED, 3.0)
    axes.plot(x, y, "o", color=shade, markersize=size)
