"""``simrun gate``: test a run against margins and limits; the exit code is the verdict."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from alpasim_plugin.cli.options import Json, Run, run_or_newest
from alpasim_plugin.cli.progress import make_progress, warn
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.parts import names
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.log.run_folder.schema import PAGES
from alpasim_plugin.log.run_folder.sides import Row
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.reports import write_reports
from alpasim_plugin.runs.run import Progress, execute_run
from alpasim_plugin.runs.tables import ensure_tables
from evaluators.metrics.presets import DEFAULT
from evaluators.opening import read_run
from evaluators.report.ci import write_gate_files
from evaluators.statistics.baselines import (
    check_matches,
    read_baseline,
    rows_of_run,
    table_of_run,
    write_baseline,
)
from evaluators.statistics.decision import stopping_note
from evaluators.statistics.gate import GateSpec, GateVerdict, judge, load_gate
from evaluators.statistics.verdicts import Outcome, outcome_of_failures, worst
from scenarios.suite import load_suite

SUITE = "suites/gate_self_test"
POLICY = "lane-camera"  # the shipped policy that drives from camera frames
REFERENCE = "clean"
CONTROL = "clean, other noise"
SEED, OTHER_SEED = 0, 1


@dataclass(frozen=True)
class Trial:
    """The gate's verdict on one renderer, and whether it is right."""

    renderer: str
    is_broken: bool
    verdict: GateVerdict

    @property
    def is_right(self) -> bool:
        """Return whether a broken renderer is caught, or the control is not called worse."""
        return (self.verdict.outcome.cause == "regression") == self.is_broken

    @property
    def caught_by(self) -> list[str]:
        """Name the metrics whose rule was broken."""
        return [check.metric for check in self.verdict.checks if check.cause == "regression"]

    def as_dict(self) -> dict[str, Any]:
        """Return the trial for JSON."""
        facts = {
            "renderer": self.renderer,
            "is_broken": self.is_broken,
            "is_right": self.is_right,
            "caught_by": self.caught_by,
        }
        return facts | {"verdict": self.verdict.as_dict()}


@dataclass(frozen=True)
class SelfTest:
    """All trials and their outcome."""

    trials: tuple[Trial, ...]
    outcome: Outcome
    root: Path


def broken_renderers() -> list[str]:
    """Return the registered renderers with a deliberate fault."""
    return [name for name in names("renderer") if name.startswith("broken-")]


def run_self_test(
    spec: GateSpec,
    root: Path,
    command: Sequence[str],
    progress: Callable[[], Progress],
) -> SelfTest:
    """Drive the suite behind the reference and every broken renderer and judge each pair by the
    gate.

    The gate's rules apply unchanged, except that the reference is `REFERENCE`, that ``min_scenes``
    is at most the suite's size and that its scenes are all that is asked about. As a control the
    reference is compared with itself under another seed: a gate that fails everything fails its
    test.

    Args:
        spec: The gate under test.
        root: Run folder; finished rollouts in it are reused.
        command: Written to run.json.
        progress: Creates a progress display, once for each of the two runs.
    """
    broken = broken_renderers()
    options = RunOptions(preset=spec.preset or DEFAULT, baseline=REFERENCE)
    plan = make_plan(load_suite(SUITE), [REFERENCE, *broken], [POLICY], [SEED], options)
    control = make_plan(load_suite(SUITE), [REFERENCE], [POLICY], [OTHER_SEED], options)
    runs = [(plan, root), (control, root / "control")]
    results = [execute_run(one, folder, None, command, progress()) for one, folder in runs]
    rows = rows_of_run(read_run(root))
    # The rollouts of the other seed get the first seed, so that they are paired with its rollouts.
    again = [
        {**row, "renderer": CONTROL, "seed": SEED}
        for row in rows_of_run(read_run(root / "control"))
    ]
    trials = [Trial(name, True, _judge(spec, rows, name, len(plan.scenarios))) for name in broken]
    trials.append(
        Trial(CONTROL, False, _judge(spec, [*rows, *again], CONTROL, len(plan.scenarios)))
    )
    failed = worst([outcome_of_failures(result.summary["failures"]) for result in results])
    if failed.cause != "pass":
        return SelfTest(tuple(trials), failed, root)
    wrong = [trial for trial in trials if not trial.is_right]
    reasons = tuple(
        f"{t.renderer} is {'not caught' if t.is_broken else 'wrongly called worse'}" for t in wrong
    )
    return SelfTest(tuple(trials), Outcome("regression" if wrong else "pass", reasons), root)


def _judge(spec: GateSpec, rows: Sequence[Row], name: str, n_scenes: int) -> GateVerdict:
    fields = {
        "renderers": (name,),
        "baseline": REFERENCE,
        "min_scenes": min(spec.min_scenes, n_scenes),
        "max_failed": 0.0,
    }
    fields["population"] = "suite"
    only = [row for row in rows if row["renderer"] in (REFERENCE, name)]
    return judge(only, spec.model_copy(update=fields))


EPILOG = """
Examples:

- `simrun gate runs/nightly --gate default`

- `simrun gate runs/main --write-baseline baseline.json`, then `simrun gate runs/change --gate gate.yaml --baseline-file baseline.json`

- `simrun gate --self-test`

Exit codes: 0 pass, 1 regression, 2 bad input, another baseline or a broken policy, 3 undecided, 4 rollouts could not be run,
5 could not be scored.
"""


def gate(
    run: Run = None,
    gate_file: Annotated[
        str, Flag("A gate file, or the name of a shipped gate.", "--gate")
    ] = "default",
    baseline_file: Annotated[
        Path | None, Flag("Compare with this stored baseline, or this earlier run.")
    ] = None,
    approve: Annotated[
        Path | None, Flag("Store the run as a baseline and stop.", "--write-baseline")
    ] = None,
    self_test: Annotated[
        bool, Flag("Drive broken renderers and fail unless the gate catches each.")
    ] = False,
    out: Annotated[
        Path | None, Flag("Where gate.md and gate.junit.xml go; by default the run folder.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Judge a run by a gate, or test the gate itself on deliberately broken renderers."""
    if self_test:
        if run is not None or baseline_file is not None or approve is not None:
            raise InputError(
                "--self-test: a run or baseline is named", "Give --gate and --out only."
            )
        raise typer.Exit(_self_test(gate_file, out, as_json))
    run = run_or_newest(run)
    ensure_tables(run, warn)
    stored_run = read_run(run)
    if approve is not None:
        write_baseline(stored_run, approve)
        print(json.dumps({"baseline": str(approve)}) if as_json else f"baseline  {approve}")
        return
    if note := stopping_note(run):
        warn(note)
    spec, source = load_gate(gate_file, stored_run.table)
    preset = str(stored_run.summary.get("preset"))
    if spec.preset is not None and spec.preset != preset:
        raise InputError(
            f"{run}: preset {preset!r}, the gate {source} is for {spec.preset!r}",
            "Score the run with that preset.",
        )
    baseline = None
    if baseline_file is not None:
        baseline = read_baseline(baseline_file)
        check_matches(baseline, stored_run, baseline_file)
    rows = None if baseline is None else baseline.rows
    verdict = judge(
        table_of_run(stored_run), spec, rows, str(baseline_file or ""), stored_run.table
    )
    files = write_gate_files(verdict, source, stored_run, out or run, rows)
    if out is None and (run / PAGES[0]).is_file():
        write_reports(run, flips=read_run_json(run).get("kind") != "score")
    if as_json:
        print(json.dumps({**verdict.as_dict(), "files": [str(path) for path in files]}))
    else:
        print_verdict(verdict)
    raise typer.Exit(verdict.exit_code)


def print_verdict(verdict: GateVerdict) -> None:
    """Print every check, other reasons, and the verdict."""
    for check in verdict.checks:
        note = "" if check.binding else " (not binding)"
        print(f"{check.cause:>10}  {check.policy}, {check.text}{note}")
    shown = {check.text for check in verdict.checks}
    for reason in verdict.outcome.reasons:
        if reason not in shown:
            print(f"{verdict.outcome.cause:>10}  {reason}")
    print(
        f"{verdict.outcome.title} (exit code {verdict.exit_code}), compared with {verdict.baseline}"
    )


def _self_test(gate_file: str, out: Path | None, as_json: bool) -> int:
    spec, source = load_gate(gate_file)
    root = out or Path("runs", f"gate-self-test-{spec.preset or DEFAULT}")
    began = time.perf_counter()
    result = run_self_test(spec, root, ["simrun", *sys.argv[1:]], lambda: make_progress(as_json))
    took_s = time.perf_counter() - began
    if as_json:
        trials = [trial.as_dict() for trial in result.trials]
        print(
            json.dumps(
                {
                    "gate": source,
                    "outcome": result.outcome.as_dict(),
                    "wall_s": round(took_s, 1),
                    "trials": trials,
                }
            )
        )
        return result.outcome.exit_code
    for trial in result.trials:
        found = f"caught by {', '.join(trial.caught_by)}" if trial.caught_by else "not called worse"
        print(f"{'ok' if trial.is_right else 'WRONG':>5}  {trial.renderer}: {found}")
        if not trial.is_right:
            for check in trial.verdict.checks:
                print(f"       {check.text}")
    for reason in result.outcome.reasons:
        print(f"self-test: {reason}", file=sys.stderr)
    print(
        f"self-test of {source}: {result.outcome.title} (exit code {result.outcome.exit_code}) in {took_s:.0f} s; rollouts in {root}"
    )
    return result.outcome.exit_code
