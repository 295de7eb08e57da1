"""The list of runs for a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich import box
from rich.table import Table
from rich.text import Text

from alpasim_plugin.core.escape import shorten
from alpasim_plugin.core.escape import terminal as escape
from evaluators.report.numbers import DASH, decimals, finite, fixed, interval
from evaluators.runs.choose import shown_folder
from evaluators.runs.entry import RunEntry

COLUMNS = ("begun (UTC)", "commit", "scenes x seeds", "preset", "rollouts", "renderer", "policy")
ONE_LINE, BY_LINE = ("begun (UTC)", "commit"), ("renderer", "policy")  # the latter beside the values of metrics
BESIDE_METRICS = ("begun (UTC)", "scenes x seeds", "preset")  # give way to values; --json has them
STYLES = {"finished": "", "running": "cyan", "unfinished": "yellow", "damaged": "red"}
PROBLEM_LETTERS = 90


def runs_table(entries: Sequence[RunEntry], roots: Sequence[Path], metrics: Sequence[str] = ()) -> tuple[Table, str]:
    """Lay out one run a row, in the order given; with metrics its cells have a line for each renderer and policy.

    Returns:
        The table, and what is the same in all its rows and so left out of it, in one line; "" where nothing is.
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
            *(Text(between.join(column if metrics else dict.fromkeys(column)) or DASH) for column in names),
        )
        for name, text in zip(COLUMNS, row, strict=True):
            texts[name].append(text)
    same = {name: cells[0] for name, cells in texts.items() if len(entries) > 1 and len({cell.plain for cell in cells}) == 1}
    same = {name: cell for name, cell in same.items() if not (metrics and name == "renderer")}  # its lines name the values
    left_out = {*same, *(BESIDE_METRICS if metrics else ())}
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("run", overflow="fold", no_wrap=bool(metrics))
    for name in COLUMNS:
        if name not in left_out:
            keeps_lines = name in ONE_LINE or (bool(metrics) and name in BY_LINE)
            table.add_column(name, no_wrap=keeps_lines, overflow="ellipsis" if keeps_lines else "fold")
    for metric in metrics:
        table.add_column(Text(escape(metric)), no_wrap=True, justify="right")
    for k, entry in enumerate(entries):
        values = (Text("\n".join(value_text(entry, metric, *one) for one in variants_of(entry)) or DASH) for metric in metrics)
        shown = (cells[k] for name, cells in texts.items() if name not in left_out)
        table.add_row(Text(escape(shown_folder(entry.folder, roots)), style="bold"), *shown, *values)
    return table, "; ".join(f"{name} {_on_one_line(cell)}" for name, cell in same.items())


def _on_one_line(cell: Text) -> str:
    return ", ".join(dict.fromkeys(cell.plain.splitlines()))


def variants_of(entry: RunEntry) -> list[tuple[str, str]]:
    """List renderer and policy of each line of a run."""
    return [(str(r), str(p)) for p in entry.info.get("policies") or () for r in entry.info.get("renderers") or ()]


def scenes_text(entry: RunEntry) -> str:
    """Count a run's scenes and seeds, and name the first thing that the command named, else the first scene."""
    if not entry.info:
        return DASH
    asked = [str(name) for name in entry.info.get("asked") or ()]
    names = [Path(name).name.removesuffix(".yaml") if Path(name).is_absolute() else name for name in asked or entry.scenes]
    more = f" + {len(names) - 1}" if len(names) > 1 else ""
    return f"{len(entry.scenes)} x {len(entry.info.get('seeds') or ())} {escape(''.join(names[:1]))}{more}"


def value_text(entry: RunEntry, metric: str, renderer: str, policy: str) -> str:
    """Print a metric's mean with its 95 % interval over scenes, both as `summary.json` has them; a dash where there is no mean."""
    found = entry.metric(metric, renderer, policy)
    mean, bounds = finite(found.get("mean")), interval(found.get("ci95_clustered"))
    if mean is None:
        return DASH
    percent = entry.table.shown(metric).in_percent
    scale, tail = (100.0, " %") if percent else (1.0, f" {found['unit']}" if found.get("unit") else "")
    places = 1 if percent else decimals(*(value * scale for value in (mean, *(bounds or ()))))
    spread = "" if bounds is None else f" ({fixed(bounds[0] * scale, places)} to {fixed(bounds[1] * scale, places)})"
    return f"{fixed(mean * scale, places)}{tail}{spread}"


def _state(entry: RunEntry) -> Text:
    planned = "" if entry.planned is None else str(entry.planned)
    if entry.state == "finished":
        failed = int(entry.outcome.get("n_failed") or 0)
        return Text(planned) + Text(f", {failed} failed" if failed else "", style="red")
    text = f"{entry.state}, {planned} planned" if planned and entry.state != "damaged" else entry.state
    return Text(text, style=STYLES[entry.state]) + Text(
        f"\n{escape(shorten(entry.problem, PROBLEM_LETTERS))}" if entry.problem else "", style="dim"
    )
