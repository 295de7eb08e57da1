"""``simrun [run]``: drive scenarios behind renderers and tabulate the results."""

from __future__ import annotations

import json
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
from alpasim_plugin.core.escape import terminal
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.limits import SOURCE_BYTES
from alpasim_plugin.core.reading import read_bytes
from alpasim_plugin.core.signals import Stopped
from alpasim_plugin.log.run_folder.schema import OUTPUT_NAME
from alpasim_plugin.runs.certificate import certificate_line, foreseen
from alpasim_plugin.runs.execute import Threads, thread_budget
from alpasim_plugin.runs.plan import RunOptions, RunPlan, make_plan
from alpasim_plugin.runs.run import RunResult, default_folder, execute_run
from evaluators.statistics.arms import arms_of, base_named
from scenarios.suite import expand, shipped_names

TRACEBACK_LINES = 4  # of a failure, in the terminal

EPILOG = """
Examples:

- `simrun --renderer clean,3dgs --policy lane-camera --seeds 3 real/us101`

- `simrun --renderer 3dgs,onefixer --video all smoke/lead_car`

- `simrun --renderer 3dgs --policy pure-pursuit suites/smoke --out runs/smoke --video all`

- `simrun --renderer clean --policy log-replay ../data/av2/7fab2350`

- `simrun --renderer clean,3dgs --executor 'ray?cores=2' suites/urban`

- `simrun --renderer clean,3dgs --executor slurm:cpu --workers 64 --store s3://bucket/night suites/urban`
"""


def run(
    what: What,
    options: RunOptions,
    where: Where,
    care: Care,
    out: RunFolder = None,
    resume: Annotated[bool, Flag("Continue in a folder of another command.")] = False,
    retry: Annotated[
        bool, Flag("Drive again also rollouts that failed by the policy's own fault.")
    ] = False,
    dry_run: Annotated[bool, Flag("Resolve and print the plan, run nothing.")] = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Drive scenarios behind one or more renderers, score the drives, and write a run folder with a
    report.

    An interrupted run continues when the same command is given again.
    """
    how = where.arguments() | care.arguments()
    check_preset(options.preset)
    plan = planned(what, what.renderers, split_policies(what.policy), options)
    if options.baseline is not None:
        arms = arms_of(
            (renderer.name, policy.name) for policy in plan.policies for renderer in plan.renderers
        )
        base_named(options.baseline, arms, "the run")
    root = out or default_folder(plan)
    if dry_run:
        repeats = foreseen(plan, care.certify) is not None
        _print_plan(
            plan,
            root,
            thread_budget(where.workers, len(plan.cells), how["executor"], repeats),
            as_json,
        )
        return
    progress, command = make_progress(quiet or as_json), ["simrun", *sys.argv[1:]]
    try:
        result = execute_run(
            plan, root, command=command, progress=progress, resume=resume, retry=retry, **how
        )
    except Stopped as stop:
        stop.kept = f"finished rollouts are kept in {root}; the same command continues"
        raise
    _print_result(result, as_json, options.video)
    if plan.undigested and not as_json:
        print(
            f"not reused by the next command: {', '.join(plan.undigested)} has no digest (--resume reuses its rollouts)"
        )
    raise typer.Exit(result.exit_code)


def planned(
    what: What, renderers: Sequence[str], policies: Sequence[str], options: RunOptions
) -> RunPlan:
    """Plan what is asked for, with the settings of fixers among its overrides.

    Raises:
        InputError: A scenario, a part or a seed is invalid.
    """
    refs = [ref for item in what.scenarios for ref in expand(item, what.of_scene, what.source)]
    plan = make_plan(
        refs, renderers, policies, parse_seeds(what.seeds), replace(options, fixer=what.of_fixer)
    )
    return replace(plan, asked=what.scenarios)


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
    print(f"repeat   {certificate_line(result.summary['determinism'])}")
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
    cure = "simrun check-policy tests the policy; after a change of it the same command runs them again"
    return f"{said}, {whose} by the policy's own fault; {cure}"
