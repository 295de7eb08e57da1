"""``simrun [run]``: drive scenarios behind renderers and tabulate the results."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.cli.options import (
    Care,
    Json,
    Quiet,
    RunFolder,
    What,
    Where,
    check_preset,
    parse_seeds,
    split_policies,
)
from alpasim_plugin.cli.progress import (
    background_lines,
    fixer_labels,
    make_progress,
    report_line,
    varied_lines,
)
from alpasim_plugin.cli.signals import Stopped
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import terminal
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.limits import SOURCE_BYTES
from alpasim_plugin.core.reading import read_bytes
from alpasim_plugin.log.run_folder.schema import OUTPUT_NAME
from alpasim_plugin.runs.decide import Decided, execute_decision, plan_of_two
from alpasim_plugin.runs.execute import Threads, thread_budget
from alpasim_plugin.runs.plan import RunOptions, RunPlan, make_plan
from alpasim_plugin.runs.repeat import repeat_line
from alpasim_plugin.runs.run import RunResult, default_folder, execute_run
from evaluators.report.decision import decision_lines
from evaluators.statistics.decision import Question, metric_question
from evaluators.statistics.gate import load_gate
from evaluators.statistics.variants import base_named, variants_of
from scenarios.suite import ScenarioRef, expand, shipped_names

TRACEBACK_LINES = 4  # of a failure, in the terminal

EPILOG = """
Examples:

- `simrun --renderer clean,3dgs --policy lane-camera --seeds 3 real/us101`

- `simrun --renderer 3dgs,onefixer --video all smoke/lead_car`

- `simrun --renderer 3dgs --policy pure-pursuit suites/smoke --out runs/smoke --video all`

- `simrun --renderer clean --policy log-replay ../data/av2/7fab2350`

- `simrun --renderer clean,3dgs --executor 'ray?cores=2' suites/urban`

- `simrun --renderer clean,3dgs --until-decided suites/urban`: stop as soon as it is decided whether 3dgs is worse than clean
"""


def run(
    what: What,
    options: RunOptions,
    where: Where,
    care: Care,
    out: RunFolder = None,
    shard: Annotated[
        str | None, Flag("Drive only this part of the scenes, for job arrays.", metavar="I/N")
    ] = None,
    resume: Annotated[bool, Flag("Continue in a folder that another command has written.")] = False,
    until_decided: Annotated[
        bool,
        Flag("Sequential test: drive scenes in random order and stop as soon as it is decided."),
    ] = False,
    metric: Annotated[
        tuple[str, ...],
        Flag(
            "With --until-decided: test this metric instead of the default gate's. Repeatable.",
            metavar="NAME[=MARGIN]",
        ),
    ] = (),
    repeat: Annotated[
        bool, Flag("Drive one rollout twice and say whether the policy is repeatable.")
    ] = False,
    dry_run: Annotated[bool, Flag("Resolve and print the plan, run nothing.")] = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Drive scenarios behind one or more renderers, score the rollouts and write a report.

    An interrupted run continues when the same command is given again.
    """
    how = where.arguments() | care.arguments()
    check_preset(options.preset)
    refs = [ref for item in what.scenarios for ref in expand(item, what.of_scene, what.source)]
    if shard is not None:
        refs = shard_of(refs, shard)
    plan = make_plan(
        refs,
        what.renderers,
        split_policies(what.policy),
        parse_seeds(what.seeds),
        replace(options, fixer=what.of_fixer),
    )
    plan = replace(plan, asked=what.scenarios)
    if options.baseline is not None:
        variants = variants_of((cell.renderer.name, cell.policy.name) for cell in plan.cells)
        base_named(options.baseline, variants, "the run")
    question = None
    if until_decided:
        question = question_of(metric)
        plan = plan_of_two(plan, question)
    elif metric:
        raise InputError("--metric: without --until-decided", "Add --until-decided.")
    root = out or default_folder(plan)
    if dry_run:
        threads = thread_budget(where.workers, len(plan.cells), how["executor"])
        _print_plan(plan, root, threads, as_json)
        return
    progress = make_progress(quiet or as_json)
    command = ["simrun", *sys.argv[1:]]
    try:
        if question is not None:
            decided = execute_decision(
                plan, question, root, command=command, progress=progress, **how
            )
            _print_decision(decided, as_json)
            raise typer.Exit(decided.outcome.exit_code)
        result = execute_run(
            plan, root, command=command, progress=progress, resume=resume, repeat=repeat, **how
        )
    except Stopped as stop:
        stop.kept = f"finished rollouts are kept in {root}; the same command continues"
        raise
    _print_result(result, as_json, options.video)
    if plan.undigested and not as_json:
        names = ", ".join(plan.undigested)
        print(
            f"not reused by the next command: {names} has no digest (--resume reuses its rollouts)"
        )
    raise typer.Exit(result.exit_code)


def shard_of(refs: Sequence[ScenarioRef], shard: str) -> list[ScenarioRef]:
    """Return every N-th scene, from the I-th on, for a shard ``I/N``.

    Raises:
        InputError: ``shard`` is not I/N with 1 <= I <= N, or there are fewer than I scenes.
    """
    match = re.fullmatch(r"([0-9]+)/([0-9]+)", shard)
    number, count = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= count:
        raise InputError(f"--shard {shard}: not I/N with 1 <= I <= N", "Write for example 3/16.")
    if number > len(refs):
        raise InputError(
            f"--shard {shard}: there are only {len(refs)} scenes", "Use at most as many shards."
        )
    return list(refs[number - 1 :: count])


def question_of(metrics: Sequence[str]) -> Question:
    """Return the question of ``--until-decided``: is the other variant non-inferior in the metrics of
    ``--metric NAME[=MARGIN]``, or within the margins of the default gate?

    Raises:
        InputError: A margin is no number, or a metric is named twice.
    """
    if not metrics:
        spec, _ = load_gate("default")
        asked = tuple(
            metric_question(name, rule.margin, rule.must_decide)
            for name, rule in spec.metrics.items()
            if rule.margin is not None
        )
        return Question(asked, min_scenes=spec.min_scenes)
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


def _print_decision(decided: Decided, as_json: bool) -> None:
    if as_json:
        facts = {
            "out": str(decided.run.root),
            "exit_code": decided.outcome.exit_code,
            "decision": decided.record,
        }
        print(json.dumps(facts))
        return
    for line in decision_lines(decided.record):
        print(line)
    print(report_line(decided.run.root))


def _print_plan(plan: RunPlan, root: Path, threads: Threads, as_json: bool) -> None:
    frames = sum((s.end_us - s.start_us) // s.rates.camera_us for s in plan.scenarios.values())
    per_cell = len(plan.renderers) * len(plan.policies) * len(plan.seeds)
    facts = {
        "out": str(root),
        "key": plan.command_key,
        "rollouts": len(plan.cells),
        "scenes": list(plan.scenarios),
        "renderers": [spec.name for spec in plan.renderers],
        "fixers": fixer_labels(plan),
        "policies": [spec.name for spec in plan.policies],
        "seeds": list(plan.seeds),
        "varied": {
            name: {key: list(pair) for key, pair in s.varied.items()}
            for name, s in plan.scenarios.items()
            if s.varied
        },
        "never_reused": list(plan.undigested),
        "camera_frames": int(frames * per_cell),
        "workers": threads.workers,
        "threads_per_worker": threads.per_worker,
    }
    if as_json:
        print(json.dumps(facts))
        return
    facts["varied"], facts["backgrounds"] = varied_lines(plan), background_lines(plan)
    for key, value in facts.items():
        print(
            f"{key:>18}  {(', '.join(map(str, value)) or '-') if isinstance(value, list) else value}"
        )


def _print_result(result: RunResult, as_json: bool, video: str) -> None:
    if as_json:
        print(
            json.dumps(
                {"out": str(result.root), "exit_code": result.exit_code, "summary": result.summary}
            )
        )
        return
    from evaluators.opening import read_run  # what a run ends with is loaded while it is driven
    from evaluators.report import ending_lines, fixer_lines, next_line, plan_warnings, render_table

    run = read_run(result.root)
    Console().print(render_table(result.summary, headline_only=True, known=run.table))
    for line in fixer_lines(result.summary):
        print(line)
    for line in plan_warnings(result.summary):
        print(f"warning  {line}")
    for cell in result.summary["failures"]["cells"][:5]:
        print(
            f"failed: {cell['path']}: {cell['error']['message']} -> {cell['error']['hint']}",
            file=sys.stderr,
        )
        for line in last_lines(result.root / cell["path"] / OUTPUT_NAME):
            print(f"        {line}", file=sys.stderr)
    if result.n_failed:
        print(_failed_line(result), file=sys.stderr)
    videos = len(list(result.root.glob("rollouts/*/*/*/*/front.mp4"))) if video != "none" else 0
    if video != "none":
        print(
            f"videos   {videos} of {result.n_rollouts} rollouts have a front.mp4 below {result.root}/rollouts"
        )
    if "repeat" in result.summary:
        print(f"repeat   {repeat_line(result.summary['repeat'])}")
    for line in ending_lines(run):
        print(line)
    print(report_line(result.root))
    print(_by_name(next_line(run)))


def last_lines(log: Path) -> list[str]:
    """Return the end of the traceback in a rollout's log, and the log's name; nothing where there
    is no log.
    """
    if not log.is_file():
        return []
    text = read_bytes(log, SOURCE_BYTES).decode("utf-8", "replace")
    return [terminal(line.rstrip()) for line in text.rstrip().splitlines()[-TRACEBACK_LINES:]] + [
        f"log {log}"
    ]


def _by_name(line: str) -> str:
    """Write the paths of shipped scenarios as their names."""
    for name, path in shipped_names().items():
        line = line.replace(str(path.absolute()), name)
    return line


def _failed_line(result: RunResult) -> str:
    """Say how many rollouts failed, and whether the same command would try them again."""
    said = f"{result.n_failed} of {result.n_rollouts} rollouts failed"
    by_policy = result.summary["failures"]["by_class"].get("policy", 0)
    if not by_policy:
        return f"{said}; the same command runs them again"
    whose = "all" if by_policy == result.n_failed else f"{by_policy} of them"
    cure = "simrun check policy tests the policy; after a change of it the same command runs them again"
    return f"{said}, {whose} by the policy's own fault; {cure}"
