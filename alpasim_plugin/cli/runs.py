"""``simrun runs``: list, choose and compare run folders."""

from __future__ import annotations

import difflib
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from alpasim_plugin.cli.options import Json, Overwrite, refuse_existing
from alpasim_plugin.cli.progress import warn
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from evaluators.metrics import METRICS
from evaluators.report.numbers import plural
from evaluators.report.runs import (
    STATES,
    Choice,
    RunEntry,
    State,
    as_day,
    chosen,
    find_runs,
    shown_folder,
)
from evaluators.report.trend_tables import runs_table, variants_of

EPILOG = """
Examples:

- `simrun runs`: every run folder below runs/, the newest first; unfinished and damaged ones too

- `simrun runs nightly --metric offroad --metric progress --last 10`: with means and 95 % intervals

- `simrun runs nightly --renderer onefixer --weights 99bf50 --since 7d`

- `simrun runs nightly --commit 3f2a9c1 --json`

- `simrun runs nightly --steps --metric lateral_distance_m`: from run to run, with verdicts and what changed

- `simrun runs nightly --trend trend.html`: the headline metrics over the runs, as a page

Filters given twice: any of the commits, weights, presets or states; all of the renderers, policies and scenes.

Exit codes: 0, also where nothing is found; 2 no such folder, no two runs to compare, or an option makes no sense.
"""


def runs(
    roots: Annotated[
        tuple[Path, ...], Positional("Folders of run folders; by default runs.", metavar="ROOT...")
    ] = (),
    commit: Annotated[
        tuple[str, ...], Flag("Project's commit, its first digits. Repeatable.")
    ] = (),
    weights: Annotated[
        tuple[str, ...],
        Flag("Weight file: the first digits of its SHA-256, or its name. Repeatable."),
    ] = (),
    renderer: Annotated[
        tuple[str, ...], Flag("A renderer of the run; * and ? match. Repeatable.")
    ] = (),
    policy: Annotated[
        tuple[str, ...], Flag("A policy of the run; * and ? match. Repeatable.")
    ] = (),
    scene: Annotated[
        tuple[str, ...], Flag("A scene or suite of the run; * and ? match. Repeatable.")
    ] = (),
    preset: Annotated[tuple[str, ...], Flag("Evaluator preset. Repeatable.")] = (),
    state: Annotated[tuple[str, ...], Flag(f"One of {', '.join(STATES)}. Repeatable.")] = (),
    since: Annotated[
        str | None, Flag("Begun at or after: 2026-03-01, 2026-03-01T18:00 (UTC), 7d, 12h.")
    ] = None,
    until: Annotated[str | None, Flag("Begun before.")] = None,
    last: Annotated[int | None, Flag("The newest N of them.", min=1)] = None,
    metric: Annotated[tuple[str, ...], Flag("Show this metric, by renderer. Repeatable.")] = (),
    steps: Annotated[
        bool, Flag("Compare each run with the comparable one before it, and name what changed.")
    ] = False,
    page: Annotated[
        Path | None, Flag("Write the same as an offline page.", "--trend", metavar="FILE")
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """List run folders: what was driven, with what, when, and how far it came; filtered, and with
    metrics side by side.
    """
    places = roots or [Path("runs")]
    now = datetime.now(UTC)
    choice = Choice(
        commit,
        weights,
        renderer,
        policy,
        scene,
        preset,
        _states(state),
        as_day(since, "--since", now) if since else None,
        as_day(until, "--until", now) if until else None,
    )
    refuse_existing(page, overwrite, "--trend")
    found = find_runs(places, bool(metric) or steps or page is not None)
    taken, lost = chosen(found, choice)
    taken = taken[:last]
    names = _metrics(metric, taken)
    if steps or page is not None:
        _trend(taken, names or list(METRICS.headline), places, page, as_json)
        _say(lost)
        return
    if as_json:
        rows = [
            one.as_dict() | ({"metrics": _values(one, names)} if names else {}) for one in taken
        ]
        unreadable = [{"folder": str(one.folder), "problem": one.problem} for one in lost]
        print(json.dumps({"runs": rows, "found": len(found), "unreadable": unreadable}))
        return
    if taken:
        table, same = runs_table(taken, places, names)
        Console().print(table)
        if same:
            print(f"in all: {same}")
    print(f"{plural(len(taken), 'run')} of {len(found)} below {', '.join(map(str, places))}")
    _say(lost)


def _say(lost: Sequence[RunEntry]) -> None:
    for one in lost:
        warn(f"not judged, its run.json cannot be read: {one.folder}: {one.problem or one.state}")


def _trend(
    entries: Sequence[RunEntry],
    metrics: Sequence[str],
    places: Sequence[Path],
    page: Path | None,
    as_json: bool,
) -> None:
    """Print the steps from run to run, or write the page of them.

    Raises:
        InputError: No two of the runs are comparable.
    """
    from evaluators.report.trend import trend
    from evaluators.report.trend_tables import as_json as trend_json
    from evaluators.report.trend_tables import steps_tables

    found = trend(entries, metrics)
    if not any(series.lines for series in found.series):
        why = (
            "; ".join(dict.fromkeys(reason for _, reason in found.left_out))
            or "no finished run has these metrics"
        )
        raise InputError(
            f"{plural(len(entries), 'run')} below {', '.join(map(str, places))}: none to compare: {why}",
            "keep a run folder for each commit, with the same scenes, seeds, policy and preset",
        )
    if page is not None:
        from evaluators.report.trend_page import (
            write_trend,
        )  # draws charts, which takes a second to load

        write_trend(found, places, page)
    if as_json:
        print(json.dumps({"trend": None if page is None else str(page), **trend_json(found)}))
        return
    if page is not None:
        print(
            f"page     {page}, {page.stat().st_size / 1e6:.1f} MB, {plural(len(found.series), 'line of runs', 'lines of runs')}"
        )
        return
    for title, table in steps_tables(found, places):
        print(title)
        Console().print(table)
    for entry, why in found.left_out:
        print(f"left out  {shown_folder(entry.folder, places)}: {why}")


def _states(asked: Sequence[str]) -> tuple[State, ...]:
    strange = [one for one in asked if one not in STATES]
    if strange:
        raise InputError(f"--state {strange[0]}: no such state", f"name one of {', '.join(STATES)}")
    return tuple(one for one in STATES if one in asked)


def _metrics(asked: Sequence[str], entries: list[RunEntry]) -> list[str]:
    """Return the metrics to show; refuse one that neither simrun nor any of the runs knows."""
    strange = [name for name in asked if name not in METRICS]
    seen = (
        {
            name
            for entry in entries
            for table in (entry.summary.get("metrics") or {}).values()
            for name in table
        }
        if strange
        else set()
    )
    for name in strange:
        if name not in seen:
            near = difflib.get_close_matches(name, {*METRICS, *seen}, 1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise InputError(
                f"--metric {name}: no such metric",
                f"{hint}simrun list metrics names those that ship",
            )
    return list(asked)


def _values(entry: RunEntry, names: list[str]) -> list[dict[str, Any]]:
    kept = ("mean", "ci95_clustered", "n_rollouts")
    return [
        {"renderer": r, "policy": p, "metric": name}
        | {key: entry.metric(name, r, p).get(key) for key in kept}
        for r, p in variants_of(entry)
        for name in names
    ]
