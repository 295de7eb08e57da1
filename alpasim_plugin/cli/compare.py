"""``simrun compare``: means and paired differences within a run, between two runs, or over shards."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Any

from alpasim_plugin.cli.options import Json, run_or_newest
from alpasim_plugin.cli.output import first_screen, show, terminal_width, warn
from alpasim_plugin.core.files import some_of
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.runs.joined import join_runs
from alpasim_plugin.runs.summary import joined_metrics
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.metrics import MetricTable
from evaluators.pages.tables import PairRow, pair_rows
from evaluators.pages.terminal import metric_lines
from evaluators.results import Difference, Mean, to_json
from evaluators.statistics.across import Comparison, compare_runs, compare_within
from evaluators.statistics.decision import stopping_note
from evaluators.statistics.numbers import plural
from evaluators.statistics.opening import Run, read_run
from evaluators.statistics.paired import BLOCKS
from evaluators.statistics.sentences import claim_text, is_beyond_margin

EPILOG = """
Examples:

- `simrun compare runs/nightly --baseline clean`

- `simrun compare runs/policies --baseline lane-camera`: each other policy with this one, behind each renderer

- `simrun compare runs/both --baseline clean/lane-camera`: every other pair of renderer and policy with this one

- `simrun compare runs/main runs/change`: the second run minus the first, on shared rollouts

- `simrun compare runs/night-1 runs/night-2 runs/night-3`: the shards of one run, as of one
"""
EVERY_MISSING = 10**9
INDENT = " " * 6  # of what does not fit on a line
SHOWN = 10  # lines about missing pairs
NONE_SHOWN = "none shown"


def compare(
    runs: Annotated[
        tuple[Path, ...],
        Positional("One run, its shards, or two: the second is compared with the first."),
    ] = (),
    baseline: Annotated[
        str | None, Flag("RENDERER, POLICY or RENDERER/POLICY to compare with.")
    ] = None,
    all_metrics: Annotated[
        bool, Flag("Print every metric, not only the headline ones.", "--all")
    ] = False,
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
        comparison = compare_runs(opened[0], opened[1], baseline, EVERY_MISSING)
        whole = None
    elif len(folders) > 1:
        comparison, whole = _joined(opened, baseline)
    else:
        comparison = compare_within(opened[0], baseline, EVERY_MISSING)
        whole = opened[0]
    facts: dict[str, Any] = {
        "runs": [str(run) for run in folders],
        "notes": list(comparison.notes),
        **{block: _tables_as_json(getattr(comparison, block)) for block in BLOCKS},
    }
    lines = []
    if whole is not None:
        means = whole.summary
        facts |= {
            "preset": means.preset,
            "metrics": _tables_as_json(means.metrics),
            "failures": to_json(means.failures),
        }
        lines = _mean_lines(whole, comparison.metrics, all_metrics)
    width = terminal_width()
    for line in _difference_lines(comparison, all_metrics):
        lines += wrap(line, width, subsequent_indent=INDENT, break_on_hyphens=False) or [""]
    show(as_json, facts, *lines)


def _joined(shards: Sequence[Run], baseline: str | None) -> tuple[Comparison, Run]:
    """Return the comparison over the shards of one run, and the run that they make together."""
    whole = join_runs(shards, baseline)
    summary = whole.summary
    comparison = Comparison(
        summary.paired,
        summary.paired_with_base,
        summary.paired_policies,
        metrics=joined_metrics([shard.folder for shard in shards]),
    )
    return comparison, whole


def _mean_lines(run: Run, metric_table: MetricTable, all_metrics: bool) -> list[str]:
    """Return what a run's first screen shows, its means where all metrics are asked for, and how
    many rollouts are in none.
    """
    lines = list(first_screen(run))
    if all_metrics:
        lines += metric_lines(run.summary, table=metric_table)
    failures = run.summary.failures
    if failures.n_failed:
        causes = ", ".join(f"{name} {count}" for name, count in failures.by_class.items())
        number = f"{failures.n_failed} of {failures.n_rollouts}"
        lines.append(f"{number} rollouts failed ({causes}) and are in no mean")
    return lines


def _difference_lines(comparison: Comparison, all_metrics: bool) -> list[str]:
    """Return the notes of a comparison, and for each variant a table of its paired differences."""
    lines = [f"note: {note}" for note in comparison.notes]
    for block in BLOCKS:
        for variant, differences in getattr(comparison, block).items():
            lines += _variant_lines(variant, differences, comparison.metrics, all_metrics)
    return lines


def _variant_lines(
    variant: str,
    differences: Mapping[str, Difference],
    metric_table: MetricTable,
    all_metrics: bool,
) -> list[str]:
    """Return the table of one variant's differences and the pairs that are missing."""
    baseline = next((difference.baseline for difference in differences.values()), "nothing")
    rows = [
        row
        for row in pair_rows([(variant, differences)], metric_table)
        if differences[row.metric].n_cells and (all_metrics or row.metric in metric_table.headline)
    ]
    table = _table(rows, differences, metric_table) if rows else ["  no pair of rollouts"]
    table += _notes([row.metric for row in rows], differences, metric_table)
    missing = _missing(differences, len(differences) if all_metrics else SHOWN)
    if len(missing) > SHOWN and not all_metrics:
        missing = [*missing[:SHOWN], f"  {len(missing) - SHOWN} more lines: --all"]
    return ["", f"{variant} minus {baseline}", *table, *missing]


def _tables_as_json(tables: Mapping[str, Mapping[str, Mean | Difference]]) -> JsonObject:
    return {
        variant: {metric: to_json(entry) for metric, entry in entries.items()}
        for variant, entries in tables.items()
    }


def _table(
    rows: Sequence[PairRow], entries: Mapping[str, Difference], metric_table: MetricTable
) -> list[str]:
    """Return one line per metric."""
    lines = [("metric", "difference", "p", "these scenes", "95 %", "margin", "pairs", "others")]
    for row in rows:
        entry = entries[row.metric]
        verdict: str = entry.verdict
        if entry.more_scenes:
            answer = "worse" if is_beyond_margin(entry) else "non-inferior"
            verdict += f", at least {entry.more_scenes} more scenes for {answer}"
        scale = 100.0 if metric_table.shown(row.metric).in_percent else 1.0
        margin = f"{scale * entry.margin:g}"
        pairs = f"{entry.n_cells} in {plural(entry.n_scenes, 'scene')}"
        contrast = entry.difference or NONE_SHOWN
        numbers = (row.diff.text, row.p_value.text, contrast, row.interval.text)
        lines.append((row.metric, *numbers, margin, pairs, verdict))
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    if 2 * len(widths) + sum(widths) > terminal_width():
        labels = lines[0][2:]
        return [
            line
            for name, difference, *others in lines[1:]
            for line in (
                f"  {name}  {difference}",
                "      "
                + ", ".join(f"{label}: {text}" for label, text in zip(labels, others, strict=True)),
            )
        ]
    texts = []
    for line in lines:
        whole = [cell.replace(" ", "\u00a0") for cell in line]
        cells = [cell.ljust(width) for cell, width in zip(whole, widths, strict=True)]
        texts.append("  " + "  ".join(cells).rstrip())
    return texts


def _notes(
    names: Sequence[str], entries: Mapping[str, Difference], metric_table: MetricTable
) -> list[str]:
    """Say once what the verdicts on some metrics are about, and which have no interval, and why."""
    by_text: dict[str, list[str]] = {}
    for name in names:
        entry = entries[name]
        text = claim_text(entry, metric_table.info(name))
        if entry.ci95 is None and entry.reason is not None:
            text = f"no interval: {entry.reason}"
        if text:
            by_text.setdefault(text, []).append(name)
    return [f"  {', '.join(metrics)}: {text}" for text, metrics in by_text.items()]


def _missing(entries: Mapping[str, Difference], most: int) -> list[str]:
    """List missing pairs: metrics without any, rollouts without any, and metrics that lack some rollouts;
    ``most`` names a line.
    """
    paired = {metric: entry for metric, entry in entries.items() if entry.n_cells}
    unpaired: dict[str, list[str]] = {}  # reason -> metrics
    for metric in sorted(entries.keys() - paired.keys()):
        unpaired.setdefault(str(entries[metric].reason), []).append(metric)
    lines = [f"  no pair: {some_of(metrics, most)}: {why}" for why, metrics in unpaired.items()]
    lacking: dict[tuple[str, str], list[str]] = {}  # (cell, reason) -> metrics
    for metric, entry in paired.items():
        for cell in entry.missing:
            name = f"{cell.policy}, {cell.scene}, seed {cell.seed}"
            lacking.setdefault((name, cell.why), []).append(metric)
    for (name, reason), metrics in lacking.items():
        which = "every metric" if len(metrics) == len(paired) else ", ".join(metrics)
        lines.append(f"  no pair: {name}: {which}: {reason}")
    return lines
