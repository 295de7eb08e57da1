"""``simrun gate``: test a run against margins and limits; the exit code is the verdict."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from alpasim_plugin.cli.deciding import What, decide_into, plan_of, population_of, print_end, questions_of_gate, side_of_baseline
from alpasim_plugin.cli.executor_options import Cores, ExecutorText, Gpus, MemoryGib, StoreUrl
from alpasim_plugin.cli.progress import make_progress, warn
from alpasim_plugin.cli.run import parse_seeds
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runtime.decide import Design
from alpasim_plugin.runtime.executors.choice import parse_executor
from alpasim_plugin.runtime.plan import RunOptions
from alpasim_plugin.runtime.repair import use_run
from alpasim_plugin.runtime.self_test import run_self_test
from evaluators.gate import (
    GateVerdict,
    check_matches,
    judge_decided,
    judge_table,
    load_gate,
    read_baseline,
    rows_of_run,
    table_of_run,
    write_baseline,
)
from evaluators.opening import read_run
from evaluators.report.ci import write_gate_files
from evaluators.sequential.question import Population, Question
from evaluators.sequential.record import stopping_note

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


def gate(
    run: Annotated[Path | None, typer.Argument(help="A run folder; with --until-decided it is written.")] = None,
    gate_file: Annotated[str, typer.Option("--gate", help="A gate file, or the name of a shipped gate.")] = "default",
    baseline_file: Annotated[
        Path | None, typer.Option("--baseline-file", help="Compare with this stored baseline, or this earlier run.")
    ] = None,
    approve: Annotated[Path | None, typer.Option("--write-baseline", help="Store the run as a baseline and stop.")] = None,
    self_test: Annotated[bool, typer.Option("--self-test", help="Drive broken renderers; fail unless the gate catches each.")] = False,
    until_decided: Annotated[bool, typer.Option("--until-decided", help="Drive --scenes until every binding margin is decided.")] = False,
    scenes: Annotated[list[str] | None, typer.Option("--scenes", help="Until decided: a scenario, suite or folder. Repeatable.")] = None,
    renderer: Annotated[
        str | None, typer.Option("--renderer", help="Until decided: baseline and renderer in question; with --baseline-file the latter.")
    ] = None,
    policy: Annotated[str, typer.Option("--policy", help="Until decided: the policy.")] = "lane-camera",
    seeds: Annotated[str, typer.Option("--seeds", help="Until decided: seeds of every scene.")] = "1",
    images: Annotated[Literal["none", "jpeg", "png"], typer.Option("--images", help="Until decided: frames in rollout.asl.")] = "jpeg",
    overrides: Annotated[list[str] | None, typer.Option("--set", help="Until decided: override a scenario key.")] = None,
    alpha: Annotated[float, typer.Option("--alpha", min=1e-6, max=0.5, help="Until decided: chance of a wrong decision.")] = 0.05,
    population: Annotated[
        Literal["scenes", "suite"],
        typer.Option("--population", help="Until decided: the population that the scenes were drawn from, or the suite itself."),
    ] = "scenes",
    order: Annotated[
        Literal["random", "stratified"], typer.Option("--order", help="Until decided: the order of scenes, as for `simrun decide`.")
    ] = "random",
    order_seed: Annotated[int, typer.Option("--order-seed", min=0, help="Until decided: key of the order of scenes.")] = 0,
    budget: Annotated[int | None, typer.Option("--budget", min=2, help="Until decided: most rollouts.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Where gate.md and gate.junit.xml go; by default the run folder.")] = None,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Self-test, until decided: worker processes.")] = None,
    executor: ExecutorText = "local",
    cores: Cores = None,
    gpus: Gpus = None,
    memory: MemoryGib = None,
    store: StoreUrl = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Judge a run by a gate, or test the gate itself on deliberately broken renderers."""
    del debug
    where = parse_executor(executor, cores, gpus, memory)
    if self_test:
        if run is not None or baseline_file is not None or approve is not None:
            raise InputError("testing a gate", "--self-test", "a run or baseline is named as well", "give --gate and --out only")
        raise typer.Exit(_self_test(gate_file, out, workers, as_json))
    if run is None:
        raise InputError("judging a run", "simrun gate", "no run folder is named", "name one, or use --self-test")
    driving = [
        ("--scenes", bool(scenes)),
        ("--renderer", renderer is not None),
        ("--executor", not where.is_local),
        ("--store", bool(store)),
    ]
    if not until_decided and (named := [name for name, is_given in driving if is_given]):
        found_none = "nothing is driven without --until-decided"
        raise InputError("judging a run", ", ".join(named), found_none, "add it, or leave them out")
    if until_decided:
        if approve is not None:
            raise InputError("judging a run", "--until-decided", "a baseline is to be written as well", "write it of a run that is driven")
        if not scenes or renderer is None:
            raise InputError(
                "judging a run",
                "--until-decided",
                "no scenes or renderers",
                "name them: --scenes SUITE --renderer A,B (one, with --baseline-file)",
            )
        what = What(scenes, renderer, policy, parse_seeds(seeds), RunOptions(images=images), tuple(overrides or ()))
        how = {"workers": workers, "executor": where, "store": store}
        design = Design(order, order_seed, budget=budget)
        raise typer.Exit(_until_decided(run, gate_file, what, alpha, population, design, baseline_file, out, as_json, how))
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
        wanted = f"preset {preset!r}, the gate {source} is for {spec.preset!r}"
        raise InputError("judging a run", str(run), wanted, "score it with that preset")
    stored = None
    if baseline_file is not None:
        stored = read_baseline(baseline_file)
        check_matches(stored, found, baseline_file)
    verdict = judge_table(table_of_run(found), spec, None if stored is None else stored.rows, str(baseline_file or ""), found.table)
    files = write_gate_files(verdict, source, found, out or run)
    if as_json:
        print(json.dumps({**verdict.as_dict(), "files": [str(path) for path in files]}))
    else:
        print_verdict(verdict)
    raise typer.Exit(verdict.exit_code)


def _until_decided(
    run: Path,
    gate_file: str,
    what: What,
    alpha: float,
    population: Population,
    design: Design,
    baseline_file: Path | None,
    out: Path | None,
    as_json: bool,
    how: dict[str, Any],
) -> int:
    """Drive until the gate's margins are decided, judge, write the gate's files, and return the exit code."""
    spec, source = load_gate(gate_file)
    options = replace(what.options, preset=spec.preset or what.options.preset, baseline=spec.baseline)
    plan = plan_of(replace(what, options=options), stored=baseline_file is not None)
    stored = None if baseline_file is None else side_of_baseline(baseline_file, plan, spec.baseline, spec.max_missing)
    population = population_of(population, spec.max_missing, f"max_missing {spec.max_missing:g} of {source}")
    question = Question(questions_of_gate(spec), alpha, population, min_scenes=spec.min_scenes)
    design = replace(design, max_failed=spec.max_failed, max_missing=spec.max_missing)
    decided = decide_into(plan, question, design, {}, run, as_json, stored, **how)
    found = read_run(run)
    rows = rows_of_run(found)
    driven = {(str(row["scene"]), int(row["seed"])) for row in rows}
    verdict = judge_decided(rows, spec, decided.record, None if stored is None else stored.of_cells(driven), found.table)
    files = write_gate_files(verdict, source, found, out or run)
    if as_json:
        print(json.dumps({**verdict.as_dict(), "decision": decided.record, "files": [str(path) for path in files]}))
    else:
        print_verdict(verdict)
        print_end(decided)
    return verdict.exit_code


def print_verdict(verdict: GateVerdict) -> None:
    """Print every check, other reasons, and the verdict."""
    for check in verdict.checks:
        note = "" if check.binding else " (not binding)"
        print(f"{check.cause:>10}  {check.policy}, {check.text}{note}")
    shown = {check.text for check in verdict.checks}
    for reason in verdict.outcome.reasons:
        if reason not in shown:
            print(f"{verdict.outcome.cause:>10}  {reason}")
    print(f"{verdict.outcome.title} (exit code {verdict.exit_code}), compared with {verdict.baseline}")


def _self_test(gate_file: str, out: Path | None, workers: int | None, as_json: bool) -> int:
    spec, source = load_gate(gate_file)
    root = out or Path("runs", f"gate-self-test-{spec.preset or 'paper'}")
    began = time.perf_counter()
    result = run_self_test(spec, root, workers, ["simrun", *sys.argv[1:]], lambda: make_progress(as_json))
    took_s = time.perf_counter() - began
    if as_json:
        trials = [trial.as_dict() for trial in result.trials]
        print(json.dumps({"gate": source, "outcome": result.outcome.as_dict(), "wall_s": round(took_s, 1), "trials": trials}))
        return result.outcome.exit_code
    for trial in result.trials:
        found = f"caught by {', '.join(trial.caught_by)}" if trial.caught_by else "not called worse"
        print(f"{'ok' if trial.is_right else 'WRONG':>5}  {trial.renderer}: {found}")
        if not trial.is_right:
            for check in trial.verdict.checks:
                print(f"       {check.text}")
    for reason in result.outcome.reasons:
        print(f"self-test: {reason}", file=sys.stderr)
    print(f"self-test of {source}: {result.outcome.title} (exit code {result.outcome.exit_code}) in {took_s:.0f} s; rollouts in {root}")
    return result.outcome.exit_code
