"""``simrun compare``: means and paired differences within a run, between two runs, or over shards."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Any

from alpasim_plugin.cli.options import Json, run_or_newest
from alpasim_plugin.cli.output import first_screen, show, terminal_width, warn
from alpasim_plugin.core.files import some_of
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import cell_name
from alpasim_plugin.runs.summary import aggregate_runs, joined_metrics
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.metrics import MetricTable
from evaluators.pages.tables import PairRow, pair_rows
from evaluators.pages.terminal import metric_lines
from evaluators.statistics.across import Comparison, compare_runs, compare_within
from evaluators.statistics.decision import stopping_note
from evaluators.statistics.numbers import plural
from evaluators.statistics.opening import Run, read_run
from evaluators.statistics.outcomes import LISTED, outcome_table
from evaluators.statistics.summary import CUT_RULES

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


def compare(
    runs: Annotated[
        tuple[Path, ...],
        Positional("One run, its shards, or two: the second is compared with the first."),
    ] = (),
    baseline: Annotated[
        str | None, Flag("RENDERER, POLICY or RENDERER/POLICY to compare with.")
    ] = None,
    every: Annotated[
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
        result = compare_runs(opened[0], opened[1], baseline, EVERY_MISSING)
        means = None
    elif len(folders) > 1:
        joined = aggregate_runs(folders, baseline)
        result = Comparison(
            joined["paired"],
            with_base=joined["paired_with_base"],
            metrics=joined_metrics(folders),
            policies=joined["paired_policies"],
        )
        means = joined
        whole = [rollout for run in opened for rollout in run.rollouts]
        asked = list(dict.fromkeys(name for run in opened for name in run.info.get("asked") or ()))
        info = {**opened[0].info, "asked": asked}
        info["scenes"] = {
            name: facts for run in opened for name, facts in run.info["scenes"].items()
        }
        summary = joined | _endings(opened, whole, joined["metrics"])
        shown = replace(opened[0], summary=summary, rollouts=whole, info=info)
    else:
        result = compare_within(opened[0], baseline, EVERY_MISSING)
        means = dict(opened[0].summary)
        shown = opened[0]
    facts: dict[str, Any] = {
        "runs": [str(run) for run in folders],
        "notes": list(result.notes),
        "paired": result.paired,
        "paired_with_base": result.with_base,
        "paired_policies": result.policies,
    }
    lines = []
    if means is not None:
        facts |= {name: means[name] for name in ("preset", "metrics", "failures")}
        lines += first_screen(shown)
        if every:
            lines += metric_lines(means, known=result.metrics)
        failures = means["failures"]
        if failures["n_failed"]:
            causes = ", ".join(f"{name} {count}" for name, count in failures["by_class"].items())
            number = f"{failures['n_failed']} of {failures['n_rollouts']}"
            lines.append(f"{number} rollouts failed ({causes}) and are in no mean")
    said = [f"note: {note}" for note in result.notes]
    for tables in (result.paired, result.with_base, result.policies):
        for variant, entries in tables.items():
            baseline = next((entry["baseline"] for entry in entries.values()), "nothing")
            said += ["", f"{variant} minus {baseline}"]
            rows = [
                row
                for row in pair_rows({"paired": {variant: entries}}, result.metrics)
                if entries[row.metric]["n_cells"]
                and (every or row.metric in result.metrics.headline)
            ]
            said += _table(rows, entries, result.metrics) if rows else ["  no pair of rollouts"]
            missing = _missing(entries, len(entries) if every else SHOWN)
            said += missing if every else missing[:SHOWN]
            if len(missing) > SHOWN and not every:
                said.append(f"  {len(missing) - SHOWN} more lines: --all")
    width = terminal_width()
    for line in said:
        lines += wrap(line, width, subsequent_indent=INDENT, break_on_hyphens=False) or [""]
    show(as_json, facts, *lines)


def _endings(
    runs: Sequence[Run], rollouts: Sequence[Rollout], keys: Collection[str]
) -> dict[str, Any]:
    """Return how the rollouts of some runs ended, with the times of their events, and how many of
    their steps were cut; ``keys`` are those of the joined summary.
    """
    tables = [run.summary.get("outcomes") or outcome_table(run.rollouts) for run in runs]
    outcomes = outcome_table(rollouts)
    for variant, entry in outcomes.items():
        for name, facts in entry["outcomes"].items():
            parts = [table[variant]["outcomes"] for table in tables if variant in table]
            cells = [cell for part in parts if name in part for cell in part[name]["cells"]]
            facts["cells"] = cells[:LISTED]
    cut: dict[str, Counter[str]] = {}
    for run in runs:
        for renderer, entry in (run.summary.get("censoring") or {}).items():
            key = renderer if renderer in keys else cell_name(renderer, run.policies[0])
            cut.setdefault(key, Counter()).update(
                {rule: entry.get(rule) or 0 for rule in CUT_RULES}
            )
    return {"outcomes": outcomes, "censoring": cut}


def _table(
    rows: Sequence[PairRow], entries: Mapping[str, JsonView], known: MetricTable
) -> list[str]:
    """Return one line per metric."""
    lines = [("metric", "difference", "p", "these scenes", "95 %", "margin", "pairs", "others")]
    for row in rows:
        entry = entries[row.metric]
        verdict = str(entry["verdict"])
        if entry["more_scenes"]:
            verdict += f", at least {entry['more_scenes']} more scenes"
        scale = 100.0 if known.shown(row.metric).in_percent else 1.0
        margin = f"{scale * entry['margin']:g}"
        pairs = f"{entry['n_cells']} in {plural(int(entry['n_scenes']), 'scene')}"
        numbers = (row.diff.text, row.p_value.text, entry["difference"], row.interval.text)
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


def _missing(entries: Mapping[str, JsonView], most: int) -> list[str]:
    """List missing pairs: metrics without any, rollouts without any, and metrics that lack some rollouts;
    ``most`` names a line.
    """
    paired = {metric: entry for metric, entry in entries.items() if entry["n_cells"]}
    unpaired: dict[str, list[str]] = {}  # reason -> metrics
    for metric in sorted(entries.keys() - paired.keys()):
        unpaired.setdefault(str(entries[metric].get("reason")), []).append(metric)
    lines = [f"  no pair: {some_of(metrics, most)}: {why}" for why, metrics in unpaired.items()]
    lacking: dict[tuple[str, str], list[str]] = {}  # (cell, reason) -> metrics
    for metric, entry in paired.items():
        for cell in entry["missing"]:
            name = f"{cell['policy']}, {cell['scene']}, seed {cell['seed']}"
            lacking.setdefault((name, cell["why"]), []).append(metric)
    for (name, reason), metrics in lacking.items():
        which = "every metric" if len(metrics) == len(paired) else ", ".join(metrics)
        lines.append(f"  no pair: {name}: {which}: {reason}")
    return lines
