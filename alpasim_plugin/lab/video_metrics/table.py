"""The quality table as markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from alpasim_plugin.lab.video_metrics.facts import FACTS, SET_TITLES

ARROWS = {"higher": "\u2191", "lower": "\u2193"}


def markdown(summary: Mapping[str, Any]) -> str:
    """Return the tables of a summary (`alpasim_plugin.lab.video_metrics.summary.summarise`): means,
    differences from the baseline, and distances between sets of clips.

    Cells are the mean and, in brackets, the standard deviation over scenes; of differences the mean
    and, in brackets, the 95 % interval of the median, bold where it excludes zero.
    """
    arms = summary["arms"]
    paired = summary["paired"]
    metrics = [metric for metric in FACTS if any(metric in values for values in arms.values())]
    titles = [f"{FACTS[metric].title} {ARROWS[FACTS[metric].direction]}" for metric in metrics]
    rows = []
    for name, values in arms.items():
        lengths = summary["frames"][name]
        frames = str(lengths[0]) if len(lengths) == 1 else f"{lengths[0]} to {lengths[-1]}"
        cells = [_cell(metric, values.get(metric)) for metric in metrics]
        rows.append([name, *cells, f"{_count(summary, name)} x {frames}"])
    tables = [_table(["variant", *titles, "clips x frames"], rows)]
    if paired:
        rows = [
            [name, *(_cell(metric, values.get(metric)) for metric in metrics)]
            for name, values in paired.items()
        ]
        tables.append(_table([f"minus {summary['baseline']}", *titles], rows))
    tables += _set_table(summary["sets"])
    return "\n".join(tables)


def _count(summary: Mapping[str, Any], name: str) -> str:
    """Return the number of clips, after that of scenes where some share one."""
    clips, scenes = summary["clips"][name], summary["scenes"][name]
    return f"{clips}" if clips == scenes else f"{scenes} scenes, {clips} clips"


def _set_table(sets: Mapping[str, Any]) -> list[str]:
    """Return the table of distances between sets, if there is one: values with the number of
    vectors and of their dimensions.
    """
    metrics = [name for name in SET_TITLES if any(name in values for values in sets.values())]
    if not metrics:
        return []
    rows = [
        [variant, *(_set_cell(values.get(name)) for name in metrics)]
        for variant, values in sets.items()
    ]
    titles = [f"{SET_TITLES[name]} {ARROWS['lower']}" for name in metrics]
    return [_table(["from the truth", *titles], rows)]


def _set_cell(entry: Mapping[str, Any] | None) -> str:
    if entry is None:
        return ""
    value = "none" if entry["value"] is None else f"{entry['value']:.1f}"
    return f"{value} ({entry['vectors']} vectors, {entry['dimensions']} dimensions)"


def _cell(metric: str, entry: Mapping[str, Any] | None) -> str:
    """Return a mean, or a difference with its sign."""
    if entry is None:
        return ""
    fact = FACTS[metric]
    is_difference = "diff" in entry
    sign = "+" if is_difference else ""

    def words(value: float, sign: str = sign) -> str:
        return f"{value * fact.scale:{sign}.{fact.digits}f}"

    text = words(entry["diff" if is_difference else "mean"])
    if not is_difference:
        return text if entry["spread"] is None else f"{text} ({words(entry['spread'])})"
    if entry["median_ci95"] is None:
        return text
    low, high = entry["median_ci95"]
    text += f" ({words(low)} to {words(high)})"
    return f"**{text}**" if low * high > 0 else text


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---", *(["---:"] * (len(head) - 1))], *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
