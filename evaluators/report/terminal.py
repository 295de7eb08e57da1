"""The result table for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from alpasim_plugin.core.escape import terminal as escape
from evaluators.report.numbers import Cell, plural
from evaluators.report.tables import metric_rows

MARGIN_NOTE = "\u00b1: 1.96 sigma / sqrt(N) over rollouts; a to b: 95 %, scenes as clusters"
GAP_NOTE = "; \u2014: one rollout or one scene is too few, or no valid value (report.html says which)"


def render_table(summary: Mapping[str, Any], headline_only: bool = False) -> Table:
    """Lay out metrics x renderers with mean and both 95 % intervals.

    Args:
        summary: Content of ``summary.json``.
        headline_only: Leave out all but the headline metrics, where any of them is there.

    Returns:
        A rich table; print it with ``rich.print`` or a Console (80 columns fit two renderers).
    """
    rows = metric_rows(summary)
    if headline_only and any(row.is_headline for row in rows):
        rows = [row for row in rows if row.is_headline]
    gaps = any("\u2014" in cell.text + cell.detail for row in rows for cell in row.cells)
    note = MARGIN_NOTE + (GAP_NOTE if gaps else "") if rows else None
    table = Table(box=box.SIMPLE_HEAD, caption=note, caption_justify="left", pad_edge=False)
    table.add_column(Text(escape(f"preset {summary.get('preset', '?')}"), style="dim"), overflow="fold")
    for variant, entries in (summary.get("metrics") or {}).items():
        counts = [(int(e.get("n_rollouts") or 0), int(e.get("n_scenes") or 0)) for e in entries.values()]
        n_rollouts, n_scenes = max(counts, default=(0, 0))
        head = Text(escape(variant), style="bold") + Text(f"\n{plural(n_rollouts, 'rollout')}\n{plural(n_scenes, 'scene')}", style="dim")
        table.add_column(head, justify="right", overflow="fold")
    for row in rows:
        label = Text(escape(row.name), style="bold" if row.is_headline else "")
        facts = " ".join(part for part in (row.unit, row.arrow) if part)
        label.append(f" {facts}" if facts else "", style="not bold dim")
        table.add_row(label, *(_cell(cell) for cell in row.cells))
    return table


def _cell(cell: Cell) -> Text:
    if cell.missing:
        return Text(cell.text, style="dim")
    half, _, bounds = cell.detail.partition(" \u00b7 ")
    lines = [half.replace("\u00a0", ""), bounds, cell.count]
    text = Text(cell.text, style="bold").append(f" {lines[0]}", style="not bold dim")
    return text.append("".join(f"\n{line}" for line in lines[1:] if line), style="not bold dim")
