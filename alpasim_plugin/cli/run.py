"""``simrun [run]``: drive scenarios behind renderers and tabulate the results."""

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.cli.options import (
    Json,
    parse_seeds,
    split_overrides,
    split_policies,
)
from alpasim_plugin.cli.output import (
    Progress,
    background_lines,
    first_screen,
    fixer_labels,
    report_lines,
    show,
    size_lines,
    varied_lines,
    warn,
)
from alpasim_plugin.cli.settings import load_settings
from alpasim_plugin.core.errors import InputError, Stopped
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.parts import split_names
from alpasim_plugin.core.subprocesses import parts_print_to_stderr
from alpasim_plugin.log.run_folder.reader import last_output
from alpasim_plugin.log.run_folder.schema import LOCK, OUTPUT_NAME
from alpasim_plugin.runs.decide import SequentialTest, plan_of_two
from alpasim_plugin.runs.execute import Threads, thread_budget
from alpasim_plugin.runs.executor_choice import Executor, parse_executor
from alpasim_plugin.runs.plan import RunOptions, RunPlan, as_driven, make_plan
from alpasim_plugin.runs.policy_checks import frames_asked
from alpasim_plugin.runs.repeat import repeat_line
from alpasim_plugin.runs.run import RunResult, default_folder, execute_run, execute_search
from alpasim_plugin.runs.shards import shard_of
from alpasim_plugin.runs.vary import BoundarySearch, Sweep, parse_sweeps
from evaluators import preset as find_preset
from evaluators.metrics.presets import DEFAULT
from evaluators.pages.decision import decision_lines
from evaluators.results import FailedRollout, to_json
from evaluators.statistics.decision import Question, metric_question
from evaluators.statistics.gate import load_gate
from evaluators.statistics.numbers import plural
from evaluators.statistics.opening import read_run
from evaluators.statistics.variants import base_named, variants_of
from scenarios.suite import ScenarioRef, expand

SHOWN_FAILURES = 5
MOMENT_S = 2.0  # what takes longer is said
Planner = Callable[..., RunPlan]  # of scenes; `report` as `make_plan` has it

EPILOG = """
Examples:

- `simrun --renderer clean,3dgs --policy lane-camera --seeds 3 real/us101`

- `simrun --renderer 3dgs,onefixer --video all smoke/lead_car`

- `simrun --renderer 3dgs --policy pure-pursuit suites/smoke --out runs/smoke --video all`

- `simrun --renderer clean --policy log-replay ../data/av2/7fab2350`

- `simrun --renderer clean,3dgs --executor 'ray?cores=2' suites/urban`

- `simrun --renderer clean,3dgs --until-decided --metric offroad=0.1 suites/all`: stop as soon as it is decided whether 3dgs is worse than clean

- `simrun --renderer clean --policy pure-pursuit --vary actors.cutter.s_m=4..40 hard/cut_in`: from which gap on it does not collide
"""


@dataclass(frozen=True)
class Rollouts:
    """Which rollouts are driven, beside the scenarios."""

    renderer: Annotated[
        str,
        Flag(
            "Renderers, comma-separated: a name, `FIXER`, `FIXER+RENDERER`, or `package.module:Class`.",
            names="renderer",
        ),
    ] = "3dgs"
    policy: Annotated[
        str,
        Flag(
            "Policies, comma-separated: a name, `package.module:Class`, `file.py:Class` or `exec:COMMAND`.",
            names="policy",
        ),
    ] = "lane-camera"
    seeds: Annotated[str, Flag("How many seeds (3 means 0,1,2), or a list such as 4,7.")] = "1"
    overrides: Annotated[
        tuple[str, ...],
        Flag(
            "Override a key of the scenarios, key=value, or of a fixer, [RENDERER:]fixer.key=value. Repeatable.",
            "--set",
        ),
    ] = ()
    settings: Annotated[
        str | None,
        Flag(
            "Shipped settings, or a file of them: keys that stand before --set, with preset and workers.",
            metavar="NAME|FILE",
        ),
    ] = None
    preset: Annotated[
        str | None,
        Flag(f"Evaluator preset; default: of the settings, else {DEFAULT}.", names="preset"),
    ] = None
    start: Annotated[
        str | None, Flag("Start of the route on a map, ROAD:S; by default drawn.", "--from")
    ] = None
    goal: Annotated[str | None, Flag("End of the route, ROAD:S.", "--to")] = None
    via: Annotated[
        tuple[str, ...],
        Flag(
            "Place that the route passes, ROAD:S. Repeatable, in driving order.", metavar="ROAD:S"
        ),
    ] = ()
    route_length: Annotated[
        float | None,
        Flag("Length of a route whose end is drawn, metres; default: 200.", min=20, max=5000),
    ] = None
    source: Annotated[
        str | None,
        Flag("Reader of the recorded log: a name, or package.module:Class.", names="source"),
    ] = None
    shard: Annotated[str | None, Flag("Drive this part of the scenes alone.", metavar="I/N")] = None

    def overrides_of(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the settings ``KEY=VALUE`` of the scenarios, the ends of the route among them, and
        those of the fixers: first those of a settings file.
        """
        ends = {"from": self.start, "to": self.goal, "length_m": self.route_length}
        route = [f"map.route.{key}={value}" for key, value in ends.items() if value is not None]
        if self.via:
            route.append(f"map.route.via={json.dumps(list(self.via))}")
        return split_overrides((*load_settings(self.settings).overrides, *self.overrides, *route))

    def scenes(self, scenarios: Sequence[str]) -> list[ScenarioRef]:
        """Return the scenes of the scenarios that the command names, or of its shard of them."""
        of_scene, _ = self.overrides_of()
        refs = _scenes(scenarios, of_scene, self.source)
        return refs if self.shard is None else shard_of(refs, self.shard)

    def planner(self, options: RunOptions) -> Planner:
        """Return the function that plans these rollouts of some scenes."""
        _, of_fixer = self.overrides_of()
        return partial(
            make_plan,
            renderers=split_names(self.renderer),
            policies=split_policies(self.policy),
            seeds=parse_seeds(self.seeds),
            options=replace(options, fixer=of_fixer),
        )


@dataclass(frozen=True)
class Execution:
    """Where and how the rollouts are driven; the results do not depend on it."""

    workers: Annotated[
        int | None,
        Flag("Worker processes; default: one per core.", also="-j", min=1),
    ] = None
    executor: Annotated[
        str,
        Flag("`local`, or `ray[:HOST:PORT]` with what a worker needs: `ray?cores=2&memory=8`."),
    ] = "local"
    report: Annotated[
        bool,
        Flag("Write report.html; `simrun report` writes it later.", "--report/--no-report"),
    ] = True
    time_limit: Annotated[
        float | None,
        Flag("Seconds after which a rollout is ended and reported.", min=0.001, max=2_592_000),
    ] = None
    out: Annotated[Path | None, Flag("Run folder; default: below runs/.")] = None
    resume: Annotated[
        bool, Flag("Continue in a folder that another command has written.", "--resume")
    ] = False
    repeat: Annotated[
        bool,
        Flag("Drive a rollout of each policy twice and compare.", "--repeat"),
    ] = False


@dataclass(frozen=True)
class SearchOptions:
    """What is searched for, where the rollouts are not all driven."""

    until_decided: Annotated[
        bool,
        Flag(
            "Sequential test: stop as soon as the comparison is decided.",
            "--until-decided",
        ),
    ] = False
    metric: Annotated[
        tuple[str, ...],
        Flag(
            "With --until-decided: NAME=MARGIN instead of the default gate's. Repeatable.",
            metavar="NAME[=MARGIN]",
        ),
    ] = ()
    vary: Annotated[
        tuple[str, ...],
        Flag(
            "Find where each variant fails along a key, or two, at points STEP apart. Repeatable.",
            metavar="KEY=LOW..HIGH[/STEP]",
        ),
    ] = ()

    def sweeps(self, n_scenes: int, execution: Execution) -> tuple[Sweep, ...]:
        """Return the keys that are varied.

        Raises:
            InputError: A key is varied beside what excludes it, or its range cannot be read.
        """
        sweeps = parse_sweeps(self.vary)
        excluded = self.until_decided or execution.repeat or execution.resume
        if sweeps and (n_scenes != 1 or excluded):
            raise InputError(
                f"--vary {self.vary[0]}: takes one scene, and no --until-decided, --repeat or --resume",
                "Name one scene and leave these options out.",
            )
        return sweeps

    def over(
        self, plan: RunPlan, sweeps: tuple[Sweep, ...], planned: Planner
    ) -> SequentialTest | BoundarySearch | None:
        """Return the search over a plan; None where all of it is driven.

        Raises:
            InputError: ``--metric`` stands without ``--until-decided``, or the plan cannot answer
                the question.
        """
        if self.metric and not self.until_decided:
            raise InputError("--metric: without --until-decided", "Add --until-decided.")
        if self.until_decided:
            question = question_of(self.metric)
            return SequentialTest(plan_of_two(plan, question), question)
        return BoundarySearch(plan, sweeps, planned) if sweeps else None


def run(
    scenarios: Annotated[
        tuple[str, ...],
        Positional(
            "Scenario, suite, folder of them, shipped name, or recorded log.",
            metavar="SCENARIO...",
            names="scenario",
        ),
    ],
    options: RunOptions,
    rollouts: Rollouts,
    execution: Execution,
    search_options: SearchOptions,
    dry_run: Annotated[bool, Flag("Print the plan and run nothing.", "--dry-run")] = False,
    as_json: Json = False,
    quiet: Annotated[bool, Flag("Print only the result.", "--quiet", also="-q")] = False,
) -> None:
    """Drive scenarios behind renderers, score the rollouts and write a report.

    An interrupted run continues when the same command is given again.
    """
    executor = parse_executor(execution.executor)
    settings = load_settings(rollouts.settings)
    options = replace(options, preset=rollouts.preset or settings.preset or DEFAULT)
    execution = replace(execution, workers=execution.workers or settings.workers)
    find_preset(options.preset)
    refs = rollouts.scenes(scenarios)
    planned = rollouts.planner(options)
    sweeps = search_options.sweeps(len(refs), execution)
    with Progress(quiet or as_json) as progress:
        plan = planned(refs, report=partial(_show_reading, progress, time.monotonic()))
    plan = replace(plan, scenario_names=scenarios, shard=rollouts.shard)
    if options.baseline is not None:
        variants = variants_of((cell.renderer.name, cell.policy.name) for cell in plan.cells)
        base_named(options.baseline, variants, "the run")
    search = search_options.over(plan, sweeps, planned)
    if search is not None:
        plan = search.ceiling
    root = execution.out or default_folder(plan)
    if dry_run:
        with suppress(FileNotFoundError):
            os.lstat(root / LOCK)  # raises where no such folder can be
        threads = thread_budget(execution.workers, len(plan.cells), executor)
        _print_plan(plan, root, threads, as_json)
        return
    with Progress(quiet or as_json) as progress:
        result = _drive(plan, search, root, execution, executor, progress)
    if isinstance(search, SequentialTest):
        _print_decision(search, root, as_json)
        raise typer.Exit(search.outcome.exit_code)
    _print_result(result, plan, as_json)
    raise typer.Exit(result.exit_code)


def _show_reading(progress: Progress, began_s: float, done: int, total: int) -> None:
    """Show how many scenes are read, where that takes longer than a moment."""
    if time.monotonic() - began_s > MOMENT_S:
        progress.show("reading scenes", done, total)


def _drive(
    plan: RunPlan,
    search: SequentialTest | BoundarySearch | None,
    root: Path,
    execution: Execution,
    executor: Executor,
    progress: Progress,
) -> RunResult:
    """Drive a whole plan, or the rounds of a search in it, into the run folder ``root``.

    Raises:
        Stopped: The user stopped the run; it says that the same command continues.
    """
    drive = (
        partial(execute_run, plan, resume=execution.resume, repeat=execution.repeat)
        if search is None
        else partial(execute_search, search)
    )
    try:
        return drive(
            root=root,
            workers=execution.workers,
            command=["simrun", *sys.argv[1:]],
            progress=progress,
            report=execution.report,
            limit_s=execution.time_limit,
            executor=executor,
        )
    except Stopped as stop:
        stop.kept = f"finished rollouts are kept in {root}; the same command continues"
        raise


def _scenes(
    scenarios: Sequence[str], overrides: Sequence[str], source: str | None
) -> list[ScenarioRef]:
    """Return the scenes that a command names, each once.

    A scene that two suites list is made one here, before shards are cut: otherwise two shards would
    drive it.

    Args:
        scenarios: Scenarios, suites, folders, shipped names or recorded logs.
        overrides: ``KEY=VALUE`` of the scenarios.
        source: Reader of recorded logs.

    Raises:
        InputError: Two names stand for the same scenes.
    """
    name_by_refs: dict[tuple[ScenarioRef, ...], str] = {}
    for name in scenarios:
        refs = tuple(expand(name, overrides, source))
        if refs in name_by_refs:
            raise InputError(
                f"scenarios {name_by_refs[refs]} and {name}: they are the same",
                "Name every scenario once.",
            )
        name_by_refs[refs] = name
    return distinct(chain.from_iterable(name_by_refs))


def distinct(refs: Iterable[ScenarioRef]) -> list[ScenarioRef]:
    """Return scenes without those that stand there before, whatever path leads to their file."""
    scenes: dict[ScenarioRef, ScenarioRef] = {}
    for ref in refs:
        scenes.setdefault(replace(ref, path=os.path.realpath(ref.path)), ref)
    return [*scenes.values()]


def question_of(metrics: Sequence[str]) -> Question:
    """Return the question of ``--until-decided``: is the other variant non-inferior in the metrics of
    ``--metric NAME[=MARGIN]``, or within the margins of the default gate?

    Raises:
        InputError: A margin is no number, or a metric is named twice.
    """
    if not metrics:
        spec, _ = load_gate("default")
        criteria = tuple(
            metric_question(name, rule.margin, rule.must_decide)
            for name, rule in spec.metrics.items()
            if rule.margin is not None
        )
        return Question(criteria)
    questions = {}
    for text in metrics:
        name, _, margin = text.partition("=")
        try:
            value = float(margin) if margin else None
        except ValueError:
            raise InputError(
                f"--metric {text}: the margin is not a number", "Write for example progress=0.05."
            ) from None
        if name in questions:
            raise InputError(f"--metric {name}: named twice", "Name every metric once.")
        questions[name] = metric_question(name, value)
    return Question(tuple(questions.values()))


def _print_decision(test: SequentialTest, root: Path, as_json: bool) -> None:
    record = test.record()
    facts = {"out": str(root), "exit_code": test.outcome.exit_code, "decision": record}
    lines = [] if as_json else first_screen(read_run(root))
    show(as_json, facts, *decision_lines(record), "", *lines, "", *report_lines(root))


def _print_plan(plan: RunPlan, root: Path, threads: Threads, as_json: bool) -> None:
    with parts_print_to_stderr():
        scenarios = [as_driven(s, plan.options.preset) for s in plan.scenarios.values()]
        frame_counts = [frames_asked(policy, scenarios) for policy in plan.policies]
    facts = {
        "out": str(root),
        "key": plan.command_key,
        "rollouts": len(plan.cells),
        "scenes": list(plan.scenarios),
        "renderers": [spec.name for spec in plan.renderers],
        "fixers": fixer_labels(plan),
        "policies": [spec.name for spec in plan.policies],
        "seeds": list(plan.seeds),
        "varied": {name: s.varied for name, s in plan.scenarios.items() if s.varied},
        "never_reused": list(plan.undigested),
        "large_cameras": size_lines(plan),
        "camera_frames": sum(frame_counts) * len(plan.renderers) * len(plan.seeds),
        "workers": threads.workers,
        "threads_per_worker": threads.per_worker,
    }
    text_facts = facts | {"varied": varied_lines(plan), "backgrounds": background_lines(plan)}
    lines = []
    for key, value in text_facts.items():
        text = ", ".join(map(str, value)) or "-" if isinstance(value, list) else value
        lines.append(f"{key:>18}  {text}")
    show(as_json, facts, *lines)


def _print_result(result: RunResult, plan: RunPlan, as_json: bool) -> None:
    """Print the table of a run, what failed and what ``--resume`` would not see; or the JSON
    document.
    """
    from evaluators.pages.terminal import next_line

    root = result.root
    if as_json:
        summary = to_json(result.summary)
        show(True, {"out": str(root), "exit_code": result.exit_code, "summary": summary})
        return
    run = read_run(root)
    lines = []
    if result.summary.repeat is not None:
        lines.append(f"repeat   {repeat_line(result.summary.repeat)}")
    show(False, {}, *first_screen(run), "", *lines, *report_lines(root), next_line(run))
    failures: dict[str, list[FailedRollout]] = {}
    for cell in result.summary.failures.cells:
        failures.setdefault(cell.error.message, []).append(cell)
    for message, cells in list(failures.items())[:SHOWN_FAILURES]:
        warn(f"failed in {plural(len(cells), 'rollout')}: {message} -> {cells[0].error.hint}")
        for line in last_output(root / cells[0].path / OUTPUT_NAME):
            warn(f"        {line}")
    if result.n_failed:
        by_policy = result.summary.failures.by_class.get("policy", 0)
        advice = "the same command runs them again"
        if by_policy:
            advice = f"{by_policy} by the policy's own fault: simrun check policy tests it"
        warn(f"{result.n_failed} of {plural(result.n_rollouts, 'rollout')} failed; {advice}")
    if plan.undigested:
        names = ", ".join(plan.undigested)
        warn(f"--resume reuses the rollouts of {names}; the same command drives them again.")
