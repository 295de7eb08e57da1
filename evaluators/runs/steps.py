"""The steps of a trend as text: for the terminal, for JSON, and for the tables of the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from alpasim_plugin.core.escape import terminal as escape
from evaluators.report.numbers import DASH, plural
from evaluators.report.tables import PairRow, pair_rows
from evaluators.runs.choose import shown_folder
from evaluators.runs.entry import RunEntry
from evaluators.runs.table import value_text
from evaluators.runs.trend import Line, Series, Step, Trend

MOST_CHANGES = 4
KEPT = (
    "diff", "ci95", "method", "p_value", "test", "margin", "verdict", "difference", "more_scenes", "n_cells", "n_scenes", "n_missing",
    "unit", "direction", "reason", "note",
)  # fmt: skip
NOTHING = "nothing that run.json keeps"


@dataclass(frozen=True)
class StepRow:
    """One run of a line.

    Attributes:
        run: The run.
        value: Its mean with its 95 % interval.
        pair: The difference from the run before; None for the first.
        changed: What differs from the run before, in words.
        moved: Whether a difference is shown.
    """

    run: RunEntry
    value: str
    pair: PairRow | None
    changed: str
    moved: bool


def step_rows(series: Series, line: Line) -> list[StepRow]:
    """Return the runs of a line, the newest first."""
    first = StepRow(line.runs[0], _value(series, line, line.runs[0]), None, "", False)
    later = [StepRow(s.after, _value(series, line, s.after), pair_row(line, s), changed_text(s), s.moved) for s in line.steps]
    return [*reversed(later), first]


def pair_row(line: Line, step: Step) -> PairRow:
    """Return a step's numbers as the report prints them."""
    (row,) = pair_rows({"paired": {line.renderer: {line.metric: step.entry}}}, step.after.table)
    return row


def changed_text(step: Step, most: int = MOST_CHANGES) -> str:
    """Name what differs between two runs."""
    if not step.changes:
        return NOTHING
    named = "; ".join(str(change) for change in step.changes[:most])
    more = len(step.changes) - most
    return f"{named}; {more} more" if more > 0 else named


def whole_text(line: Line) -> str:
    """Say in a sentence what happened from the first run to the last."""
    row, name = pair_row(line, line.whole), line.whole.before.folder.name
    if row.diff.missing:
        return f"{line.renderer}: no comparison with the first run, {name}: {row.diff.note}"
    return f"{line.renderer}: {row.diff.text} ({row.interval.text}) since the first run, {name}: {row.verdict}"


def setting_text(series: Series) -> str:
    """Name what the runs of a series share."""
    one = series.setting
    what = f"{one.policy}, preset {one.preset}, {plural(len(one.scenes), 'scene')} x {plural(len(one.seeds), 'seed')}"
    return what if one.kind == "run" else f"{what}, scored logs"


def steps_tables(found: Trend, roots: Sequence[Path]) -> list[tuple[str, Table]]:
    """Lay out every line for a terminal: its title, and a table with the newest run first."""
    out = []
    for series in found.series:
        for line in series.lines:
            table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
            for name, right in (
                ("run", False),
                ("commit", False),
                ("mean (95 %)", True),
                ("from the run before", True),
                ("verdict", False),
            ):
                table.add_column(name, justify="right" if right else "left", overflow="fold")
            table.add_column("changed", overflow="fold", ratio=1)
            for row in step_rows(series, line):
                pair = row.pair
                difference = DASH if pair is None else f"{pair.diff.text}\n{pair.interval.text}"
                tone = {"worse": "red", "better": "green"}.get(pair.tone if pair else "", "")
                table.add_row(
                    Text(escape(shown_folder(row.run.folder, roots)), style="bold"), row.run.commit_text or DASH, row.value,
                    difference, Text("" if pair is None else pair.verdict, style=tone if row.moved else ""), Text(escape(row.changed)),
                )  # fmt: skip
            out.append((f"{line.metric} behind {line.renderer}: {setting_text(series)}", table))
    return out


def as_json(found: Trend) -> dict[str, Any]:
    """Return a trend as plain data."""
    return {
        "by_commit": found.by_commit,
        "series": [_series_json(one) for one in found.series],
        "left_out": [{"folder": str(entry.folder), "why": why} for entry, why in found.left_out],
    }


def _series_json(series: Series) -> dict[str, Any]:
    setting = series.setting
    shared = {"kind": setting.kind, "policy": setting.policy, "preset": setting.preset, "seeds": list(setting.seeds)}
    lines = [
        {
            "metric": line.metric,
            "renderer": line.renderer,
            "runs": [{"folder": str(run.folder), "commit": run.commit or None, **_mean(series, line, run)} for run in line.runs],
            "steps": [_step_json(step) for step in line.steps],
            "whole": _step_json(line.whole),
        }
        for line in series.lines
    ]
    return {**shared, "scenes": dict(sorted(setting.scenes)), "lines": lines}


def _mean(series: Series, line: Line, run: RunEntry) -> dict[str, Any]:
    found = run.metric(line.metric, line.renderer, series.setting.policy)
    return {key: found.get(key) for key in ("mean", "ci95_clustered")}


def _step_json(step: Step) -> dict[str, Any]:
    kept = {key: step.entry[key] for key in KEPT if key in step.entry}
    return {"before": str(step.before.folder), "after": str(step.after.folder), **kept, "changes": [one.as_dict() for one in step.changes]}


def _value(series: Series, line: Line, run: RunEntry) -> str:
    return value_text(run, line.metric, line.renderer, series.setting.policy)
