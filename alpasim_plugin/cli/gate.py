"""``simrun gate``: test a run against margins and limits; the exit code is the verdict."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from alpasim_plugin.cli.decide import (
    Alpha,
    Asked,
    Stored,
    decide_into,
    plan_of,
    population_of,
    print_end,
    questions_of_gate,
    side_of_baseline,
)
from alpasim_plugin.cli.options import Json, Only, What, Where
from alpasim_plugin.cli.progress import make_progress, warn
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.parts import names
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.log.run_folder.schema import PAGES
from alpasim_plugin.log.run_folder.sides import Row
from alpasim_plugin.runs.decide import Design
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.repair import use_run
from alpasim_plugin.runs.reports import write_reports
from alpasim_plugin.runs.run import Progress, execute_run
from evaluators.metrics.presets import DEFAULT
from evaluators.opening import read_run
from evaluators.report.ci import write_gate_files
from evaluators.report.verdict import judge_decided
from evaluators.statistics.baselines import (
    check_matches,
    read_baseline,
    rows_of_run,
    table_of_run,
    write_baseline,
)
from evaluators.statistics.decision import Question, stopping_note
from evaluators.statistics.gate import GateSpec, GateVerdict, judge, judge_table, load_gate
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
    workers: int | None,
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
        workers: As for a run.
        command: Written to run.json.
        progress: Creates a progress display, once for each of the two runs.
    """
    broken = broken_renderers()
    options = RunOptions(preset=spec.preset or DEFAULT, baseline=REFERENCE)
    plan = make_plan(load_suite(SUITE), [REFERENCE, *broken], [POLICY], [SEED], options)
    control = make_plan(load_suite(SUITE), [REFERENCE], [POLICY], [OTHER_SEED], options)
    runs = [(plan, root), (control, root / "control")]
    results = [
        execute_run(one, folder, workers, command, progress(), certificate="none")
        for one, folder in runs
    ]
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


DOING = "judging a run"

EPILOG = """
Examples:

- `simrun gate runs/nightly --gate default`

- `simrun gate runs/main --write-baseline baseline.json`, then `simrun gate runs/change --gate gate.yaml --baseline-file baseline.json`

- `simrun gate runs/change --until-decided --scenes suites/all --renderer clean,onefixer`: drives only as many scenes as the margins need

- `simrun gate runs/change --until-decided --scenes suites/all --renderer onefixer --baseline-file runs/old`: drives the change alone

- `simrun gate --self-test`

Exit codes: 0 pass, 1 regression, 2 bad input, another baseline or a broken policy, 3 undecided, 4 rollouts could not be run,
5 could not be scored.
"""


@dataclass(frozen=True)
class UntilDecided:
    """What `--until-decided` is given beside the parts that it shares with `simrun decide`."""

    until_decided: Annotated[
        bool, Flag("Drive --scenes until every binding margin is decided.")
    ] = False
    scenes: Annotated[
        tuple[str, ...], Flag("Until decided: a scenario, suite or folder. Repeatable.")
    ] = ()
    renderer: Annotated[
        str | None,
        Flag(
            "Until decided: baseline and renderer in question; with --baseline-file the latter.",
            names="renderer",
        ),
    ] = None
    alpha: Alpha = 0.05
    population: Asked = "scenes"


def gate(
    until: UntilDecided,
    what: Annotated[What, Only("policy", "seeds", "overrides")],
    design: Annotated[Design, Only("budget")],
    where: Where,
    run: Annotated[
        Path | None, Positional("A run folder; with --until-decided it is written.")
    ] = None,
    gate_file: Annotated[
        str, Flag("A gate file, or the name of a shipped gate.", "--gate")
    ] = "default",
    baseline_file: Stored = None,
    approve: Annotated[
        Path | None, Flag("Store the run as a baseline and stop.", "--write-baseline")
    ] = None,
    self_test: Annotated[
        bool, Flag("Drive broken renderers; fail unless the gate catches each.")
    ] = False,
    out: Annotated[
        Path | None, Flag("Where gate.md and gate.junit.xml go; by default the run folder.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Judge a run by a gate, or test the gate itself on deliberately broken renderers.

    With `--until-decided` it drives as `simrun decide` does; what says how to drive is for that
    alone.
    """
    how = where.arguments()
    if self_test:
        if run is not None or baseline_file is not None or approve is not None:
            raise InputError(
                "--self-test: a run or baseline is named as well",
                "give --gate and --out only",
            )
        raise typer.Exit(_self_test(gate_file, out, where.workers, as_json))
    if run is None:
        raise InputError("simrun gate: no run folder is named", "name one, or use --self-test")
    if until.until_decided:
        if approve is not None:
            raise InputError(
                "--until-decided: a baseline is to be written as well",
                "write it of a run that is driven",
            )
        if not until.scenes or until.renderer is None:
            raise InputError(
                "--until-decided: no scenes or renderers",
                "name them: --scenes SUITE --renderer A,B (one, with --baseline-file)",
            )
        what = replace(what, scenarios=until.scenes, renderer=until.renderer)
        raise typer.Exit(
            _until_decided(run, gate_file, until, what, design, baseline_file, out, as_json, how)
        )
    driving = {
        "--scenes": until.scenes,
        "--renderer": until.renderer,
        "--executor": not how["executor"].is_local,
        "--store": where.store,
    }
    if named := [name for name, is_given in driving.items() if is_given]:
        raise InputError(
            f"{', '.join(named)}: nothing is driven without --until-decided",
            "add it, or leave them out",
        )
    use_run(run, warn)
    found = read_run(run)
    if approve is not None:
        write_baseline(found, approve)
        print(json.dumps({"baseline": str(approve)}) if as_json else f"baseline  {approve}")
        return
    if note := stopping_note(run):
        warn(note)
    spec, source = load_gate(gate_file, found.table)
    preset = str(found.summary.get("preset"))
    if spec.preset is not None and spec.preset != preset:
        raise InputError(
            f"{run}: preset {preset!r}, the gate {source} is for {spec.preset!r}",
            "score it with that preset",
        )
    stored = None
    if baseline_file is not None:
        stored = read_baseline(baseline_file)
        check_matches(stored, found, baseline_file)
    verdict = judge_table(
        table_of_run(found),
        spec,
        None if stored is None else stored.rows,
        str(baseline_file or ""),
        found.table,
    )
    files = write_gate_files(
        verdict, source, found, out or run, None if stored is None else stored.rows
    )
    _show_in_report(run, out)
    if as_json:
        print(json.dumps({**verdict.as_dict(), "files": [str(path) for path in files]}))
    else:
        print_verdict(verdict)
    raise typer.Exit(verdict.exit_code)


def _until_decided(
    run: Path,
    gate_file: str,
    until: UntilDecided,
    what: What,
    design: Design,
    baseline_file: Path | None,
    out: Path | None,
    as_json: bool,
    how: dict[str, Any],
) -> int:
    """Drive until the gate's margins are decided, judge, write the gate's files, and return the
    exit code.
    """
    spec, source = load_gate(gate_file)
    options = RunOptions(preset=spec.preset or RunOptions.preset, baseline=spec.baseline)
    plan = plan_of(what, options, stored=baseline_file is not None)
    stored = (
        None
        if baseline_file is None
        else side_of_baseline(baseline_file, plan, spec.baseline, spec.max_missing)
    )
    population = population_of(
        until.population, spec.max_missing, f"max_missing {spec.max_missing:g} of {source}"
    )
    question = Question(
        questions_of_gate(spec), until.alpha, population, min_scenes=spec.min_scenes
    )
    design = replace(design, max_failed=spec.max_failed, max_missing=spec.max_missing)
    decided = decide_into(plan, question, design, run, as_json, stored, **how)
    found = read_run(run)
    rows = rows_of_run(found)
    driven = {(str(row["scene"]), int(row["seed"])) for row in rows}
    verdict = judge_decided(
        rows, spec, decided.record, None if stored is None else stored.of_cells(driven), found.table
    )
    files = write_gate_files(
        verdict, source, found, out or run, None if stored is None else stored.of_cells(driven)
    )
    _show_in_report(run, out)
    if as_json:
        print(
            json.dumps(
                {
                    **verdict.as_dict(),
                    "decision": decided.record,
                    "files": [str(path) for path in files],
                }
            )
        )
    else:
        print_verdict(verdict)
        print_end(decided)
    return verdict.exit_code


def _show_in_report(run: Path, out: Path | None) -> None:
    """Write the run's report again, with the gate in it; one that is not there stays away, as does
    that of a gate kept elsewhere.
    """
    if out is None and (run / PAGES[0]).is_file():
        write_reports(run, flips=read_run_json(run).get("kind") != "score")


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


def _self_test(gate_file: str, out: Path | None, workers: int | None, as_json: bool) -> int:
    spec, source = load_gate(gate_file)
    root = out or Path("runs", f"gate-self-test-{spec.preset or DEFAULT}")
    began = time.perf_counter()
    result = run_self_test(
        spec, root, workers, ["simrun", *sys.argv[1:]], lambda: make_progress(as_json)
    )
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
