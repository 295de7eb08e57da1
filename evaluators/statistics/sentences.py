"""What a paired difference and a change on a suite say in words: the one builder for the gate, the
report and the terminal.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from alpasim_plugin.core.types import MetricInfo
from evaluators.report.numbers import (
    decimals,
    finite,
    fixed,
    interval,
    plural,
    scale_and_unit,
    short,
)
from evaluators.statistics.intervals import FEW_SCENES
from evaluators.statistics.verdicts import LEAST_SCENES

MANY_SCENES = 1000  # an estimate beyond this says no more than "many"
NAMED = 3  # scenes and cells in a sentence


def difference_text(entry: Mapping[str, Any], metric: MetricInfo) -> str:
    """Say a paired difference, its interval, and what would decide it.

    Args:
        entry: As `evaluators.statistics.paired.compare` gives it.
        metric: What was compared.
    """
    difference = finite(entry.get("diff"))
    if difference is None:
        return str(entry.get("reason") or "no difference")
    scale, unit = scale_and_unit(metric, metric.unit)
    bounds = interval(entry.get("ci95"), difference) or ()
    values = [value * scale for value in (difference, *bounds)]
    places = 1 if metric.in_percent else decimals(*values)
    numbers = [fixed(value, places, sign=True) for value in values]
    text = f"{numbers[0]}\u00a0{unit}".strip("\u00a0")
    n, p = int(entry.get("n_scenes") or 0), finite(entry.get("p_value"))
    if p is not None and 1 < n < FEW_SCENES:
        can = "" if n >= LEAST_SCENES else f", {plural(n, 'scene')} cannot decide"
        text = f"exact test p = {short(p)}{can}; {text}"
    if bounds:
        text += f", 95\u00a0% interval {numbers[1]} to {numbers[2]}"
    needed, margin = more_scenes_text(entry.get("more_scenes")), finite(entry.get("margin"))
    if needed and margin is not None:
        text += f"; {needed} on the margin of {short(margin * scale, unit)}"
    return text


def more_scenes_text(more: Any) -> str:
    """Say how many more scenes an undecided verdict needs; empty where that is unknown."""
    if not isinstance(more, int) or more <= 0:
        return ""
    if more > MANY_SCENES:
        return f"more than {MANY_SCENES} more scenes would decide"
    return f"at least {plural(more, 'more scene')} would decide"


def change_text(entry: Mapping[str, Any], metric: MetricInfo) -> str:
    """Say what changed on a suite, and where.

    Args:
        entry: The ``entry`` of a check of `evaluators.statistics.gate`.
        metric: What was compared.
    """
    counts, n = entry["counts"], plural(entry["n_cells"], "pair")
    scale, unit = scale_and_unit(metric, metric.unit)
    if metric.is_flag:
        allowed = f" ({entry['max_new']} new accepted)" if entry["max_new"] else ""
        text = f"{counts['new']} new, {counts['gone']} gone in {n}{allowed}"
        where = [f"{cell['scene']} seed {cell['seed']}" for cell in entry["worst"]]
        parts = [text, f"new in {_some(where)}" if where else ""]
    else:
        mean = _signed(entry["diff"] * scale, unit)
        text = f"{mean} on average (margin {short(entry['margin'] * scale, unit)})"
        sides = f"{counts['worse']} worse by more than the margin, {counts['better']} better"
        if metric.direction == "none":
            sides = f"{counts['worse']} changed by more than the margin"
        sides += f", {counts['equal']} equal of {n}"
        worst = [
            f"{scene['scene']} {_signed(scene['diff'] * scale, unit)}" for scene in entry["worst"]
        ]
        is_named = entry["verdict"] != "non-inferior" and worst
        parts = [text, sides, f"worst in {_some(worst)}" if is_named else ""]
    if entry["n_far"]:
        parts.append(f"{plural(entry['n_far'], 'scene')} beyond three margins")
    if entry["cut"]:
        parts.append(f"not compared where an event ended one side only: {_some(entry['cut'])}")
    if entry["n_neither"]:
        parts.append(f"no value on either side in {plural(entry['n_neither'], 'pair')}")
    if entry["missing"]:
        first = entry["missing"][0]
        where = f"{first['scene']} seed {first['seed']}"
        missing = plural(entry["n_missing"], "rollout has", "rollouts have")
        parts.append(f"{missing} no pair, such as {where}: {first['why']}")
    if entry["verdict"] == "undecided":
        seeds = entry["seeds"]
        parts.append(
            f"about {plural(seeds, 'seed')} a scene would decide"
            if seeds
            else "more seeds that show the same would not decide"
        )
    return "; ".join(part for part in parts if part)


def _signed(value: float, unit: str) -> str:
    return f"{fixed(value, decimals(value), sign=True)}\u00a0{unit}".strip("\u00a0")


def _some(names: list[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")
