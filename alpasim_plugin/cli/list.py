"""``simrun list``: names for the command line, and the runs below a folder."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from alpasim_plugin.cli.options import Json
from alpasim_plugin.cli.output import show, warn
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.parts import names, unidentified
from alpasim_plugin.core.parts.resolve import declaration_of, note_of
from alpasim_plugin.core.parts.source import load
from evaluators.metrics import METRICS, table_of
from evaluators.metrics.presets import described
from evaluators.metrics.score import resolve_plugins
from evaluators.report.numbers import plural
from evaluators.report.runs import Choice, RunEntry, as_day, find_runs, runs_table, variants_of
from scenarios.suite import shipped

EPILOG = """
Examples:

- `simrun list scenarios`

- `simrun list runs`: every run folder below runs/, the newest first

- `simrun list runs nightly --renderer onefixer --since 7d --metric offroad`
"""
VALUES = ("mean", "ci95_clustered", "n_rollouts")

Kind = Literal["renderers", "fixers", "policies", "scenarios", "metrics", "presets", "runs"]


def list_names(
    kind: Annotated[
        Kind | None, Positional("What to list; without it the kinds are listed.")
    ] = None,
    roots: Annotated[
        tuple[Path, ...],
        Positional("Of runs: folders that are searched; by default runs.", metavar="[FOLDER]..."),
    ] = (),
    renderer: Annotated[
        tuple[str, ...], Flag("Runs with this renderer; * and ? match. Repeatable.")
    ] = (),
    policy: Annotated[
        tuple[str, ...], Flag("Runs with this policy; * and ? match. Repeatable.")
    ] = (),
    since: Annotated[
        str | None, Flag("Runs begun at or after: 2026-03-01, 2026-03-01T18:00 (UTC), 7d, 12h.")
    ] = None,
    last: Annotated[int | None, Flag("The newest N runs.", min=1)] = None,
    metric: Annotated[tuple[str, ...], Flag("Show this metric of each run. Repeatable.")] = (),
    as_json: Json = False,
) -> None:
    """List renderers, fixers, policies, scenarios, metrics, presets or runs, one a line."""
    if kind == "runs":
        started = None if since is None else as_day(since, "--since", datetime.now(UTC))
        _list_runs(
            roots or (Path("runs"),),
            Choice(renderer, policy, started),
            last,
            metric,
            as_json,
        )
        return
    if roots or renderer or policy or since or last or metric:
        raise InputError(f"simrun list {kind}: filters are for runs", "Leave them out.")
    if kind is None:
        known = {name: f"simrun list {name}" for name in get_args(Kind)}
    elif kind == "renderers":
        known = names("renderer")
        for name, text in names("fixer").items():
            known[name] = f"3dgs, repaired by the fixer {name}: {text}"
    elif kind == "fixers":
        known = _fixers()
    elif kind == "policies":
        known = names("policy")
    elif kind == "scenarios":
        known = shipped()
    elif kind == "metrics":
        known = {name: facts.help for name, facts in table_of(resolve_plugins()).items()}
    else:
        known = described()
    width = max((len(name) for name in known), default=0)
    show(as_json, known, *(f"{name:<{width}}  {text}" for name, text in known.items()))


def _list_runs(
    roots: Sequence[Path], choice: Choice, last: int | None, metrics: Sequence[str], as_json: bool
) -> None:
    entries = find_runs(roots, with_summary=True)
    chosen = [entry for entry in entries if choice.takes(entry)][:last]
    stored = {
        name
        for entry in chosen
        if entry.state != "damaged"
        for table in (entry.summary.get("metrics") or {}).values()
        for name in table
    }
    for name in metrics:
        if name not in METRICS and name not in stored:
            raise InputError(f"--metric {name}: no such metric", "simrun list metrics names them.")
    rows = [entry.as_dict() | {"metrics": _values(entry, metrics)} for entry in chosen]
    lines: list[Any] = [runs_table(chosen, roots, metrics)] if chosen else []
    count = f"{plural(len(chosen), 'run')} of {len(entries)} below {', '.join(map(str, roots))}"
    show(as_json, {"runs": rows, "found": len(entries)}, *lines, count)
    for entry in entries:
        if not as_json and not entry.info:
            warn(f"left out, its run.json cannot be read: {entry.folder}: {entry.problem}")


def _values(entry: RunEntry, metrics: Sequence[str]) -> list[dict[str, Any]]:
    rows = []
    for renderer, policy in variants_of(entry):
        for name in metrics:
            values = entry.metric(name, renderer, policy)
            row = {"renderer": renderer, "policy": policy, "metric": name}
            rows.append(row | {key: values.get(key) for key in VALUES})
    return rows


def _fixers() -> dict[str, str]:
    """Return every fixer with its help and whose weights it has."""
    listed = {}
    for name, help_text in names("fixer").items():
        spec = unidentified("fixer", name)
        factory = load(spec.target, "fixer")
        help_text = getattr(factory, "help", {}).get(name, help_text)
        listed[name] = f"{help_text} [{note_of(spec, declaration_of(factory, spec.settings))}]"
    return listed
