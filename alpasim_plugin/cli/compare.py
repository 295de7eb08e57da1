"""``simrun compare``: means and paired differences within a run, between two runs, or over shards."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from alpasim_plugin.cli.options import Every, Json, run_or_newest
from alpasim_plugin.cli.progress import warn
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

EPILOG = """
Examples:

- `simrun compare runs/nightly --baseline clean`

- `simrun compare runs/policies --baseline lane-camera`: each other policy with this one, behind each renderer

- `simrun compare runs/both --baseline clean/lane-camera`: every other pair of renderer and policy with this one

- `simrun compare runs/main runs/change`: the second run minus the first, on shared cells

- `simrun compare runs/night-1 runs/night-2 runs/night-3`: the shards of one run, as of one
"""
EVERY_MISSING = 10**9
SHOWN, NAMED = 10, 3  # lines about missing pairs; cells named in each


def compare(
    runs: Annotated[
        tuple[Path, ...],
        Positional(
            "One run, two of which the second is compared with the first, or the shards of one."
        ),
    ] = (),
    baseline: Annotated[
        str | None, Flag("RENDERER, POLICY or RENDERER/POLICY to compare with (of the first run).")
    ] = None,
    every: Every = False,
    as_json: Json = False,
) -> None:
    """Print means, paired differences with intervals, and verdicts.

    Of two runs with scenes in common, the second is compared with the first. Runs without, or more
    than two, are joined: the shards of one run.
    """
    folders = [run_or_newest(run) for run in runs] or [run_or_newest(None)]
    for run in folders:
        ensure_tables(run, warn)
        if note := stopping_note(run):
            warn(note)
    opened = [read_run(run) for run in folders]
    if len(folders) == 2 and {*opened[0].scenes} & {*opened[1].scenes}:
        result = compare_runs(opened[0], opened[1], baseline, {}, EVERY_MISSING)
        means = None
    elif len(folders) > 1:
        joined = aggregate_runs(folders, baseline)
        result = Comparison(
            joined["paired"],
            with_base=joined["paired_with_base"],
            metrics=joined_metrics(folders),
            policies=joined["paired_arms"],
        )
        means = joined
    else:
        result = compare_within(opened[0], baseline, {}, EVERY_MISSING)
        means = opened[0].summary
    if as_json:
        facts = {
            "runs": [str(run) for run in folders],
            "notes": list(result.notes),
            "paired": result.paired,
            "paired_with_base": result.with_base,
            "paired_arms": result.policies,
        }
        if means is not None:
            facts |= {name: means[name] for name in ("preset", "metrics", "failures")}
        print(json.dumps(facts))
        return
    if means is not None:
        Console().print(render_table(means, headline_only=not every, known=result.metrics))
        failures = means["failures"]
        if failures["n_failed"]:
            causes = ", ".join(f"{name} {n}" for name, n in failures["by_class"].items())
            print(
                f"{failures['n_failed']} of {failures['n_rollouts']} rollouts failed ({causes}) and are in no mean"
            )
    _print(result, None if every else result.metrics.headline)


def _print(result: Comparison, only: Sequence[str] | None) -> None:
    for note in result.notes:
        print(f"note: {note}")
    for variant, entries in (
        *result.paired.items(),
        *result.with_base.items(),
        *result.policies.items(),
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
