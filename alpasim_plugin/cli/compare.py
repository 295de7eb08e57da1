"""``simrun compare``: paired differences within a run or between two runs. ``simrun aggregate``:
the numbers of several runs as of one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from alpasim_plugin.cli.options import Every, Json
from alpasim_plugin.cli.progress import warn
from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.runs.summary import aggregate_runs, joined_metrics
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.metrics import MetricTable
from evaluators.opening import read_run
from evaluators.report import render_table
from evaluators.report.numbers import plural
from evaluators.report.tables import PairRow, pair_rows
from evaluators.statistics.across import Comparison, compare_runs, compare_within
from evaluators.statistics.decision import stopping_note
from evaluators.statistics.gate import load_gate

COMPARE_EPILOG = """
Examples:

- `simrun compare runs/nightly --baseline clean`

- `simrun compare runs/policies --baseline lane-camera`: each other policy with this one, behind each renderer

- `simrun compare runs/both --baseline clean/lane-camera`: every other pair of renderer and policy with this one

- `simrun compare runs/main runs/change`: the second run minus the first, on shared cells

- `simrun compare runs/main runs/change --gate configs/gates/default.yaml --json`
"""
EVERY_MISSING = 10**9
SHOWN, NAMED = 10, 3  # lines about missing pairs; cells named in each


def compare(
    runs: Annotated[
        tuple[Path, ...],
        Positional("One run folder, or two: the second is compared with the first."),
    ],
    baseline: Annotated[
        str | None, Flag("RENDERER, POLICY or RENDERER/POLICY to compare with (of the first run).")
    ] = None,
    gate: Annotated[str | None, Flag("Take the margins from this gate file.")] = None,
    every: Every = False,
    as_json: Json = False,
) -> None:
    """Print paired differences on shared scene-seed cells, with verdicts; cells without a pair are
    listed.
    """
    if len(runs) > 2:
        raise InputError(f"{len(runs)} folders: more than two", "name one run, or two")
    for run in runs:
        ensure_tables(run, warn)
        if note := stopping_note(run):
            warn(note)
    found = [read_run(run) for run in runs]
    margins: dict[str, float] = {}
    if gate is not None:
        rules = load_gate(gate, found[-1].table)[0].metrics
        margins = {name: rule.margin for name, rule in rules.items() if rule.margin is not None}
    result = (
        compare_within(found[0], baseline, margins, EVERY_MISSING)
        if len(found) == 1
        else compare_runs(found[0], found[1], baseline, margins, EVERY_MISSING)
    )
    if as_json:
        print(
            json.dumps(
                {
                    "runs": [str(run) for run in runs],
                    "notes": list(result.notes),
                    "paired": result.paired,
                    "paired_with_base": result.with_base,
                    "paired_arms": result.arms,
                }
            )
        )
        return
    _print(result, [*result.metrics.headline, *margins] if not every else None)


def _print(result: Comparison, only: Sequence[str] | None) -> None:
    for note in result.notes:
        print(f"note: {note}")
    for variant, entries in (
        *result.paired.items(),
        *result.with_base.items(),
        *result.arms.items(),
    ):
        mine = [
            row
            for row in pair_rows({"paired": {variant: entries}}, result.metrics)
            if only is None or row.metric in only
        ]
        baseline = next((str(entry["baseline"]) for entry in entries.values()), "nothing")
        print(f"\n{variant} minus {baseline}")
        for line in [*_table(mine, entries, result.metrics), *_missing(entries)]:
            print(line)


def _table(
    rows: Sequence[PairRow], entries: Mapping[str, Mapping[str, Any]], known: MetricTable
) -> list[str]:
    """Return one line per metric; lines are not wrapped."""
    lines = [("metric", "difference", "95 %", "p", "margin", "pairs", "verdict")]
    for row in rows:
        entry = entries[row.metric]
        more = entry["more_scenes"]
        verdict = f"{entry['verdict']}, about {more} more scenes" if more else str(entry["verdict"])
        verdict += " (better)" if entry["difference"] == "better" else ""
        scale = 100.0 if known.shown(row.metric).in_percent else 1.0
        pairs = f"{entry['n_cells']} in {plural(int(entry['n_scenes']), 'scene')}"
        lines.append(
            (
                row.metric,
                row.diff.text,
                row.interval.text,
                row.p_value.text,
                f"{scale * entry['margin']:g}",
                pairs,
                verdict,
            )
        )
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    padded = (zip(line, widths, strict=True) for line in lines)
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in line).replace("\u00a0", " ").rstrip()
        for line in padded
    ]


def _missing(entries: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """List missing pairs: metrics without any, cells without any, and metrics that lack some
    cells.
    """
    paired = {metric: entry for metric, entry in entries.items() if entry["n_cells"]}
    lines = [
        f"  no pair: {metric}: {entry.get('reason')}"
        for metric, entry in entries.items()
        if metric not in paired
    ]
    lacking: dict[tuple[str, str], list[str]] = {}  # (cell, reason) -> metrics
    for metric, entry in paired.items():
        for cell in entry["missing"]:
            name = f"{cell['policy']}, {cell['scene']}, seed {cell['seed']}"
            lacking.setdefault((name, cell["why"]), []).append(metric)
    partly: dict[tuple[str, str], list[str]] = {}  # (metrics, reason) -> cells
    for (name, why), metrics in lacking.items():
        if len(metrics) == len(paired):
            lines.append(f"  no pair: {name}: every metric: {why}")
        else:
            partly.setdefault((", ".join(metrics), why), []).append(name)
    for (metrics_text, why), names in partly.items():
        where = "; ".join(names[:NAMED]) + (
            f"; {len(names) - NAMED} more" if len(names) > NAMED else ""
        )
        lines.append(f"  no pair: {metrics_text} in {plural(len(names), 'cell')} ({where}): {why}")
    return (
        lines
        if len(lines) <= SHOWN
        else [*lines[:SHOWN], f"  {len(lines) - SHOWN} more lines: --json lists all"]
    )


AGGREGATE_EPILOG = """
Examples:

- `simrun aggregate runs/night-*`

- `simrun aggregate runs/night-* --baseline clean --out night.json`

- `simrun aggregate runs/mine --all`
"""


def aggregate(
    runs: Annotated[tuple[Path, ...], Positional("Finished run folders.")],
    baseline: Annotated[
        str | None, Flag("Renderer to compare against; by default the first run's.")
    ] = None,
    out: Annotated[
        Path | None, Flag("Also write the numbers as JSON, in the form of summary.json.")
    ] = None,
    every: Every = False,
    as_json: Json = False,
) -> None:
    """Print means, intervals and verdicts over the rollouts of several runs; tables of millions of
    rows are streamed.
    """
    found = aggregate_runs(runs, baseline)
    if out is not None:
        write_json(out, found)
    if as_json:
        print(json.dumps(found))
        return
    known = joined_metrics(runs)
    Console().print(render_table(found, headline_only=not every, known=known))
    for row in pair_rows(found, known):
        if every or known.shown(row.metric).is_headline:
            numbers = f"{row.diff.text}, 95 % {row.interval.text}, p {row.p_value.text}".replace(
                "\u00a0", " "
            )
            print(f"{row.variant} minus {row.baseline}: {row.metric} {numbers}: {row.verdict}")
    failures = found["failures"]
    if failures["n_failed"]:
        causes = ", ".join(f"{name} {n}" for name, n in failures["by_class"].items())
        print(
            f"{failures['n_failed']} of {failures['n_rollouts']} rollouts failed ({causes}); they are in no average"
        )
    if out is not None:
        print(f"numbers  {out}")
