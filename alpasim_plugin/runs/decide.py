"""Sequential test: drive scenes in random order and stop as soon as a question is decided.

Scenes are driven in batches. After each, the state follows from the scenes so far and their order
alone (`evaluators.statistics.decision`), and so does what is driven next: never from workers, times or
interruptions. The same command therefore reaches the same decision after any kill.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from alpasim_plugin.alpasim.client.child import end_children
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.log.run_folder.manifests import read_run_json, write_run_json
from alpasim_plugin.log.run_folder.sides import RolloutTable
from alpasim_plugin.log.run_folder.writer import rollout_table, writing
from alpasim_plugin.runs.execute import HowToRun, execute, thread_budget
from alpasim_plugin.runs.executors.choice import LOCAL, Executor
from alpasim_plugin.runs.plan import Cell, RunPlan, part_of
from alpasim_plugin.runs.run import (
    Progress,
    RunResult,
    claim,
    finish_run,
    on_done,
    write_run_info,
)
from alpasim_plugin.runs.summary import pool_of
from evaluators.statistics.decision import (
    MOST_SCENES,
    SCHEMA_VERSION,
    WORDS,
    Decision,
    Question,
    State,
    least_scenes,
    look_as_dict,
    outcome_of,
    question_as_dict,
    scene_harm,
    state_after,
    write_decision,
)
from evaluators.statistics.gate import failures_of
from evaluators.statistics.variants import (
    base_named,
    short_name,
    usual_base,
    variants_of,
)
from evaluators.statistics.verdicts import Outcome, outcome_of_failures

KIND = "decide"  # of run.json
SCENES_PER_LOOK = 5
ORDER_SEED = 0


class DecisionProgress(Progress, Protocol):
    """Shows a sequential test to a person or a log file."""

    def looked(self, state: State, rollouts: int, ceiling: int) -> None:
        """Announce an interim analysis."""
        ...


@dataclass(frozen=True)
class Decided:
    """A decision and its run."""

    run: RunResult
    record: Decision
    state: State
    outcome: Outcome


def plan_of_two(plan: RunPlan, question: Question) -> RunPlan:
    """Return the part of a plan that a question is about: the baseline and one other variant.

    Args:
        plan: Of two renderers or two policies, or of two of each with a baseline that names both.
        question: What is to be decided; its digest goes into the plan.

    Raises:
        InputError: The plan has another number of variants, or too few scenes for the good answer.
    """
    variants = variants_of((cell.renderer.name, cell.policy.name) for cell in plan.cells)
    named = plan.options.baseline
    base = usual_base(variants) if named is None else base_named(named, variants, "the plan")
    if len(variants) == 4 and base.renderer is not None and base.policy is not None:
        variants = [
            variant
            for variant in variants
            if variant == base.of(variant)
            or (base.renderer != variant.renderer and base.policy != variant.policy)
        ]
    if len(variants) != 2:
        raise InputError(
            f"--until-decided: {len(variants)} variants",
            "Name two renderers or two policies: the baseline and the one in question.",
        )
    n_scenes = len(plan.scenarios)
    if least_scenes(question, n_scenes) is None:
        least = least_scenes(question) or f"more than {MOST_SCENES}"
        margins = ", ".join(f"{one.metric}={one.margin:g}" for one in question.metrics)
        raise InputError(
            f"--until-decided: {n_scenes} scenes, the margins {margins} take at least {least}",
            "Name more scenes or wider margins, or use simrun gate, which is about these scenes.",
        )
    kept = {(variant.renderer, variant.policy) for variant in variants}
    cells = tuple(cell for cell in plan.cells if (cell.renderer.name, cell.policy.name) in kept)
    key = digest([asdict(question), SCENES_PER_LOOK, ORDER_SEED])
    options = replace(plan.options, baseline=base.name)
    return replace(plan, cells=cells, options=options, question=key)


def drawing_order(scenes: Sequence[str]) -> list[str]:
    """Return scenes in random order, which depends on their names alone, not on how they were
    listed.
    """
    names = sorted(scenes)
    order = stream("decide", ORDER_SEED, "decide/order").permutation(len(names))
    return [names[number] for number in order]


def execute_decision(
    plan: RunPlan,
    question: Question,
    root: Path,
    workers: int | None,
    command: Sequence[str],
    progress: DecisionProgress,
    *,
    report: bool = True,
    limit_s: float | None = None,
    executor: Executor = LOCAL,
) -> Decided:
    """Drive scenes of a plan until the question is decided or all are driven.

    Args:
        plan: From `plan_of_two`.
        question: What is to be decided.
        root: The run folder; one process writes it at a time.
        workers: As for a run; the results do not depend on them.
        command: For ``run.json``.
        progress: Shows rollouts and interim analyses.
        report: Write ``report.html``.
        limit_s: Seconds that one rollout may take.
        executor: As for a run; the decision does not depend on it.

    Raises:
        InputError: The folder holds another run.
        InfrastructureError: Another process writes the folder.
    """
    test = _SequentialTest(plan, question)
    threads = thread_budget(workers, SCENES_PER_LOOK * 2 * len(plan.seeds), executor)
    how = HowToRun(threads, limit_s=limit_s, executor=executor)
    with writing(root):
        held = claim(root, plan, command, threads, False, progress.noticed)
        # The kind is written at once: the plan's scenes are not all wanted.
        write_run_json(root, read_run_json(root) | {"kind": KIND})
        progress.started(plan, root, threads)
        began = time.perf_counter()
        try:
            while cells := test.next_cells():
                part = part_of(plan, cells)
                manifests = execute(part, root, how, on_done(progress), progress.noticed)
                test.add(cells, manifests)
                progress.looked(test.state, len(test.manifests), len(plan.cells))
                write_decision(root, test.record())
        finally:
            end_children()
        driven = part_of(plan, test.cells)
        manifests = [test.manifests[cell.folder.as_posix()] for cell in driven.cells]
        took_s = time.perf_counter() - began
        pool = {**how.stated, **pool_of(manifests, threads, took_s, held.get("pool"))}
        write_run_info(root, driven, command, threads)  # again, with the scenes that were driven
        kept = {"started_at": held["started_at"]} if "started_at" in held else {}
        write_run_json(root, read_run_json(root) | kept | {"kind": KIND})
        summary = finish_run(root, manifests, {"pool": pool}, report)
    result = RunResult(root, summary, len(manifests), summary["failures"]["n_failed"])
    return Decided(result, test.record(), test.state, test.outcome)


@dataclass
class _SequentialTest:
    """The scenes driven so far, what follows from them, and which come next."""

    plan: RunPlan
    question: Question
    driven: int = 0  # scenes, the first of the order
    manifests: dict[str, JsonObject] = field(default_factory=dict)
    looks: list[Any] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)  # binding metrics of which a pair has no value
    state: State = State(0, "open", ())
    failed: Outcome = Outcome("pass")
    stopped: str = ""

    def __post_init__(self) -> None:
        variants = variants_of((cell.renderer.name, cell.policy.name) for cell in self.plan.cells)
        base = usual_base(variants, self.plan.options.baseline)
        self.candidate = next(variant for variant in variants if base.of(variant) != variant)
        self.baseline = base.of(self.candidate)
        self.order = drawing_order(list(self.plan.scenarios))

    @property
    def cells(self) -> list[Cell]:
        """Give the cells driven so far, in the plan's order."""
        return [cell for cell in self.plan.cells if cell.folder.as_posix() in self.manifests]

    def next_cells(self) -> list[Cell]:
        """Return the cells of the next batch; none where the test has ended, and then ``stopped``
        says why.
        """
        if self.stopped:
            return []
        batch = self.order[self.driven : self.driven + SCENES_PER_LOOK]
        if not batch:
            self.stopped = f"all {len(self.order)} scenes are driven"
        self.driven += len(batch)
        return [cell for scene in batch for cell in self.plan.cells if cell.scene == scene]

    def add(self, cells: Sequence[Cell], manifests: Sequence[JsonObject]) -> None:
        """Take in a batch and analyse all scenes so far."""
        folders = [cell.folder.as_posix() for cell in cells]
        self.manifests |= dict(zip(folders, manifests, strict=True))
        table = RolloutTable.of_table(rollout_table(list(self.manifests.values())))
        self.failed = outcome_of_failures(failures_of(table))
        policy = self.candidate.policy
        candidate = table.sides(policy)[self.candidate.renderer]
        base = table.sides(self.baseline.policy, policy)[self.baseline.renderer]
        scenes = self.order[: self.driven]
        asked = self.question.metrics
        values = {one.metric: scene_harm(candidate, base, one.facts, scenes) for one in asked}
        self.lacking = [
            one.metric for one in asked if one.binding and np.isnan(values[one.metric]).any()
        ]
        self.state = state_after(self.question, values, len(self.order))
        self.looks.append(look_as_dict(self.state, len(self.manifests)))
        if self.failed.cause != "pass":
            self.stopped = "rollouts failed"
        elif self.state.answer != "open":
            self.stopped = "decided"
        elif self.lacking:
            self.stopped = f"pairs lack a value: {', '.join(self.lacking)}"

    @property
    def outcome(self) -> Outcome:
        """Give the outcome; failures of rollouts come first."""
        if self.failed.cause != "pass":
            return self.failed
        if self.state.answer != "bad" and self.lacking:
            return Outcome("undecided", (self.stopped,))
        return outcome_of(self.question, self.state, self.stopped)

    def record(self) -> Decision:
        """Return ``decision.json``."""
        outcome = self.outcome
        words = {"pass": WORDS["good"], "regression": WORDS["bad"]}
        return {
            "schema_version": SCHEMA_VERSION,
            "question": question_as_dict(self.question),
            "candidate": short_name(self.candidate, self.baseline),
            "baseline": short_name(self.baseline, self.candidate),
            "policy": self.candidate.policy,
            "order_seed": ORDER_SEED,
            "look_every": SCENES_PER_LOOK,
            "ceiling": {"scenes": len(self.order), "rollouts": len(self.plan.cells)},
            "order": self.order[: self.driven],
            "looks": self.looks,
            "verdict": words.get(outcome.cause, "undecided"),
            "stopped": self.stopped,
            "outcome": outcome.as_dict(),
            "rollouts": len(self.manifests),
        }
