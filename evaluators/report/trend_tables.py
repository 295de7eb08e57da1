"""Runs and the steps of a trend as text: the list of runs, the steps for a terminal, for JSON, and
for the tables of the page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from alpasim_plugin.core.escape import shorten
from alpasim_plugin.core.escape import terminal as escape
from evaluators.report.numbers import DASH, decimals, finite, fixed, interval, plural
from evaluators.report.runs import RunEntry, shown_folder
from evaluators.report.tables import PairRow, pair_rows
from evaluators.report.trend import Line, Series, Step, Trend

COLUMNS = ("begun (UTC)", "commit", "scenes x seeds", "preset", "rollouts", "renderer", "policy")
ONE_LINE, BY_LINE = (
    ("begun (UTC)", "commit"),
    ("renderer", "policy"),
)  # the latter beside the values of metrics
BESIDE_METRICS = ("begun (UTC)", "scenes x seeds", "preset")  # give way to values; --json has them
STYLES = {"finished": "", "running": "cyan", "unfinished": "yellow", "damaged": "red"}
PROBLEM_LETTERS = 90


def runs_table(
    entries: Sequence[RunEntry], roots: Sequence[Path], metrics: Sequence[str] = ()
) -> tuple[Table, str]:
    """Lay out one run a row, in the order given; with metrics its cells have a line for each
    renderer and policy.

    Returns:
        The table, and what is the same in all its rows and so left out of it, in one line; "" where
        nothing is.
    """
    between = "\n" if metrics else ", "
    texts: dict[str, list[Text]] = {name: [] for name in COLUMNS}
    for entry in entries:
        began, variants = entry.started_at, variants_of(entry)
        names = [[escape(one[k]) for one in variants] for k in (0, 1)]
        row = (
            Text(began.strftime("%Y-%m-%d %H:%M") if began is not None else DASH),
            Text(entry.commit_text or DASH),
            Text(scenes_text(entry)),
            Text(escape(str(entry.info.get("preset") or DASH))),
            _state(entry),
            *(
                Text(between.join(column if metrics else dict.fromkeys(column)) or DASH)
                for column in names
            ),
        )
        for name, text in zip(COLUMNS, row, strict=True):
            texts[name].append(text)
    same = {
        name: cells[0]
        for name, cells in texts.items()
        if len(entries) > 1 and len({cell.plain for cell in cells}) == 1
    }
    same = {
        name: cell for name, cell in same.items() if not (metrics and name == "renderer")
    }  # its lines name the values
    left_out = {*same, *(BESIDE_METRICS if metrics else ())}
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("run", overflow="fold", no_wrap=bool(metrics))
    for name in COLUMNS:
        if name not in left_out:
            keeps_lines = name in ONE_LINE or (bool(metrics) and name in BY_LINE)
            table.add_column(
                name, no_wrap=keeps_lines, overflow="ellipsis" if keeps_lines else "fold"
            )
    for metric in metrics:
        table.add_column(Text(escape(metric)), no_wrap=True, justify="right")
    for k, entry in enumerate(entries):
        values = (
            Text("\n".join(value_text(entry, metric, *one) for one in variants_of(entry)) or DASH)
            for metric in metrics
        )
        shown = (cells[k] for name, cells in texts.items() if name not in left_out)
        table.add_row(
            Text(escape(shown_folder(entry.folder, roots)), style="bold"), *shown, *values
        )
    shared = {
        name: ", ".join(dict.fromkeys(cell.plain.splitlines())) for name, cell in same.items()
    }
    return table, "; ".join(f"{name} {text}" for name, text in shared.items())


def variants_of(entry: RunEntry) -> list[tuple[str, str]]:
    """List renderer and policy of each line of a run."""
    return [
        (str(r), str(p))
        for p in entry.info.get("policies") or ()
        for r in entry.info.get("renderers") or ()
    ]


def scenes_text(entry: RunEntry) -> str:
    """Count a run's scenes and seeds, and name the first thing that the command named, else the
    first scene.
    """
    if not entry.info:
        return DASH
    asked = [str(name) for name in entry.info.get("asked") or ()]
    names = [
        Path(name).name.removesuffix(".yaml") if Path(name).is_absolute() else name
        for name in asked or entry.scenes
    ]
    more = f" + {len(names) - 1}" if len(names) > 1 else ""
    return f"{len(entry.scenes)} x {len(entry.info.get('seeds') or ())} {escape(''.join(names[:1]))}{more}"


def value_text(entry: RunEntry, metric: str, renderer: str, policy: str) -> str:
    """Print a metric's mean with its 95 % interval over scenes, both as `summary.json` has them; a
    dash where there is no mean.
    """
    found = entry.metric(metric, renderer, policy)
    mean, bounds = finite(found.get("mean")), interval(found.get("ci95_clustered"))
    if mean is None:
        return DASH
    percent = entry.table.shown(metric).in_percent
    scale, tail = (
        (100.0, " %") if percent else (1.0, f" {found['unit']}" if found.get("unit") else "")
    )
    places = 1 if percent else decimals(*(value * scale for value in (mean, *(bounds or ()))))
    spread = (
        ""
        if bounds is None
        else f" ({fixed(bounds[0] * scale, places)} to {fixed(bounds[1] * scale, places)})"
    )
    return f"{fixed(mean * scale, places)}{tail}{spread}"


def _state(entry: RunEntry) -> Text:
    planned = "" if entry.planned is None else str(entry.planned)
    if entry.state == "finished":
        failed = int(entry.outcome.get("n_failed") or 0)
        return Text(planned) + Text(f", {failed} failed" if failed else "", style="red")
    text = (
        f"{entry.state}, {planned} planned" if planned and entry.state != "damaged" else entry.state
    )
    return Text(text, style=STYLES[entry.state]) + Text(
        f"\n{escape(shorten(entry.problem, PROBLEM_LETTERS))}" if entry.problem else "", style="dim"
    )


MOST_CHANGES = 4
KEPT = (
    "diff",
    "ci95",
    "method",
    "p_value",
    "test",
    "margin",
    "verdict",
    "difference",
    "more_scenes",
    "n_cells",
    "n_scenes",
    "n_missing",
    "unit",
    "direction",
    "reason",
    "note",
)
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
    values = [
        value_text(run, line.metric, line.renderer, series.setting.policy) for run in line.runs
    ]
    rows = [StepRow(line.runs[0], values[0], None, "", False)]
    for step, value in zip(line.steps, values[1:], strict=True):
        rows.append(
            StepRow(step.after, value, pair_row(line, step), changed_text(step), step.moved)
        )
    return rows[::-1]


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
                    Text(escape(shown_folder(row.run.folder, roots)), style="bold"),
                    row.run.commit_text or DASH,
                    row.value,
                    difference,
                    Text("" if pair is None else pair.verdict, style=tone if row.moved else ""),
                    Text(escape(row.changed)),
                )
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
    shared = {
        "kind": setting.kind,
        "policy": setting.policy,
        "preset": setting.preset,
        "seeds": list(setting.seeds),
    }
    lines = []
    for line in series.lines:
        runs = []
        for run in line.runs:
            found = run.metric(line.metric, line.renderer, setting.policy)
            mean = {key: found.get(key) for key in ("mean", "ci95_clustered")}
            runs.append({"folder": str(run.folder), "commit": run.commit or None, **mean})
        steps = [_step_json(step) for step in line.steps]
        whole = _step_json(line.whole)
        lines.append(
            {
                "metric": line.metric,
                "renderer": line.renderer,
                "runs": runs,
                "steps": steps,
                "whole": whole,
            }
        )
    return {**shared, "scenes": dict(sorted(setting.scenes)), "lines": lines}


def _step_json(step: Step) -> dict[str, Any]:
    kept = {key: step.entry[key] for key in KEPT if key in step.entry}
    return {
        "before": str(step.before.folder),
        "after": str(step.after.folder),
        **kept,
        "changes": [one.as_dict() for one in step.changes],
    }
