"""The boundary at which variants start to fail: its sentence, and its section in the report."""

from __future__ import annotations

from typing import Any

from alpasim_plugin.core.json_types import JsonView
from evaluators.numbers import decimals, fixed
from evaluators.report.charts import MUTED, VARIANT, Chart, chart_of, new_axes


def sentence_of(record: JsonView) -> str:
    """Say in one line where each variant starts to fail, and how far the boundaries differ.

    Args:
        record: The member ``boundary`` of ``summary.json``.
    """
    texts = []
    for name, facts in record["variants"].items():
        if "value" in facts:
            text = f"{name} fails {facts['fails']} {number(facts, record['unit'])}"
            changes = facts.get("changes", 1)
            texts.append(
                text if changes == 1 else f"{text}, where its outcome changes {changes} times"
            )
        else:
            texts.append(f"{name} has no boundary: {facts['reason']}")
    for name, facts in record["differences"].items():
        difference = number(facts, record["unit"], sign=True)
        texts.append(f"{name} minus {facts['baseline']}: {difference}")
    low, high = (f"{value:g}" for value in record["range"])
    text = f"{record['parameter']} from {low} to {high}: {'; '.join(texts)}"
    least, most = (f"{value:g}" for value in record["reachable"])
    if (least, most) != (low, high):
        text += f"; the scene can be built from {least} to {most} only"
    share = 100 * record["rollouts"] / record["grid_rollouts"]
    stopped = f", stopped: {record['stopped']}" if record["stopped"] else ""
    return f"{text}; {record['rollouts']} rollouts, {share:.0f} % of a grid's{stopped}"


def number(facts: JsonView, unit: str, sign: bool = False) -> str:
    """Write an estimate with its interval, such as ``6.4 m (6.1 to 6.8)``."""
    values = [facts["value"], facts["low"], facts["high"]]
    places = decimals(*values)
    value, low, high = (fixed(one, places, sign=sign) for one in values)
    return f"{value} {unit} ({low} to {high})".replace("  ", " ")


def boundary_section(record: JsonView | None) -> dict[str, Any] | None:
    """Return the section of a run that searched for boundaries, None of any other."""
    return None if record is None else {"title": record["sentence"], "charts": [chart(record)]}


def chart(record: JsonView) -> Chart:
    """Draw every driven point, a row for each variant and seed, with boundaries and intervals."""
    names = list(record["variants"])
    unit = f", {record['unit']}" if record["unit"] else ""
    axes = new_axes(f"{record['parameter']}{unit}", "")
    axes.set_yticks(range(len(names)), names, parse_math=False)
    for row, facts in enumerate(record["variants"].values()):
        colour = VARIANT[row % len(VARIANT)]
        seeds = list(facts["outcomes"].values())
        for seed, outcomes in enumerate(seeds):
            y = row + 0.6 * (seed + 1) / (len(seeds) + 1) - 0.3
            for value, has_failed in outcomes:
                shade, size = (colour, 6.0) if has_failed else (MUTED, 3.0)
                axes.plot(value, y, "o", color=shade, markersize=size)
        if "value" in facts:
            ends = [row - 0.35, row + 0.35]
            axes.fill_betweenx(ends, facts["low"], facts["high"], color=colour, alpha=0.16)
            axes.plot([facts["value"]] * 2, ends, color=colour)
    axes.set_ylim(-0.6, len(names) - 0.4)
    note = (
        "Large dots: the rollout failed; small ones: it did not. "
        "Line and band: the boundary and its interval of 95 %."
    )
    return chart_of(axes, "Boundary", note)
