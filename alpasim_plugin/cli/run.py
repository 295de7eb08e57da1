"""``simrun [run]``: drive scenarios behind renderers and tabulate the results."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from alpasim_plugin.cli.executor_options import Cores, ExecutorText, Gpus, MemoryGib, StoreUrl
from alpasim_plugin.cli.progress import background_lines, fixer_labels, make_progress, varied_lines
from alpasim_plugin.cli.report import report_line
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.limits import SEED, SEEDS
from alpasim_plugin.process.signals import Stopped
from alpasim_plugin.run_folder.manifests import read_run_json
from alpasim_plugin.runtime.certificate import Certify, certificate_line
from alpasim_plugin.runtime.execute import Threads, thread_budget
from alpasim_plugin.runtime.executors.choice import parse_executor
from alpasim_plugin.runtime.plan import RunOptions, RunPlan, make_plan
from alpasim_plugin.runtime.run import RunResult, default_folder, execute_run
from evaluators import PRESETS
from evaluators.metrics import MetricTable
from evaluators.opening import read_run
from evaluators.report import ending_lines, fixer_lines, next_line, plan_warnings, render_table
from scenarios.library import shipped_names
from scenarios.suite import expand

FIXER_PREFIX = "fixer."

EPILOG = """
Examples:

- `simrun --renderer clean,3dgs --policy lane-camera --seeds 3 real/us101`

- `simrun --renderer 3dgs,onefixer --video all smoke/lead_car`

- `simrun --renderer 3dgs --policy pure-pursuit suites/smoke --out runs/smoke --video all`

- `simrun --renderer clean --policy log-replay ../data/av2/7fab2350`

- `simrun --renderer clean,3dgs --executor ray --cores 2 suites/urban`

- `simrun --renderer clean,3dgs --executor slurm:cpu --workers 64 --store s3://bucket/night suites/urban`
"""


def run(
    scenarios: Annotated[list[str], typer.Argument(help="Scenario or suite YAML, a folder of them, a shipped name, or a recorded log.")],
    renderer: Annotated[
        str, typer.Option("--renderer", help="Renderers, comma-separated: a name, `FIXER`, `FIXER+RENDERER`, or `package.module:Class`.")
    ] = "3dgs",
    policy: Annotated[
        str, typer.Option("--policy", help="Policies, comma-separated: a name, `package.module:Class`, `file.py:Class` or `exec:COMMAND`.")
    ] = "lane-camera",
    seeds: Annotated[str, typer.Option("--seeds", help="How many seeds (3 means 0,1,2), or a list such as 4,7.")] = "1",
    preset: Annotated[str, typer.Option("--preset", help="Evaluator preset.")] = "paper",
    out: Annotated[Path | None, typer.Option("--out", help="Run folder; by default one below runs/ named after the command.")] = None,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Worker processes; by default one per core.")] = None,
    executor: ExecutorText = "local",
    cores: Cores = None,
    gpus: Gpus = None,
    memory: MemoryGib = None,
    store: StoreUrl = None,
    video: Annotated[Literal["none", "failures", "all"], typer.Option("--video", help="Write front.mp4.")] = "none",
    images: Annotated[Literal["none", "jpeg", "png"], typer.Option("--images", help="Camera frames in rollout.asl.")] = "jpeg",
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="Override a scenario key, key=value, or with [RENDERER:]fixer. a fixer's. Repeatable.")
    ] = None,
    timeline: Annotated[
        Literal["scenario", "alpasim"],
        typer.Option("--timeline", help="alpasim: start at the first recorded frame and force 1.7 s, as AlpaSim does."),
    ] = "scenario",
    controller: Annotated[
        str | None, typer.Option("--controller", help="Controller that tracks the plans; by default the policy's.")
    ] = None,
    traffic: Annotated[
        str | None, typer.Option("--traffic", metavar="HOST:PORT", help="AlpaSim's traffic service moves the other road users.")
    ] = None,
    evaluators: Annotated[
        list[str] | None, typer.Option("--evaluator", help="A further evaluator, package.module:Class. Repeatable.")
    ] = None,
    source: Annotated[str | None, typer.Option("--source", help="Reader of the recorded log: a name, or package.module:Class.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue in a folder of another command.")] = False,
    baseline: Annotated[str | None, typer.Option("--baseline", help="Renderer to compare against; by default the first.")] = None,
    device: Annotated[Literal["cpu", "cuda"], typer.Option("--device", help="Where renderers compute.")] = "cpu",
    certify: Annotated[Certify, typer.Option("--certify", help="Repeat one rollout and compare bit for bit.")] = "one",
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write report.html now; `simrun report RUN` writes it later.")
    ] = True,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for a process that writes the run folder; otherwise refuse.")] = False,
    time_limit: Annotated[
        float | None, typer.Option("--time-limit", min=0.001, help="Seconds that a rollout may take; one that hangs is ended and reported.")
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Drive again also rollouts that failed by the policy's own fault.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Resolve and print the plan, run nothing.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, only the table.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Drive scenarios behind one or more renderers, score the drives, and write a run folder with a report.

    An interrupted run continues when the same command is given again.
    """
    del debug  # read from the command line by cli.main, before any option is parsed
    where = parse_executor(executor, cores, gpus, memory)
    names = [name.strip() for name in renderer.split(",") if name.strip()]
    drivers = split_policies(policy)
    check_preset(preset)
    if baseline is not None and baseline not in names:
        raise InputError("choosing a baseline", f"--baseline {baseline}", f"the run has renderers {names}", "name one of them")
    of_scene, of_fixer = split_overrides(overrides or ())
    if timeline != "scenario":
        of_scene = (*of_scene, f"timing.timeline={timeline}")
    refs = [ref for item in scenarios for ref in expand(item, of_scene, source)]
    options = RunOptions(preset, images, video, device, baseline, of_fixer, controller, tuple(evaluators or ()), traffic)
    plan = replace(make_plan(refs, names, drivers, parse_seeds(seeds), options), asked=tuple(scenarios))
    root = out or default_folder(plan)
    if dry_run:
        _print_plan(plan, root, thread_budget(workers, len(plan.cells), where), as_json)
        return
    progress, command = make_progress(quiet or as_json), ["simrun", *sys.argv[1:]]
    try:
        result = execute_run(
            plan,
            root,
            workers,
            command,
            progress,
            resume,
            certify,
            report,
            wait=wait,
            limit_s=time_limit,
            retry=retry,
            executor=where,
            store=store,
        )
    except Stopped as stop:
        stop.kept = f"finished rollouts are kept in {root}; the same command continues"
        raise
    _print_result(result, as_json, video)
    if plan.undigested and not as_json:
        print(f"not reused by the next command: {', '.join(plan.undigested)} has no digest (--resume reuses its rollouts)")
    raise typer.Exit(result.exit_code)


def split_policies(text: str) -> list[str]:
    """Split ``--policy`` at its commas, but not at those in the quotes of a command.

    Example:
        >>> split_policies("lane-camera, exec:python drive.py --size '576,320'")
        ['lane-camera', "exec:python drive.py --size '576,320'"]
    """
    parts = re.findall(r"""(?:'[^']*'|"[^"]*"|[^,])+""", text)
    return [part.strip() for part in parts if part.strip()]


def split_overrides(overrides: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Separate the overrides of scenarios from those of fixers: ``fixer.KEY=VALUE``, or ``RENDERER:fixer.KEY=VALUE`` for one of them.

    Example:
        >>> split_overrides(["timing.warmup_us=400000", "fixer.mode=chunk", "difix:fixer.weights.bundle=d.safetensors"])
        (('timing.warmup_us=400000',), ('mode=chunk', 'difix:weights.bundle=d.safetensors'))
    """
    of_scene, of_fixer = [], []
    for text in overrides:
        key, equals, value = text.partition("=")
        renderer, fixer, rest = key.rpartition(FIXER_PREFIX)
        if fixer and (not renderer or renderer.endswith(":")):
            of_fixer.append(renderer + rest + equals + value)
        else:
            of_scene.append(text)
    return tuple(of_scene), tuple(of_fixer)


def parse_seeds(text: str) -> list[int]:
    """Parse ``--seeds``.

    Example:
        >>> parse_seeds("3"), parse_seeds("4,7")
        ([0, 1, 2], [4, 7])

    Raises:
        InputError: Not a positive count nor a list of non-negative integers of 63 bits.
    """
    try:
        values = [int(part) for part in text.split(",") if part.strip()]
    except ValueError:
        values = []
    if "," not in text and len(values) == 1 and values[0] > 0:
        SEEDS.check(values[0], "reading --seeds", f"--seeds {text}")
        return list(range(values[0]))
    if "," in text and values and all(SEED.holds(value) for value in values):
        SEEDS.check(len(values), "reading --seeds", "--seeds")
        return values
    found = "neither a count from 1 up nor a list of seeds from 0 to 2^63 - 1"
    raise InputError("reading --seeds", f"--seeds {text}", found, "write a count such as 3, or a list such as 4,7")


def check_preset(preset: str) -> None:
    """Refuse a preset that is not there.

    Raises:
        InputError: It is unknown.
    """
    if preset not in PRESETS:
        raise InputError("choosing a preset", f"--preset {preset}", "no such preset", f"known: {', '.join(PRESETS)}")


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
        "varied": {name: {key: list(pair) for key, pair in s.varied.items()} for name, s in plan.scenarios.items() if s.varied},
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
        print(f"{key:>18}  {(', '.join(map(str, value)) or '-') if isinstance(value, list) else value}")


def _print_result(result: RunResult, as_json: bool, video: str) -> None:
    if as_json:
        print(json.dumps({"out": str(result.root), "exit_code": result.exit_code, "summary": result.summary}))
        return
    Console().print(render_table(result.summary, headline_only=True, known=MetricTable.of_run(read_run_json(result.root))))
    for line in fixer_lines(result.summary):
        print(line)
    for line in plan_warnings(result.summary):
        print(f"warning  {line}")
    for cell in result.summary["failures"]["cells"][:5]:
        print(f"failed: {cell['path']}: {cell['error']['found']} -> {cell['error']['do']}", file=sys.stderr)
    if result.n_failed:
        print(_failed_line(result), file=sys.stderr)
    videos = len(list(result.root.glob("rollouts/*/*/*/*/front.mp4"))) if video != "none" else 0
    if video != "none":
        print(f"videos   {videos} of {result.n_rollouts} rollouts have a front.mp4 below {result.root}/rollouts")
    print(f"repeat   {certificate_line(result.summary['determinism'])}")
    run = read_run(result.root)
    for line in ending_lines(run):
        print(line)
    print(report_line(result.root))
    print(_by_name(next_line(run)))


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
