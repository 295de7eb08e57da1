"""Drive scenes in random order until a question is decided, into an ordinary run folder.

Scenes are driven in batches. After each, the state follows from the scenes so far and their order
alone (`evaluators.statistics.decision`), never from workers, times or interruptions. The same command therefore reaches the same decision after any kill.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.subprocesses import end_children
from alpasim_plugin.log.run_folder.manifests import find_contents, read_run_json, write_run_json
from alpasim_plugin.log.run_folder.sides import RendererRows
from alpasim_plugin.log.run_folder.writer import rollout_rows, writing
from alpasim_plugin.runs.certificate import Certify, certify
from alpasim_plugin.runs.execute import HowToRun, execute, thread_budget
from alpasim_plugin.runs.executors.choice import LOCAL, Executor, kept_open
from alpasim_plugin.runs.plan import Cell, RunPlan, part_of
from alpasim_plugin.runs.run import (
    Progress,
    RunResult,
    claim,
    finish_run,
    on_done,
    publish,
    write_run_info,
)
from alpasim_plugin.runs.summary import pool_of
from evaluators.statistics.arms import Arm, arms_of, as_policy, short_name, usual_base
from evaluators.statistics.baselines import StoredSide
from evaluators.statistics.decision import (
    SCHEMA_VERSION,
    WORDS,
    Decision,
    Question,
    SceneDifferences,
    State,
    look_as_dict,
    outcome_of,
    question_as_dict,
    scene_differences,
    state_after,
    write_decision,
)
from evaluators.statistics.gate import failures_of
from evaluators.statistics.verdicts import Outcome, outcome_of_failures

KIND = "decide"  # of run.json
DOING = "planning a decision"


class DecisionProgress(Progress, Protocol):
    """Shows a decision to a person or a log file."""

    def looked(self, state: State, rollouts: int, ceiling: int) -> None:
        """Announce a look."""
        ...


@dataclass(frozen=True)
class Design:
    """How scenes are drawn.

    Attributes:
        order_seed: Key of the order.
        look_every: Scenes between looks.
        budget: Most rollouts; None: as many as the plan has.
        max_failed: Share of rollouts that may fail.
        max_missing: Share of pairs of a metric that may lack.
    """

    order_seed: Annotated[int, Flag("Key of the order of scenes.", min=0)] = 0
    look_every: Annotated[int, Flag("Scenes between looks.", min=1)] = 5
    budget: Annotated[
        int | None, Flag("Most rollouts; then undecided. Default: all of the suite.", min=2)
    ] = None
    max_failed: float = 0.0
    max_missing: Annotated[
        float, Flag("Share of pairs that may lack a value.", min=0.0, max=0.99)
    ] = 0.0


@dataclass(frozen=True)
class Decided:
    """A decision and its run."""

    run: RunResult
    record: Decision
    state: State
    outcome: Outcome


def key_of(question: Question, design: Design, stored: StoredSide | None = None) -> str:
    """Return the digest of what decides which rollouts are driven, besides the plan."""
    asked = [asdict(question), asdict(design)]
    return digest(asked if stored is None else [*asked, stored.digest])


def drawing_order(scenes: Sequence[str], order_seed: int) -> list[str]:
    """Return scenes in random order; it depends on their names and the seed, not on how they were
    listed.
    """
    names = sorted(scenes)
    return [names[i] for i in stream("decide", order_seed, "decide/order").permutation(len(names))]


def execute_decision(
    plan: RunPlan,
    question: Question,
    design: Design,
    root: Path,
    workers: int | None,
    command: Sequence[str],
    progress: DecisionProgress,
    stored: StoredSide | None = None,
    *,
    certificate: Certify = "one",
    report: bool = True,
    wait: bool = False,
    limit_s: float | None = None,
    executor: Executor = LOCAL,
    store: str | None = None,
) -> Decided:
    """Drive scenes of a plan until the question is decided or the ceiling is reached.

    Args:
        plan: All cells that may be driven, of two arms: the baseline of ``plan.options`` and
            another (of one, with ``stored``). Its ``question`` is `key_of` the question.
        question: What is to be decided.
        design: How scenes are drawn.
        root: The run folder; one process writes it at a time.
        workers: As for a run; the results do not depend on them.
        command: For ``run.json``.
        progress: Shows rollouts and looks.
        stored: The baseline's rollouts where they were driven earlier; the plan then has the
            renderer in question alone.
        certificate: Whether to repeat a rollout.
        report: Write ``report.html``.
        wait: Wait for a process that writes the folder; otherwise refuse.
        limit_s: Seconds that one rollout may take.
        executor, store: As for a run; the decision does not depend on them.

    Raises:
        InputError: The folder holds another run.
        InfrastructureError: Another process writes the folder.
    """
    drawing = _Drawing(plan, question, design, stored)
    threads = thread_budget(
        workers, design.look_every * drawing.per_seed * len(plan.seeds), executor
    )
    how = HowToRun(threads, limit_s=limit_s, executor=executor, store=store)
    with writing(root, wait, progress.noticed), kept_open(executor):
        contents = find_contents(root)
        held = claim(root, plan, command, threads, False, contents, progress.noticed)
        write_run_json(
            root, read_run_json(root) | {"kind": KIND}
        )  # so that nothing takes all scenes of the plan for wanted
        progress.started(plan, root, threads)
        began = time.perf_counter()
        known = contents.rollouts if contents else ()
        try:
            while cells := drawing.next_cells():
                drawing.add(
                    cells,
                    execute(
                        part_of(plan, cells), root, how, on_done(progress), progress.noticed, known
                    ),
                )
                progress.looked(drawing.state, drawing.rollouts, drawing.ceiling)
                write_decision(root, drawing.record())
            driven = part_of(plan, drawing.cells)
            manifests = [drawing.manifests[cell.folder.as_posix()] for cell in driven.cells]
            pool = {
                **how.stated,
                **pool_of(manifests, threads, time.perf_counter() - began, held.get("pool")),
            }
            repeat = certify(
                driven, root, manifests, how.cores_here, certificate, held.get("determinism")
            )
        finally:
            end_children()
        write_run_info(root, driven, command, threads)  # again, with the scenes that were driven
        kept = {"started_at": held["started_at"]} if "started_at" in held else {}
        write_run_json(root, read_run_json(root) | kept | {"kind": KIND})
        summary = finish_run(root, manifests, {"pool": pool, "determinism": repeat}, report)
        publish(root, store)
    result = RunResult(root, summary, len(manifests), summary["failures"]["n_failed"])
    return Decided(result, drawing.record(), drawing.state, drawing.outcome)


def arms_asked(plan: RunPlan, stored: bool = False) -> tuple[Arm, Arm]:
    """Return the baseline's arm and the one in question of a plan that has two arms, or of a stored
    baseline one: then both are it.
    """
    arms = arms_of((cell.renderer.name, cell.policy.name) for cell in plan.cells)
    if stored:
        return arms[0], arms[0]
    base = usual_base(arms, plan.options.baseline)
    asked = next(arm for arm in arms if base.of(arm) != arm)
    return base.of(asked), asked


def _side(rows: Sequence[Mapping[str, Any]], arm: Arm) -> RendererRows:
    return RendererRows.of(
        [row for row in rows if (row["renderer"], row["policy"]) == (arm.renderer, arm.policy)]
    )


class _Drawing:
    """The scenes driven so far, what follows from them, and which come next."""

    def __init__(
        self,
        plan: RunPlan,
        question: Question,
        design: Design,
        stored: StoredSide | None,
    ) -> None:
        self.plan = plan
        self.question = question
        self.design = design
        self.stored = stored
        self.base, self.asked = arms_asked(plan, stored is not None)
        self.baseline = stored.name if stored is not None else short_name(self.base, self.asked)
        self.candidate = short_name(self.asked, self.base)
        self.per_seed = 1 if stored is not None else 2
        self.ceiling = min(design.budget or len(plan.cells), len(plan.cells))
        self.per_scene = self.per_seed * len(plan.seeds)
        self.horizon = max(1, min(len(plan.scenarios), self.ceiling // self.per_scene))
        self.order = drawing_order(list(plan.scenarios), design.order_seed)
        self._of_scene: dict[str, list[Cell]] = {}
        for cell in plan.cells:
            self._of_scene.setdefault(cell.scene, []).append(cell)
        self._n_chosen = 0
        self.manifests: dict[str, dict[str, Any]] = {}
        self.looks: list[Any] = []
        self.differences: dict[str, SceneDifferences] = {}
        self.state = State(0, "open", ())
        self.stopped = ""

    @property
    def rollouts(self) -> int:
        """Give the number of rollouts so far."""
        return len(self.manifests)

    @property
    def scenes(self) -> list[str]:
        """Give the scenes driven so far, in their order."""
        return self.order[: self._n_chosen]

    @property
    def cells(self) -> list[Cell]:
        """Give the cells driven so far, in the plan's order."""
        return [cell for cell in self.plan.cells if cell.folder.as_posix() in self.manifests]

    def next_cells(self) -> list[Cell]:
        """Return the cells of the next batch; none where the decision has ended, and then
        ``stopped`` says why.
        """
        if self.stopped:
            return []
        left = self.order[self._n_chosen :]
        if not left:
            self.stopped = f"all {len(self.order)} scenes are driven"
            return []
        affordable = (self.ceiling - self.rollouts) // self.per_scene
        batch = left[: min(self.design.look_every, affordable)]
        if not batch:
            self.stopped = f"the budget of {self.ceiling} rollouts is spent"
            return []
        self._n_chosen += len(batch)
        return [cell for scene in batch for cell in self._of_scene[scene]]

    def add(self, cells: Sequence[Cell], manifests: Sequence[dict[str, Any]]) -> None:
        """Take in a batch and look."""
        self.manifests |= {
            cell.folder.as_posix(): manifest
            for cell, manifest in zip(cells, manifests, strict=True)
        }
        rows = rollout_rows(list(self.manifests.values()))
        candidate = _side(rows, self.asked)
        self.failed = outcome_of_failures(failures_of(rows), self.design.max_failed)
        driven = {(cell.scene, cell.seed) for cell in self.cells}
        there = (
            _side(rows, self.base)
            if self.stored is None
            else RendererRows.of(self.stored.of_cells(driven))
        )
        base = as_policy(there, self.asked.policy)
        values = {}
        for asked in self.question.metrics:
            differences = scene_differences(candidate, base, asked.metric, self.scenes)
            self.differences[asked.metric] = differences
            values[asked.metric] = differences.harm(asked.facts.direction)
        self.state = state_after(self.question, values, self.horizon, len(self.order))
        self.looks.append(look_as_dict(self.state, self.rollouts))
        self.stopped = self._reason_to_stop()

    @property
    def lacking(self) -> list[str]:
        """Give the binding metrics that lack more pairs than allowed."""
        return [
            one.metric
            for one in self.question.metrics
            if one.binding
            and self.differences[one.metric].n_missing
            > self.design.max_missing * self.differences[one.metric].n_pairs
        ]

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
            "candidate": self.candidate,
            "baseline": self.baseline,
            "policy": self.asked.policy,
            "order_seed": self.design.order_seed,
            "look_every": self.design.look_every,
            "ceiling": {"scenes": len(self.order), "rollouts": self.ceiling},
            "order": self.scenes,
            "looks": self.looks,
            "verdict": words.get(outcome.cause, "undecided"),
            "stopped": self.stopped,
            "outcome": outcome.as_dict(),
            "rollouts": self.rollouts,
        }

    def _reason_to_stop(self) -> str:
        if self.failed.cause != "pass":
            return "rollouts failed"
        if self.state.answer != "open":
            return "decided"
        if self.lacking:
            lost = ", ".join(
                f"{self.differences[name].n_missing} of {name}" for name in self.lacking
            )
            return f"pairs lack a value: {lost}; more than the share of {self.design.max_missing:g} that is allowed"
        return ""
