"""Where variants fail along a parameter: its sentence, and its section in the report."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

from alpasim_plugin.core.json_types import JsonView
from evaluators.pages.charts import MUTED, VARIANT, Chart, chart_of, new_axes
from evaluators.statistics.boundary_words import apart_text, difference_text
from evaluators.statistics.numbers import plural

if TYPE_CHECKING:  # slow to load
    from matplotlib.axes import Axes

POINTS = "Large dots: the rollout failed; small ones: it did not."
MOST_STRETCHES = 6  # that a sentence lists


def sentence_of(record: JsonView) -> str:
    """Say in one line where each variant fails and where not, how far apart the driven points stand,
    and at how many of them variants differ.

    Args:
        record: The member ``boundary`` of ``summary.json``.
    """
    is_area = isinstance(record["parameter"], list)
    texts = []
    for name, facts in record["variants"].items():
        if "reason" in facts:
            texts.append(f"{name}: {facts['reason']}")
        elif is_area:
            texts.append(f"{name} {_area_text(facts['areas'])}")
        else:
            texts.append(f"{name} {_line_text(facts, record['unit'])}")
    unit = " of the points" if is_area else f" {record['unit']}".rstrip()
    for name, facts in record["differences"].items():
        texts.append(f"{name} against {facts['baseline']} {difference_text(facts, unit)}")
    if record["unreachable"]:
        texts.append(f"{plural(len(record['unreachable']), 'point')} cannot be built")
    missed = "smaller region" if is_area else "narrower change"
    condition = ", where the scene can be built" if is_area and record["unreachable"] else ""
    texts.append(
        f"driven {apart_text(record)} apart or closer{condition}: a {missed} would be missed"
    )
    share = 100 * record["rollouts"] / record["grid_rollouts"]
    stopped = f", stopped: {record['stopped']}" if record["stopped"] else ""
    return (
        f"{', '.join(_ranges(record))}: {'; '.join(texts)}; "
        f"{record['rollouts']} rollouts, {share:.0f} % of the finest grid's{stopped}"
    )


def _ranges(record: JsonView) -> list[str]:
    """Write each parameter with its range, and the part of it in which the scene can be built."""
    members = [record[name] for name in ("parameter", "range", "reachable")]
    sides = zip(*members, strict=True) if isinstance(record["parameter"], list) else [members]
    texts = []
    for key, (low, high), (least, most) in sides:
        text = f"{key} from {low:g} to {high:g}"
        if (least, most) != (low, high):
            text += f" (the scene can be built from {least:g} to {most:g} only)"
        texts.append(text)
    return texts


def _line_text(facts: JsonView, unit: str) -> str:
    """Say at which driven values of a parameter a variant fails, and between which its seeds' median
    boundary lies.
    """
    stretches = facts["stretches"]
    seeds = stretches[0]["seeds"]
    if len(stretches) > MOST_STRETCHES:
        failing = sum(stretch["points"] for stretch in stretches if stretch["most"])
        points = sum(stretch["points"] for stretch in stretches)
        text = f"fails at {failing} of {points} points, and changes {len(stretches) - 1} times"
    else:
        text = ", ".join(_stretch_text(stretch, unit) for stretch in stretches)
    if facts["median"]:
        low, high = (f"{facts['median'][end]:.4g}" for end in ("low", "high"))
        text += f" (median boundary of seeds like these: {low} to {high} {unit}".rstrip()
        text += ", interval of 95 %)"
    elif 1 < seeds < facts["seeds_for_median"]:
        text += (
            f" ({facts['seeds_for_median']} seeds can give an interval of their median boundary)"
        )
    return text


def _stretch_text(stretch: JsonView, unit: str) -> str:
    """Say what happens at the points of a stretch."""
    low, high = (f"{stretch[end]:.4g}" for end in ("low", "high"))
    place = f"at {low}" if low == high else f"from {low} to {high}"
    place = f"{place} {unit}".rstrip()
    if not stretch["most"]:
        return f"no failure {place}"
    if stretch["least"] == stretch["seeds"]:
        return f"fails {place}"
    least, most = stretch["least"], stretch["most"]
    counts = f"{least}" if least == most else f"{least} to {most}"
    return f"fails {place} in {counts} of {stretch['seeds']} seeds"


def _area_text(areas: JsonView) -> str:
    """Say at how many points of the grid a variant fails, and in how many squares its outcome
    changes.
    """
    failed, points, changing, squares = (
        sum(area[name] for area in areas.values())
        for name in ("failed", "points", "changing", "squares")
    )
    return (
        f"fails at {failed} of {points} points of the grid, and its outcome changes within "
        f"{changing} of {squares} squares between them"
    )


def boundary_section(record: JsonView | None) -> dict[str, Any] | None:
    """Return the section of a run that searched for boundaries, None of any other."""
    if record is None:
        return None
    charts = [chart(record)] if isinstance(record["unit"], str) else area_charts(record)
    return {"title": record["sentence"], "charts": charts}


def chart(record: JsonView) -> Chart:
    """Draw every driven point, a row for each variant and seed, and between which neighbours the
    outcome changes.
    """
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
        for before, after in pairwise(facts.get("stretches", [])):
            ends = [row - 0.35, row + 0.35]
            axes.fill_betweenx(ends, before["high"], after["low"], color=colour, alpha=0.3)
    axes.set_ylim(-0.6, len(names) - 0.4)
    note = (
        f"{POINTS} Bands: between these points the outcome changes. Narrower changes than "
        f"{apart_text(record)} would be missed."
    )
    return chart_of(axes, "Where it fails", note)


def area_charts(record: JsonView) -> list[Chart]:
    """Draw every driven point of each variant."""
    charts = []
    labels = [_label(*axis) for axis in zip(record["parameter"], record["unit"], strict=True)]
    for row, (name, facts) in enumerate(record["variants"].items()):
        colour = VARIANT[row % len(VARIANT)]
        axes = new_axes(*labels)
        axes.use_sticky_edges = False  # points on an edge are not cut
        for outcomes in facts["outcomes"].values():
            for x, y, has_failed in outcomes:
                _draw_point(axes, x, y, has_failed, colour)
        note = f"{POINTS} What is smaller than {apart_text(record)} would be missed."
        charts.append(chart_of(axes, f"Where {name} fails", note))
    return charts


def _label(parameter: str, unit: str) -> str:
    return f"{parameter}, {unit}" if unit else parameter


def _draw_point(axes: Axes, x: float, y: float, has_failed: bool, colour: str) -> None:
    shade, size = (colour, 6.0) if has_failed else (MUTED, 3.0)
    axes.plot(x, y, "o", color=shade, markersize=size)
