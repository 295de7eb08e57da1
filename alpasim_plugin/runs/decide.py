"""Sequential test: drive scenes in random order and stop as soon as a question is decided.

Scenes are driven in batches. After each, the state follows from the scenes so far and their order
alone (`evaluators.statistics.decision`), and so does what is driven next: never from workers, times or
interruptions. The same command therefore reaches the same decision after any kill.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.log.run_folder.records import Manifest, RunInfo
from alpasim_plugin.log.run_folder.schema import DECISION
from alpasim_plugin.log.run_folder.sides import RolloutTable
from alpasim_plugin.log.run_folder.writer import rollout_table
from alpasim_plugin.runs.plan import RunPlan, part_of
from alpasim_plugin.runs.run import Progress
from evaluators.results import Outcome
from evaluators.statistics.decision import (
    MOST_SCENES,
    SCHEMA_VERSION,
    WORDS,
    Decision,
    Question,
    State,
    least_scenes,
    outcome_of,
    question_as_dict,
    scene_harm,
    state_after,
)
from evaluators.statistics.gate import failures_of
from evaluators.statistics.variants import (
    Base,
    Variant,
    base_named,
    short_name,
    usual_base,
    variants_of,
)
from evaluators.statistics.verdicts import outcome_of_failures

SCENES_PER_LOOK = 5
ORDER_SEED = 0


def plan_of_two(
    plan: RunPlan, question: Question, scenes_per_look: int = SCENES_PER_LOOK
) -> RunPlan:
    """Return the part of a plan that a question is about: the baseline and one other variant.

    Args:
        plan: Of two renderers or two policies, or of two of each with a baseline that names both.
        question: What is to be decided; its digest goes into the plan.
        scenes_per_look: How many scenes are driven between two analyses; part of that digest.

    Raises:
        InputError: The plan has another number of variants, or too few scenes for the good answer.
    """
    variants = variants_of((cell.renderer.name, cell.policy.name) for cell in plan.cells)
    named = plan.options.baseline
    base = usual_base(variants) if named is None else base_named(named, variants, "the plan")
    if len(variants) == 4 and base.renderer is not None and base.policy is not None:
        variants = [variant for variant in variants if _is_base_or_opposite(variant, base)]
    if len(variants) != 2:
        raise InputError(
            f"--until-decided: {len(variants)} variants",
            "Name two renderers or two policies: the baseline and the one in question.",
        )
    n_scenes = len(plan.scenarios)
    if least_scenes(question, n_scenes) is None:
        least = least_scenes(question) or f"more than {MOST_SCENES}"
        margins = ", ".join(f"{metric.metric}={metric.margin:g}" for metric in question.metrics)
        raise InputError(
            f"--until-decided: {n_scenes} scenes, the margins {margins} take at least {least}",
            "Name more scenes or wider margins, or use simrun gate, which is about these scenes.",
        )
    kept = {(variant.renderer, variant.policy) for variant in variants}
    cells = tuple(cell for cell in plan.cells if (cell.renderer.name, cell.policy.name) in kept)
    key = digest([asdict(question), scenes_per_look, ORDER_SEED])
    options = replace(plan.options, baseline=base.name)
    return replace(plan, cells=cells, options=options, question=key)


def _is_base_or_opposite(variant: Variant, base: Base) -> bool:
    """Tell whether a variant is the baseline, or has neither its renderer nor its policy."""
    is_opposite = base.renderer != variant.renderer and base.policy != variant.policy
    return variant == base.of(variant) or is_opposite


def drawing_order(scenes: Sequence[str]) -> list[str]:
    """Return scenes in random order, which depends on their names alone, not on how they were
    listed.
    """
    names = sorted(scenes)
    order = stream("decide", ORDER_SEED, "decide/order").permutation(len(names))
    return [names[number] for number in order]


@dataclass
class SequentialTest:
    """The scenes driven so far, what follows from them, and which come next; a
    `alpasim_plugin.runs.run.Search` of a plan from `plan_of_two`, which has the same
    ``scenes_per_look``.
    """

    kind: ClassVar[str] = "decide"

    plan: RunPlan
    question: Question
    scenes_per_look: int = SCENES_PER_LOOK
    n_scenes: int = 0  # that were driven, the first of the order
    driven: dict[str, Manifest] = field(default_factory=dict)
    looks: list[Any] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)  # binding metrics of which a pair has no value
    state: State = field(default_factory=lambda: State(0, "open", {}))
    failed: Outcome = Outcome("pass")
    stopped: str = ""

    def __post_init__(self) -> None:
        variants = variants_of((cell.renderer.name, cell.policy.name) for cell in self.plan.cells)
        base = usual_base(variants, self.plan.options.baseline)
        self.candidate = next(variant for variant in variants if base.of(variant) != variant)
        self.baseline = base.of(self.candidate)
        self.order = drawing_order(list(self.plan.scenarios))
        self.ceiling, self.at_once = self.plan, self.scenes_per_look * 2 * len(self.plan.seeds)

    def driven_plan(self) -> RunPlan:
        """Return the part of the plan that was driven."""
        done = [cell for cell in self.plan.cells if cell.folder.as_posix() in self.driven]
        return part_of(self.plan, done)

    def next_plan(self) -> RunPlan | None:
        """Return the next batch; None where the test has ended, and then ``stopped`` says why."""
        if self.stopped:
            return None
        batch = self.order[self.n_scenes : self.n_scenes + self.scenes_per_look]
        if not batch:
            self.stopped = f"all {len(self.order)} scenes are driven"
            return None
        self.n_scenes += len(batch)
        cells = [cell for scene in batch for cell in self.plan.cells if cell.scene == scene]
        return part_of(self.plan, cells)

    def add(self, plan: RunPlan, manifests: Sequence[Manifest]) -> None:
        """Take in a batch and analyse all scenes so far."""
        folders = [cell.folder.as_posix() for cell in plan.cells]
        self.driven |= dict(zip(folders, manifests, strict=True))
        table = RolloutTable.of_table(rollout_table(list(self.driven.values())))
        self.failed = outcome_of_failures(failures_of(table))
        policy = self.candidate.policy
        candidate = table.sides(policy)[self.candidate.renderer]
        base = table.sides(self.baseline.policy, policy)[self.baseline.renderer]
        scenes = self.order[: self.n_scenes]
        criteria = self.question.metrics
        values = {
            criterion.metric: scene_harm(candidate, base, criterion.facts, scenes)
            for criterion in criteria
        }
        self.lacking = [
            criterion.metric
            for criterion in criteria
            if criterion.binding and np.isnan(values[criterion.metric]).any()
        ]
        self.state = state_after(self.question, values, len(self.order))
        self.looks.append({**vars(self.state), "rollouts": len(self.driven)})
        if self.failed.cause != "pass":
            self.stopped = "rollouts failed"
        elif self.state.answer != "open":
            self.stopped = "decided"
        elif self.lacking:
            self.stopped = f"pairs lack a value: {', '.join(self.lacking)}"

    def announce(self, root: Path, progress: Progress) -> None:
        """Show the analysis and write ``decision.json``."""
        progress.looked(self.state, len(self.driven), len(self.plan.cells))
        write_json(root / DECISION, self.record())

    def stated_in(self, info: RunInfo) -> RunInfo:
        """Return ``run.json`` as it is: ``decision.json`` holds the decision."""
        return info

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
            "look_every": self.scenes_per_look,
            "ceiling": {"scenes": len(self.order), "rollouts": len(self.plan.cells)},
            "order": self.order[: self.n_scenes],
            "looks": self.looks,
            "verdict": words.get(outcome.cause, "undecided"),
            "stopped": self.stopped,
            "outcome": outcome.as_dict(),
            "rollouts": len(self.driven),
        }
