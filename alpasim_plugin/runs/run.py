"""A whole run: execute, tabulate, report. The same command continues an interrupted run."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import ClassVar, Protocol

from alpasim_plugin import __version__
from alpasim_plugin.alpasim.client.child import end_children
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import real, some_of
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.log.run_folder.check import cells_of_run, inspect_files
from alpasim_plugin.log.run_folder.checksums import state_files
from alpasim_plugin.log.run_folder.manifests import read_run_json, write_run_json
from alpasim_plugin.log.run_folder.reader import REMADE
from alpasim_plugin.log.run_folder.records import (
    Manifest,
    RunConfig,
    RunCounts,
    RunInfo,
    SceneFacts,
    SceneRef,
)
from alpasim_plugin.log.run_folder.schema import (
    DECISION,
    FILES,
    LOCK,
    REPORTS,
    ROLLOUTS_FOLDER,
    RUN_INFO,
    SCENES,
    STAGES,
    TABLES,
    slug,
)
from alpasim_plugin.log.run_folder.writer import unfinish, write_scene, writing
from alpasim_plugin.renderers.reconstruction_key import model_key
from alpasim_plugin.runs.cell import users_parts
from alpasim_plugin.runs.changes import rewritten_files
from alpasim_plugin.runs.execute import HowToRun, Threads, execute, thread_budget
from alpasim_plugin.runs.executor_choice import LOCAL, Executor
from alpasim_plugin.runs.local_executor import prepare_workers
from alpasim_plugin.runs.plan import RunPlan, as_driven
from alpasim_plugin.runs.policy_checks import check_policies, hanging
from alpasim_plugin.runs.provenance import hardware, part_facts, project, versions
from alpasim_plugin.runs.repeat import repeat_rollout
from alpasim_plugin.runs.same_poses import store_same_poses
from alpasim_plugin.runs.summary import pool_of, write_summary
from evaluators.metrics import table_of
from evaluators.results import Outcome, Summary
from evaluators.statistics.decision import State
from evaluators.statistics.verdicts import outcome_of_failures
from scenarios.suite import ScenarioRef

OF_A_RUN = {LOCK, ROLLOUTS_FOLDER, SCENES, STAGES, FILES, DECISION, *TABLES, *REPORTS}
SHORT_KEY = 4  # letters in the name of a run folder


class Progress(Protocol):
    """Shows a run to a person or a log file."""

    def started(self, plan: RunPlan, root: Path, threads: Threads) -> None:
        """Announce the run."""
        ...

    def rollout_done(self, manifest: Manifest, reused: bool) -> None:
        """Announce one rollout."""
        ...

    def noticed(self, text: str) -> None:
        """Say in one line what was found damaged and what is done about it, or who is waited
        for.
        """
        ...

    def looked(self, state: State, rollouts: int, ceiling: int) -> None:
        """Announce an interim analysis of a sequential test."""
        ...


class Search(Protocol):
    """Drives rollouts in rounds: the next follows from the outcomes so far alone, so the same
    command continues after any interruption.

    Attributes:
        kind: Of ``run.json``.
        plan: Holds the key of the command.
        ceiling: The plan with as many rollouts as are driven at most.
        at_once: Rollouts of a round, about.
        driven: Manifests by the rollout's folder.
    """

    kind: ClassVar[str]
    plan: RunPlan
    ceiling: RunPlan
    at_once: int
    driven: dict[str, Manifest]

    def next_plan(self) -> RunPlan | None:
        """Return the rollouts of the next round; None where the search has ended."""
        ...

    def add(self, plan: RunPlan, manifests: Sequence[Manifest]) -> None:
        """Take in the outcomes of a round."""
        ...

    def announce(self, root: Path, progress: Progress) -> None:
        """Say and store what follows from the rounds so far."""
        ...

    def driven_plan(self) -> RunPlan:
        """Return the plan of what was driven, in the order of the tables."""
        ...

    def stated_in(self, info: RunInfo) -> RunInfo:
        """Return ``run.json`` with what it and the summary hold of the search."""
        ...


@dataclass(frozen=True)
class RunResult:
    """Result of a run."""

    root: Path
    summary: Summary
    n_rollouts: int
    n_failed: int

    @property
    def outcome(self) -> Outcome:
        """Give the outcome: failures of rollouts and of their scoring. Gates add criteria to it."""
        return outcome_of_failures(self.summary.failures)

    @property
    def exit_code(self) -> int:
        """Give the process exit code that docs/cli.md lists."""
        return self.outcome.exit_code


def on_done(progress: Progress) -> Callable[[Manifest, bool], None]:
    """Return what announces a rollout, and whether it was reused."""

    def done(manifest: Manifest, reused: bool) -> None:
        progress.rollout_done(manifest, reused)

    return done


def default_folder(plan: RunPlan) -> Path:
    """Return the default run folder: what the command named first, and a short key of the command;
    the whole key where another command has the short one.
    """
    first_name = Path(plan.scenario_names[0] if plan.scenario_names else next(iter(plan.scenarios)))
    name = slug(first_name.stem or real(first_name).stem)
    key = plan.command_key
    short = Path("runs", f"{name}-{key[:SHORT_KEY]}")
    try:
        is_free = not os.path.exists(short / RUN_INFO) or read_run_json(short).key == key
    except InputError:
        is_free = True  # `claim` writes a damaged description again
    return short if is_free else Path("runs", f"{name}-{key}")


def execute_run(
    plan: RunPlan,
    root: Path,
    workers: int | None,
    command: Sequence[str],
    progress: Progress,
    resume: bool = False,
    repeat: bool = False,
    report: bool = True,
    *,
    limit_s: float | None = None,
    executor: Executor = LOCAL,
) -> RunResult:
    """Run a plan into a folder.

    Args:
        plan: The run.
        root: Its folder; one process writes it at a time.
        workers: Worker processes; None is one per core.
        command: The command line, for ``run.json``.
        progress: Shows the run.
        resume: Continue in the folder of another command.
        repeat: Drive a rollout of each policy a second time to see whether it is repeatable.
        report: Write ``report.html``; otherwise `write_reports` makes it later.
        limit_s: Seconds that one rollout may take.
        executor: Where rollouts run; the results do not depend on it.

    Raises:
        InputError: The folder holds the run of another command and ``resume`` is not set.
        InfrastructureError: Another process writes the folder, or it is read-only.
    """
    threads = thread_budget(workers, len(plan.cells), executor)
    with writing(root):
        held = claim(root, plan, command, threads, resume, progress.noticed)
        progress.started(plan, root, threads)
        began = time.perf_counter()
        how = HowToRun(threads, resume, limit_s, executor)
        if executor.is_local and (threads.workers > 1 or any(map(users_parts, plan.cells))):
            prepare_workers(threads.per_worker)
        earlier_checks = {} if held is None else held.policy_checks
        earlier_pool = None if held is None else held.pool
        try:
            checks = check_policies(plan, earlier_checks, how, progress.noticed)
            manifests = execute(
                plan, root, how, on_done(progress), progress.noticed, held, hanging(checks)
            )
            wall_s = time.perf_counter() - began
            info = replace(
                read_run_json(root),
                pool=pool_of(manifests, threads, wall_s, earlier_pool, how.stated),
                policy_checks=checks,
            )
            if repeat:
                repeated = repeat_rollout(plan, root, manifests, how.local_cores)
                info = replace(info, repeat=repeated)
            store_same_poses(plan, root, manifests, how.local_cores)
        finally:
            end_children()
        summary = finish_run(root, info, manifests, report)
    return RunResult(root, summary, len(manifests), summary.failures.n_failed)


def execute_search(
    search: Search,
    root: Path,
    workers: int | None,
    command: Sequence[str],
    progress: Progress,
    *,
    report: bool = True,
    limit_s: float | None = None,
    executor: Executor = LOCAL,
) -> RunResult:
    """Drive the rounds of a search into a folder; the arguments are those of `execute_run`."""
    threads = thread_budget(workers, search.at_once, executor)
    how = HowToRun(threads, limit_s=limit_s, executor=executor)
    with writing(root):
        held = claim(root, search.plan, command, threads, False, progress.noticed)
        # The kind is written at once: the plan's scenes are not all wanted.
        write_run_json(root, replace(read_run_json(root), kind=search.kind))
        progress.started(search.ceiling, root, threads)
        began = time.perf_counter()
        try:
            while (plan := search.next_plan()) is not None:
                search.add(plan, execute(plan, root, how, on_done(progress), progress.noticed))
                search.announce(root, progress)
        finally:
            end_children()
        driven = search.driven_plan()
        manifests = [search.driven[cell.folder.as_posix()] for cell in driven.cells]
        wall_s = time.perf_counter() - began
        earlier_pool = None if held is None else held.pool
        # Again, with the scenes that were driven.
        info = replace(
            run_info(driven, command, threads),
            kind=search.kind,
            pool=pool_of(manifests, threads, wall_s, earlier_pool, how.stated),
        )
        if held is not None and held.started_at is not None:
            info = replace(info, started_at=held.started_at)
        _write_scenes(root, driven)
        summary = finish_run(root, search.stated_in(info), manifests, report)
    return RunResult(root, summary, len(manifests), summary.failures.n_failed)


def finish_run(
    root: Path, info: RunInfo, manifests: Sequence[Manifest], report: bool = True
) -> Summary:
    """Write the tables and the reports of a run whose rollouts are done; return the summary.

    ``summary.json`` is the last of the tables: a run folder without it is unfinished.

    Args:
        root: The run folder.
        info: ``run.json``, which is written with the outcome; it holds all that the tables need
            beside the manifests, so that they can be made again.
        manifests: One per rollout, in the order of the tables.
        report: Write ``report.html``.
    """
    n_failed = sum(not manifest.ok for manifest in manifests)
    outcome = RunCounts(len(manifests), n_failed)  # for lists of many runs
    info = replace(info, outcome=outcome, rollouts=None, rewritten=rewritten_files(manifests))
    folders = tuple(manifest.path for manifest in manifests)
    if folders != cells_of_run(info):
        info = replace(info, rollouts=folders)
    write_run_json(root, info)
    REMADE.pop(real(root), None)
    summary = write_summary(root, info, manifests, root)
    scenes = [f"{SCENES}/{slug(scene)}.json" for scene in info.scenes]
    state_files(root, [RUN_INFO, DECISION, *TABLES, *scenes])
    from alpasim_plugin.runs.reports import write_reports  # templates: only once all is driven

    write_reports(root, report)
    return summary


def claim(
    root: Path,
    plan: RunPlan,
    command: Sequence[str],
    threads: Threads,
    resume: bool,
    noticed: Callable[[str], None],
) -> RunInfo | None:
    """Write ``run.json`` and the scene files, or check that the folder holds this run.

    Returns:
        What ``run.json`` said before; None for a new folder, or where it was damaged.

    Raises:
        InputError: The folder holds another run, or other files.
    """
    held: RunInfo | None = None
    foreign = sorted(set(os.listdir(root)) - OF_A_RUN)
    if os.path.exists(root / RUN_INFO):
        try:
            held = read_run_json(root)
        except InputError as error:
            noticed(f"damaged: {error.message}; writing it again")
    elif foreign:
        raise InputError(
            f"The folder {root} holds no run but {some_of(foreign)}.", "Name a new or empty folder."
        )
    if held is not None and held.key != plan.command_key and not resume:
        raise InputError(
            f"The folder {root} holds another run: its key is {held.key}, this command's "
            f"is {plan.command_key}.",
            "Choose another --out, or, without --vary, pass --resume to reuse its matching "
            "rollouts and replace its tables.",
        )
    if held is not None and any(damage.file == RUN_INFO for damage in inspect_files(root)):
        noticed(f"damaged: {root / RUN_INFO}: not the content that was written; writing it again")
        held = None
    unfinish(root)
    if held is None or held.content != plan.content:
        write_run_info(root, plan, command, threads)
    else:
        _write_scenes(root, plan)
    return held


def _write_scenes(root: Path, plan: RunPlan) -> None:
    for scenario in plan.scenarios.values():
        write_scene(root, scenario)


def write_run_info(root: Path, plan: RunPlan, command: Sequence[str], threads: Threads) -> None:
    """Write ``run.json`` and the scene files of the report."""
    _write_scenes(root, plan)
    write_run_json(root, run_info(plan, command, threads))


def run_info(plan: RunPlan, command: Sequence[str], threads: Threads) -> RunInfo:
    """Return ``run.json`` of a plan of which nothing is driven yet."""
    refs = {cell.scene: cell.ref for cell in plan.cells}
    parts = plan.parts
    fixers = {spec.name: spec.fixer for spec in plan.renderers if spec.fixer is not None}
    code = package_digest()[:12]
    left_out = {note for scenario in plan.scenarios.values() for note in scenario.notes}
    return RunInfo(
        key=plan.command_key,
        command=tuple(command),
        config=RunConfig(
            **vars(plan.options),
            workers=threads.workers,
            threads_per_worker=threads.per_worker,
        ),
        preset=plan.options.preset,
        renderers=tuple(spec.name for spec in plan.renderers),
        policies=tuple(spec.name for spec in plan.policies),
        seeds=plan.seeds,
        scenes={
            name: _scene_facts(
                as_driven(scenario, plan.options.preset), refs[name], plan.options.device
            )
            for name, scenario in plan.scenarios.items()
        },
        content=plan.content,
        version=__version__,
        started_at=now(),
        project=project(),
        asked=plan.scenario_names,
        shard=plan.shard,
        bases={spec.name: spec.base.name for spec in plan.renderers if spec.fixer is not None},
        fixers={name: part_facts(fixer) for name, fixer in fixers.items()},
        parts={f"{part.kind} {part.name}": part_facts(part) for part in parts},
        code={"loop": code, "scoring": code},
        metrics=dict(table_of(parts)),
        unseen={f"{part.kind} {part.name}": part.unseen for part in parts if part.unseen},
        weights={file: sha for part in parts for file, sha in part.files.items()},
        hardware=hardware(),
        versions=versions(),
        left_out=tuple(sorted(left_out)),
    )


def now() -> str:
    """Return date and time in UTC, as ``run.json`` states them."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def _scene_facts(scenario: Scenario, ref: ScenarioRef, device: str) -> SceneFacts:
    return SceneFacts(
        source=scenario.source,
        ref=SceneRef(str(Path(ref.path).absolute()), ref.seed, ref.overrides, ref.source),
        content_hash=scenario.content_hash,
        files=dict(scenario.files),
        seed=scenario.seed,
        varied={key: list(values) for key, values in scenario.varied.items()},
        duration_s=(scenario.end_us - scenario.start_us) * 1e-6,
        rates=asdict(scenario.rates),
        latency=asdict(scenario.latency),
        degradation=asdict(scenario.degradation),
        environment=asdict(scenario.environment),
        vehicle=asdict(scenario.vehicle),
        reconstruction=model_key(scenario, device),
        notes=tuple(scenario.notes),
    )
