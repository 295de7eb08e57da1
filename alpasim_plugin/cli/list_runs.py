"""``simrun list runs``: run folders with their verdicts, filtered."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from alpasim_plugin.cli.output import letters_of, show, terminal_width, warn
from alpasim_plugin.core.errors import InputError
from evaluators.metrics import METRICS
from evaluators.pages.runs import RunEntry, find_runs, run_paragraph, runs_table
from evaluators.statistics.numbers import plural

VALUES = ("mean", "ci95_clustered", "n_rollouts")


def list_runs(
    roots: Sequence[Path],
    renderers: tuple[str, ...],
    policies: tuple[str, ...],
    metrics: Sequence[str],
    as_json: bool,
) -> None:
    """Print the run folders below some folders, the newest first.

    Args:
        roots: Folders that are searched.
        renderers, policies: Patterns that a run must match.
        metrics: Metrics of ``summary.json`` to print beside each run.
        as_json: Print one JSON document.

    Raises:
        InputError: A root is no folder, or no run has the metric.
    """
    entries = find_runs(roots)
    chosen = [
        entry
        for entry in entries
        if _each_is_named(renderers, () if entry.info is None else entry.info.renderers)
        and _each_is_named(policies, () if entry.info is None else entry.info.policies)
    ]
    unknown = [name for name in metrics if name not in METRICS.keys() | _stored_metrics(chosen)]
    if unknown:
        raise InputError(
            f"--metric {unknown[0]}: no such metric", "simrun list metrics names them."
        )
    rows = [entry.as_dict() | {"metrics": _values(entry, metrics)} for entry in chosen]
    lines: list[Any] = []
    if chosen:
        lines = _run_lines(chosen, roots[0], metrics)
    count = f"{plural(len(chosen), 'run')} of {len(entries)} below {', '.join(map(str, roots))}"
    show(as_json, {"runs": rows, "found": len(entries)}, *lines, count)
    if not as_json:
        _warn_of_unreadable(entries)


def _run_lines(entries: Sequence[RunEntry], root: Path, metrics: Sequence[str]) -> list[Any]:
    """Return a table of runs where the terminal is as wide as it, else some lines for each run."""
    table = runs_table(entries, root, metrics)
    if letters_of(table) <= terminal_width():
        return [table]
    return [line for entry in entries for line in run_paragraph(entry, root, metrics)]


def _stored_metrics(entries: Sequence[RunEntry]) -> set[str]:
    """Return the names of all metrics that the summaries of runs hold."""
    summaries = [entry.summary for entry in entries if entry.summary is not None]
    return {name for summary in summaries for table in summary.metrics.values() for name in table}


def _warn_of_unreadable(entries: Sequence[RunEntry]) -> None:
    for entry in entries:
        if entry.info is None:
            warn(f"left out, its run.json cannot be read: {entry.folder}: {entry.problem}")


def _each_is_named(patterns: Sequence[str], names: Sequence[str]) -> bool:
    return all(any(fnmatchcase(name, pattern) for name in names) for pattern in patterns)


def _values(entry: RunEntry, metrics: Sequence[str]) -> list[dict[str, Any]]:
    rows = []
    for renderer, policy in entry.variants:
        for name in metrics:
            mean = entry.metric(name, renderer, policy)
            row = {"renderer": renderer, "policy": policy, "metric": name}
            values = {key: None if mean is None else getattr(mean, key) for key in VALUES}
            rows.append(row | values)
    return rows
