"""``simrun decide``: drive scenes in random order until a question is decided."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from alpasim_plugin.cli.deciding import (
    AUTO,
    DOING,
    What,
    controls_of,
    decide_into,
    plan_of,
    population_of,
    print_end,
    questions_of,
    questions_of_gate,
    side_of_baseline,
)
from alpasim_plugin.cli.executor_options import Cores, ExecutorText, Gpus, MemoryGib, StoreUrl
from alpasim_plugin.cli.report import report_line
from alpasim_plugin.cli.run import check_preset, parse_seeds, split_overrides
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runtime.certificate import Certify
from alpasim_plugin.runtime.decide import Design
from alpasim_plugin.runtime.executors.choice import parse_executor
from alpasim_plugin.runtime.plan import RunOptions
from evaluators.gate import load_gate
from evaluators.sequential.asymptotic import FIRST_LOOK
from evaluators.sequential.question import Question

EPILOG = """
Examples:

- `simrun decide --renderer clean,3dgs suites/urban`: is 3dgs non-inferior to clean by the default gate?

- `simrun decide --renderer clean,onefixer --metric lateral_distance_m=0.1,progress=0.05 suites/all --budget 200`

- `simrun decide --renderer clean,3dgs --population suite --order stratified suites/all`: about the mean of this suite, family by family

- `simrun decide --renderer 3dgs,onefixer --ask better --metric lateral_distance_m=0.05 suites/all`: at least 5 cm better?

- `simrun decide --renderer clean,3dgs --population suite --control family --control runs/last-week suites/all`

- `simrun decide --renderer 3dgs --baseline-file runs/last-week suites/all`: drives the change alone, against the same renderer last week

- `simrun decide --renderer clean,3dgs --executor ray --look-every 50 --store s3://bucket/night suites/all`: 100 rollouts at a time

Exit codes: 0 non-inferior (or better), 1 worse (or not better), 2 bad input or a broken policy, 3 undecided at the ceiling,
4 rollouts could not be run, 5 could not be scored. docs/sequential.md says what is guaranteed.
"""


def decide(
    scenarios: Annotated[list[str], typer.Argument(help="Scenario or suite YAML, a folder of them, a shipped name, or a recorded log.")],
    renderer: Annotated[
        str,
        typer.Option("--renderer", help="Baseline and renderer in question, comma-separated; with --baseline-file the latter alone."),
    ],
    policy: Annotated[str, typer.Option("--policy", help="The policy, as for `simrun run`.")] = "lane-camera",
    metric: Annotated[
        list[str] | None,
        typer.Option("--metric", metavar="NAME[=MARGIN]", help="What is asked about; repeatable or comma-separated. Default: the gate's."),
    ] = None,
    gate: Annotated[str, typer.Option("--gate", help="Gate whose margins are asked about where no --metric is named.")] = "default",
    ask: Annotated[
        Literal["non-inferior", "better"], typer.Option("--ask", help="At most MARGIN worse, or at least MARGIN better?")
    ] = "non-inferior",
    expect: Annotated[
        float | None, typer.Option("--expect", help="Expected difference, which makes the decision fast. Default: that nothing changes.")
    ] = None,
    alpha: Annotated[float, typer.Option("--alpha", min=1e-6, max=0.5, help="Chance of a wrong decision, over all looks.")] = 0.05,
    method: Annotated[
        Literal["betting", "asymptotic"] | None, typer.Option("--method", help="Default: betting where differences are bounded.")
    ] = None,
    population: Annotated[
        Literal["scenes", "suite"],
        typer.Option("--population", help="The population that the scenes were drawn from, or the suite itself."),
    ] = "scenes",
    control: Annotated[
        list[str] | None,
        typer.Option("--control", metavar="family|RUN", help="With --population suite: take out known variance. Repeatable."),
    ] = None,
    order: Annotated[
        Literal["random", "stratified"],
        typer.Option("--order", help="With --population suite, stratified: between looks every family of scenes in proportion."),
    ] = "random",
    order_seed: Annotated[int, typer.Option("--order-seed", min=0, help="Key of the order of scenes.")] = 0,
    look_every: Annotated[int, typer.Option("--look-every", min=1, help="Scenes between looks.")] = 5,
    first_look: Annotated[
        int, typer.Option("--first-look", min=5, help="Scenes before the first look of asymptotic metrics.")
    ] = FIRST_LOOK,
    min_scenes: Annotated[
        int | None, typer.Option("--min-scenes", min=2, help="Scenes before any decision. Default: the gate's, else 2.")
    ] = None,
    budget: Annotated[int | None, typer.Option("--budget", min=2, help="Most rollouts; then undecided. Default: all of the suite.")] = None,
    seeds: Annotated[str, typer.Option("--seeds", help="Seeds of every scene, or auto:N: up to N, chosen by cost against variance.")] = "1",
    scene_cost: Annotated[
        float, typer.Option("--scene-cost", min=0.0, help="What a new scene costs (a reconstruction, say), in pairs of rollouts.")
    ] = 0.0,
    max_missing: Annotated[float, typer.Option("--max-missing", min=0.0, max=0.99, help="Share of pairs that may lack a value.")] = 0.0,
    baseline: Annotated[
        str | None,
        typer.Option("--baseline", help="Renderer to compare against; by default the first, or with --baseline-file the one in question."),
    ] = None,
    baseline_file: Annotated[
        Path | None, typer.Option("--baseline-file", help="Compare with this stored baseline, or this earlier run.")
    ] = None,
    preset: Annotated[str, typer.Option("--preset", help="Evaluator preset.")] = "paper",
    out: Annotated[Path | None, typer.Option("--out", help="Run folder; by default one below runs/ named after the command.")] = None,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Worker processes; the result does not depend on them.")] = None,
    executor: ExecutorText = "local",
    cores: Cores = None,
    gpus: Gpus = None,
    memory: MemoryGib = None,
    store: StoreUrl = None,
    images: Annotated[Literal["none", "jpeg", "png"], typer.Option("--images", help="Camera frames in rollout.asl.")] = "jpeg",
    overrides: Annotated[list[str] | None, typer.Option("--set", help="Override a scenario key: key=value. Repeatable.")] = None,
    device: Annotated[Literal["cpu", "cuda"], typer.Option("--device", help="Where renderers compute.")] = "cpu",
    certify: Annotated[Certify, typer.Option("--certify", help="Repeat one rollout and compare bit for bit.")] = "one",
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for a process that writes the run folder; otherwise refuse.")] = False,
    time_limit: Annotated[float | None, typer.Option("--time-limit", min=0.001, help="Seconds that a rollout may take.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, only the end.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Drive scenes in random order until it is decided whether a renderer is worse than another.

    An interrupted decision continues when the same command is given again, and decides the same.
    """
    del debug
    where = parse_executor(executor, cores, gpus, memory)
    check_preset(preset)
    spec = None if metric else load_gate(gate)[0]
    if spec is not None and (ask != "non-inferior" or expect is not None):
        raise InputError(DOING, f"--ask {ask}" if ask != "non-inferior" else "--expect", "no metric is named", "name it with --metric")
    asked = questions_of(metric, ask, expect, method) if metric else questions_of_gate(spec)  # type: ignore[arg-type]
    least = min_scenes or (spec.min_scenes if spec is not None else 2)
    question = Question(asked, alpha, population_of(population, max_missing, f"--max-missing {max_missing:g}"), first_look, least)
    is_auto = seeds.startswith(AUTO)
    if is_auto and population == "suite":
        raise InputError(DOING, f"--seeds {seeds}", "the suite's mean is over the same seeds in every scene", "give a number of seeds")
    design = Design(order, order_seed, look_every, budget, is_auto, scene_cost, max_missing=max_missing)
    of_scene, of_fixer = split_overrides(overrides or ())
    options = RunOptions(preset, images, "none", device, baseline, of_fixer)
    what = What(scenarios, renderer, policy, parse_seeds(seeds.removeprefix(AUTO)), options, of_scene)
    plan = plan_of(what, stored=baseline_file is not None)
    stored = None if baseline_file is None else side_of_baseline(baseline_file, plan, baseline, max_missing)
    decided = decide_into(
        plan, question, design, controls_of(control or (), plan, question, order, stored), out, quiet or as_json, stored,
        workers=workers, certificate=certify, report=report, wait=wait, limit_s=time_limit, executor=where, store=store,
    )  # fmt: skip
    if as_json:
        print(json.dumps({"out": str(decided.run.root), "exit_code": decided.outcome.exit_code, "decision": decided.record}))
    else:
        print_end(decided)
        print(report_line(decided.run.root))
    raise typer.Exit(decided.outcome.exit_code)
