"""``simrun gate``: test a run against margins and limits; the exit code is the verdict."""

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.cli.options import Json, run_or_newest
from alpasim_plugin.cli.output import Progress, show, warn
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.log.run_folder.schema import PAGES
from alpasim_plugin.runs.joined import check_apart, join_runs, missing_shards
from alpasim_plugin.runs.reports import update_run_list, write_reports
from alpasim_plugin.runs.self_test import run_self_test
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.metrics.presets import DEFAULT
from evaluators.pages.ci import write_gate_files
from evaluators.results import Outcome
from evaluators.statistics.baselines import (
    Baseline,
    check_matches,
    is_repeatable,
    read_baseline,
    table_of_run,
    write_baseline,
)
from evaluators.statistics.boundary_gate import boundary_verdict
from evaluators.statistics.decision import stopping_note
from evaluators.statistics.gate import (
    GateSpec,
    GateVerdict,
    check_gate,
    check_number_of_scenes,
    load_gate,
)
from evaluators.statistics.numbers import plural
from evaluators.statistics.opening import Run, read_run
from scenarios.suite import load_suite

EPILOG = """
Examples:

- `simrun gate runs/nightly --gate default`

- `simrun gate runs/main --write-baseline baseline.json`, then `simrun gate runs/change --gate gate.yaml --baseline-file baseline.json`

- `simrun gate runs/night-1 runs/night-2 runs/night-3 --out runs/night`: one verdict on the shards of a run

- `simrun gate suites/urban --gate release.yaml`: whether these scenes can decide, before they are driven

- `simrun gate --self-test`

Exit codes: 0 pass, 1 regression, 2 bad input, another baseline or a broken policy, 3 undecided, 4 rollouts could not be run,
5 could not be scored.
"""


def gate(
    runs: Annotated[
        tuple[Path, ...],
        Positional(
            "A run folder, by default the newest; or all shards of a run; or a suite that has not been driven.",
            metavar="RUN...",
        ),
    ] = (),
    gate_file: Annotated[
        str, Flag("A gate file, or the name of a shipped gate.", "--gate")
    ] = "default",
    baseline_file: Annotated[
        Path | None, Flag("A stored baseline, or an earlier run, to compare with.")
    ] = None,
    approve: Annotated[
        Path | None, Flag("Store the run as a baseline and stop.", "--write-baseline")
    ] = None,
    self_test: Annotated[bool, Flag("Fail unless the gate catches each broken renderer.")] = False,
    out: Annotated[
        Path | None, Flag("Where gate.md and gate.junit.xml go; default: into the run folder.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Check a run against a gate, or test the gate on broken renderers.

    The shards of one run are joined, and the verdict is about all of their scenes. Of a suite it
    says, before anything is driven, whether its scenes are enough for the gate.
    """
    if self_test:
        if runs or baseline_file or approve:
            raise InputError(
                "--self-test: a run or baseline is named", "Give --gate and --out only."
            )
        raise typer.Exit(_self_test(gate_file, out, as_json))
    if len(runs) == 1 and not os.path.isdir(runs[0]):
        _check_suite(str(runs[0]), gate_file, baseline_file or approve or out, as_json)
        return
    run, absent = _opened([run_or_newest(folder) for folder in runs] or [run_or_newest(None)])
    if approve is not None:
        if absent is not None:
            raise InputError(f"{run.title}: {absent}", "Name the runs of all shards.")
        write_baseline(run, approve)
        show(as_json, {"baseline": str(approve)}, f"baseline  {approve}")
        return
    spec, source = load_gate(gate_file, run.table)
    verdict = _verdict(run, spec, source, baseline_file)
    if absent is not None:
        verdict = verdict.with_outcome(Outcome("incomplete", (absent,)))
    _publish(verdict, source, run, out if run.folders else out or run.folder, as_json)
    raise typer.Exit(verdict.exit_code)


def _publish(
    verdict: GateVerdict, source: str, run: Run, folder: Path | None, as_json: bool
) -> None:
    """Write the files of a verdict, show it in the pages of the run if they lie there, and print it.

    Args:
        verdict: The verdict.
        source: The gate's name.
        run: What it is about.
        folder: Where the files go; None: nothing is written of several runs.
        as_json: Whether to print JSON.
    """
    files = write_gate_files(verdict, source, run, folder)
    if folder == run.folder:
        _show_in_pages(run.folder)
    facts = {**verdict.as_dict(), "files": [str(path) for path in files]}
    lines = verdict_lines(verdict)
    if folder is None:
        lines.append("gate.md and gate.junit.xml of several runs are written with --out FOLDER")
    show(as_json, facts, *lines)


def _show_in_pages(folder: Path) -> None:
    """Write the run's report again, where it has one, and the list of runs."""
    if os.path.isfile(folder / PAGES[0]):
        write_reports(folder)
    else:
        update_run_list(folder)


def _opened(folders: Sequence[Path]) -> tuple[Run, str | None]:
    """Return a run, or the one that several shards make together, and which shards it lacks.

    Raises:
        InputError: A run is not finished, or the runs are not shards of one.
    """
    for folder in folders:
        ensure_tables(folder, warn)
        if note := stopping_note(folder):
            warn(note)
    runs = [read_run(folder) for folder in folders]
    absent = missing_shards([run.info for run in runs])
    if len(runs) == 1:
        return runs[0], absent
    check_apart(runs)
    return join_runs(runs), absent


def _verdict(run: Run, spec: GateSpec, source: str, baseline_file: Path | None) -> GateVerdict:
    """Return the verdict on a run by the gate ``spec``, which ``source`` names.

    Raises:
        InputError: The gate is for another preset, or the baseline is of other scenes or metrics.
    """
    preset = run.summary.preset
    if spec.preset is not None and spec.preset != preset:
        raise InputError(
            f"{run.title}: preset {preset!r}, the gate {source} is for {spec.preset!r}",
            "Score the run with that preset.",
        )
    baseline_name = str(baseline_file or "")
    if spec.boundary_margin is not None:
        if run.folders:
            raise InputError(
                f"{run.title}: several runs, and the gate has boundary_margin",
                "A search along a parameter is one run: name that run alone.",
            )
        earlier = None
        if baseline_file is not None:
            earlier = read_run(baseline_file).summary.boundary or {}
        boundary = run.summary.boundary
        return boundary_verdict(table_of_run(run), spec, boundary, earlier, baseline_name)
    repeatable = is_repeatable(run)
    stored = None
    if baseline_file is not None:
        baseline = _baseline(baseline_file, run)
        stored = baseline.table
        if baseline.repeatable is False:
            repeatable = False
    return check_gate(table_of_run(run), spec, stored, baseline_name, run.table, preset, repeatable)


def _baseline(path: Path, run: Run) -> Baseline:
    """Read a stored baseline, or an earlier run, that a run is compared with."""
    if os.path.isdir(path):
        ensure_tables(path, warn)
    baseline = read_baseline(path)
    check_matches(baseline, run, path)
    return baseline


def verdict_lines(verdict: GateVerdict) -> list[str]:
    """Return a line for every check and every other reason, what they can show, and the verdict."""
    lines = []
    for check in verdict.checks:
        note = "" if check.binding else " (not binding)"
        lines.append(f"{check.cause:>10}  {check.policy}, {check.text}{note}")
    outcome = verdict.outcome
    texts = {check.text for check in verdict.checks}
    lines += [f"{outcome.cause:>10}  {text}" for text in outcome.reasons if text not in texts]
    code = verdict.exit_code
    title = f"{outcome.title} (exit code {code}), compared with {verdict.baseline}"
    return [*lines, *verdict.sizes, f"{title}; {verdict.about}"]


def _check_suite(suite: str, gate_file: str, other: Path | None, as_json: bool) -> None:
    if other is not None:
        raise InputError(
            f"{suite}: has not been driven, and {other} is named beside it", "Give --gate only."
        )
    try:
        refs = load_suite(suite)
    except InputError as error:
        hint = f"{error.hint}; 'simrun list runs' shows run folders"
        raise InputError(error.message, hint) from error
    spec, source = load_gate(gate_file)
    n_scenes = len(set(refs))
    check_number_of_scenes(spec, n_scenes)
    facts = {"suite": suite, "gate": source, "population": spec.population, "scenes": n_scenes}
    show(as_json, facts, f"{suite}: its {plural(n_scenes, 'scene')} can pass the gate {source}")


def _self_test(gate_file: str, out: Path | None, as_json: bool) -> int:
    spec, source = load_gate(gate_file)
    root = out or Path("runs", f"gate-self-test-{spec.preset or DEFAULT}")
    began = time.perf_counter()
    with Progress(as_json) as progress:
        trials, outcome = run_self_test(spec, root, ["simrun", *sys.argv[1:]], progress)
    wall_s = time.perf_counter() - began
    lines = []
    for trial in trials:
        caught = (
            f"caught by {', '.join(trial.caught_by)}" if trial.caught_by else "not called worse"
        )
        lines.append(f"{'ok' if trial.is_right else 'WRONG':>5}  {trial.renderer}: {caught}")
        if not trial.is_right:
            lines += [f"       {check.text}" for check in trial.verdict.checks]
    code = outcome.exit_code
    verdict = f"self-test of {source}: {outcome.title} (exit code {code})"
    facts = {
        "gate": source,
        "outcome": outcome.as_dict(),
        "wall_s": round(wall_s, 1),
        "trials": [trial.as_dict() for trial in trials],
    }
    show(
        as_json, facts, *lines, *outcome.reasons, f"{verdict} in {wall_s:.0f} s; rollouts in {root}"
    )
    return code
