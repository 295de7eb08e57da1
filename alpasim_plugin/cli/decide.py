"""``simrun decide``: drive scenes in random order until a question is decided. ``simrun gate
--until-decided`` uses its parts.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from alpasim_plugin.cli.options import (
    Care,
    Json,
    Only,
    Quiet,
    RunFolder,
    What,
    Where,
    check_preset,
    split_policies,
)
from alpasim_plugin.cli.progress import Lines, Silent, report_line
from alpasim_plugin.cli.run import planned
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.signals import Stopped
from alpasim_plugin.log.run_folder.schema import slug
from alpasim_plugin.runs.decide import Decided, Design, execute_decision, key_of
from alpasim_plugin.runs.plan import RunOptions, RunPlan
from evaluators.report.numbers import plural
from evaluators.report.verdict import metric_lines, verdict_line
from evaluators.statistics.arms import Arm, arms_of, base_named, usual_base
from evaluators.statistics.baselines import (
    StoredSide,
    check_made_alike,
    read_baseline,
    stored_side,
)
from evaluators.statistics.decision import (
    MetricQuestion,
    Population,
    Question,
    State,
    metric_question,
)
from evaluators.statistics.gate import GateSpec, load_gate

DOING = "planning a decision"

EPILOG = """
Examples:

- `simrun decide --renderer clean,3dgs suites/urban`: is 3dgs non-inferior to clean by the default gate?

- `simrun decide --renderer clean --policy lane-camera,learned suites/urban`: is the second policy non-inferior to the first?

- `simrun decide --renderer clean,onefixer --metric lateral_distance_m=0.1,progress=0.05 suites/all --budget 200`

- `simrun decide --renderer clean,3dgs --population suite suites/all`: about the mean of this suite

- `simrun decide --renderer 3dgs --baseline-file runs/last-week suites/all`: drives the change alone, against the same renderer last week

- `simrun decide --renderer clean,3dgs --executor ray --look-every 50 --store s3://bucket/night suites/all`: 100 rollouts at a time

Exit codes: 0 non-inferior, 1 worse, 2 bad input or a broken policy, 3 undecided at the ceiling,
4 rollouts could not be run, 5 could not be scored. docs/sequential.md says what is guaranteed.
"""


Alpha = Annotated[float, Flag("Chance of a wrong decision, over all looks.", min=1e-6, max=0.5)]
Asked = Annotated[
    Population, Flag("The population that the scenes were drawn from, or the suite itself.")
]
Stored = Annotated[Path | None, Flag("Compare with this stored baseline, or this earlier run.")]


def decide(
    what: Annotated[What, Only("scenarios", "renderer", "policy", "seeds", "overrides")],
    options: Annotated[RunOptions, Only("preset", "images", "device", "baseline")],
    design: Design,
    where: Where,
    care: Care,
    metric: Annotated[
        tuple[str, ...],
        Flag(
            "What is asked about; repeatable or comma-separated. Default: the gate's.",
            metavar="NAME[=MARGIN]",
        ),
    ] = (),
    gate: Annotated[
        str, Flag("Gate whose margins are asked about where no --metric is named.")
    ] = "default",
    alpha: Alpha = 0.05,
    population: Asked = "scenes",
    min_scenes: Annotated[
        int | None, Flag("Scenes before any decision. Default: the gate's, else 2.", min=2)
    ] = None,
    baseline_file: Stored = None,
    out: RunFolder = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Drive scenes in random order until it is decided whether a renderer, or a policy, is worse
    than another.

    `--renderer` or `--policy` names the baseline and the one in question; with `--baseline-file`
    the latter alone. An interrupted decision continues when the same command is given again, and
    decides the same.
    """
    check_preset(options.preset)
    spec = None if metric else load_gate(gate)[0]
    asked = questions_of(metric) if spec is None else questions_of_gate(spec)
    least = min_scenes or (2 if spec is None else spec.min_scenes)
    population = population_of(
        population, design.max_missing, f"--max-missing {design.max_missing:g}"
    )
    question = Question(asked, alpha, population, least)
    how = where.arguments() | care.arguments()
    plan = plan_of(what, options, stored=baseline_file is not None)
    stored = (
        None
        if baseline_file is None
        else side_of_baseline(baseline_file, plan, options.baseline, design.max_missing)
    )
    decided = decide_into(
        plan,
        question,
        design,
        out,
        quiet or as_json,
        stored,
        **how,
    )
    if as_json:
        print(
            json.dumps(
                {
                    "out": str(decided.run.root),
                    "exit_code": decided.outcome.exit_code,
                    "decision": decided.record,
                }
            )
        )
    else:
        print_end(decided)
        print(report_line(decided.run.root))
    raise typer.Exit(decided.outcome.exit_code)


class LookLines(Lines):
    """One line per finished rollout and one per look, on stderr."""

    def looked(self, state: State, rollouts: int, ceiling: int) -> None:
        """Print a look."""
        print(look_line(state, rollouts, ceiling), file=sys.stderr, flush=True)


class SilentLooks(Silent):
    """Say nothing."""

    def looked(self, state: State, rollouts: int, ceiling: int) -> None:
        """Ignore."""


def look_line(state: State, rollouts: int, ceiling: int) -> str:
    """Return one line for a look: scenes, and each metric's interval and verdict."""
    parts = []
    for one in state.metrics:
        low, high = one.interval
        ends = "no bound yet" if low is None and high is None else f"{_end(low)} to {_end(high)}"
        parts.append(f"{one.metric} {ends} {one.answer}")
    return f"look: {state.n_scenes} scenes, {rollouts} of at most {ceiling} rollouts: {'; '.join(parts)}"


def _end(value: float | None) -> str:
    return "unbounded" if value is None else f"{value:+.4g}"


def plan_of(what: What, options: RunOptions, stored: bool = False) -> RunPlan:
    """Plan all cells that may be driven.

    Args:
        what: Scenes, and two renderers, two policies, or two of both with a baseline that names
            both.
        options: Of the run.
        stored: The baseline was driven earlier: one arm is driven.

    Raises:
        InputError: Not two arms (one, if stored), or a scenario or part is invalid.
    """
    renderers, policies = what.renderers, split_policies(what.policy)
    what_is_asked = f"--renderer {what.renderer} --policy {what.policy}"
    if stored:
        if len(renderers) * len(policies) != 1:
            raise InputError(
                f"{what_is_asked}: {len(renderers)} renderers and {len(policies)} policies beside a stored baseline",
                "name the arm in question; the baseline is not driven again",
            )
        return planned(what, renderers, policies, replace(options, baseline=None))
    if sorted((len(renderers), len(policies))) not in ([1, 2], [2, 2]):
        raise InputError(
            f"{what_is_asked}: {len(renderers)} renderers and {len(policies)} policies",
            "name two renderers or two policies: the baseline and the one in question",
        )
    plan = planned(what, renderers, policies, options)
    arms = arms_of(
        (renderer.name, policy.name) for policy in plan.policies for renderer in plan.renderers
    )
    base = (
        usual_base(arms)
        if options.baseline is None
        else base_named(options.baseline, arms, "the plan")
    )
    if len(arms) == 4:
        if base.renderer is None or base.policy is None:
            raise InputError(
                f"{what_is_asked}: baseline {base.name} leaves open which of four arms is in question",
                f"name one arm, as --baseline {arms[0].name}: the one in question shares nothing with it",
            )
        arms = [
            arm
            for arm in arms
            if arm == base.of(arm) or (base.renderer != arm.renderer and base.policy != arm.policy)
        ]
    kept = {(arm.renderer, arm.policy) for arm in arms}
    cells = tuple(cell for cell in plan.cells if (cell.renderer.name, cell.policy.name) in kept)
    return replace(plan, cells=cells, options=replace(plan.options, baseline=base.name))


def side_of_baseline(
    path: Path, plan: RunPlan, baseline: str | None, max_missing: float
) -> StoredSide:
    """Read a stored baseline, or an earlier run's folder, and check it against what is about to be
    driven.

    Args:
        path: The baseline's file or folder.
        plan: What may be driven, of one renderer.
        baseline: RENDERER, POLICY or RENDERER/POLICY whose rollouts are taken; None: the arm that
            is driven.
        max_missing: Share of the plan's scenes and seeds that it may lack.

    Raises:
        InputError: It was made with another preset, other weights or other scenes, or lacks
            rollouts that may be driven.
    """
    stored = read_baseline(path)
    weights = {file: sha for part in plan.parts for file, sha in part.files.items()}
    check_made_alike(
        stored,
        plan.options.preset,
        {name: one.content_hash for name, one in plan.scenarios.items()},
        weights,
        path,
    )
    planned = {(cell.scene, cell.seed) for cell in plan.cells}
    there = arms_of((str(row["renderer"]), str(row["policy"])) for row in stored.rows)
    driven = Arm(plan.renderers[0].name, plan.policies[0].name)
    arm = driven if baseline is None else base_named(baseline, there, str(path)).of(driven)
    return stored_side(stored.rows, arm.renderer, arm.policy, planned, max_missing, path)


def questions_of(metrics: Sequence[str]) -> tuple[MetricQuestion, ...]:
    """Read ``--metric NAME[=MARGIN]``, repeatable or comma-separated.

    Raises:
        InputError: A margin that is no number, or one metric twice.
    """
    found = []
    for text in (part.strip() for item in metrics for part in item.split(",") if part.strip()):
        name, _, margin = text.partition("=")
        try:
            value = float(margin) if margin else None
        except ValueError:
            raise InputError(
                f"--metric {text}: margin {margin!r} is no number",
                "write NAME=MARGIN, as progress=0.05",
            ) from None
        found.append(metric_question(name, value))
    names = [one.metric for one in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"--metric {twice[0]}: named twice", "name every metric once")
    return tuple(found)


def questions_of_gate(spec: GateSpec) -> tuple[MetricQuestion, ...]:
    """Return the questions that a gate's margins ask.

    Raises:
        InputError: The gate has no margin.
    """
    found = tuple(
        metric_question(name, rule.margin, binding=rule.must_decide)
        for name, rule in spec.metrics.items()
        if rule.margin is not None
    )
    if not any(one.binding for one in found):
        raise InputError(
            "the gate: no margin of it must be decided",
            "give it a metric with a margin, or judge a run without",
        )
    return found


def decide_into(
    plan: RunPlan,
    question: Question,
    design: Design,
    root: Path | None,
    quiet: bool,
    stored: StoredSide | None = None,
    **how: Any,
) -> Decided:
    """Drive until decided; an interruption says how to go on.

    Args:
        plan: From `plan_of`.
        question: What is to be decided.
        design: How scenes are drawn.
        root: Run folder; None: named after the command.
        quiet: No progress.
        stored: The baseline's side, where it was driven earlier.
        how: Further arguments of `execute_decision`.

    Raises:
        InputError: The scenes are fewer than a decision takes, whatever they show: nothing is
            driven.
    """
    scenes, least = len(plan.scenarios), question.min_scenes
    if scenes < least:
        raise InputError(
            f"{plural(scenes, 'scene')}: nothing is decided on fewer than {least} (min_scenes)",
            "name more scenes, or drive these and judge all of them: simrun --renderer A,B SCENARIO..., then simrun gate RUN",
        )
    plan = replace(plan, question=key_of(question, design, stored))
    folder = root or Path(
        "runs", f"decide-{slug(next(iter(plan.scenarios)))}-{plan.command_key}"
    )  # by the command alone
    progress = SilentLooks() if quiet else LookLines()
    try:
        return execute_decision(
            plan,
            question,
            design,
            folder,
            command=["simrun", *sys.argv[1:]],
            progress=progress,
            stored=stored,
            **how,
        )
    except Stopped as stop:
        stop.kept = f"finished rollouts are kept in {folder}; the same command continues and decides the same"
        raise


def population_of(text: Population, max_missing: float, allowed_by: str) -> Population:
    """Check that a suite is asked about only where all its scenes count.

    Args:
        text: Which population.
        max_missing: Share of pairs that may lack.
        allowed_by: What says so, for the error.

    Raises:
        InputError: Pairs may be missing.
    """
    if text == "suite" and max_missing > 0.0:
        raise InputError(
            f"{allowed_by}: scenes without a pair would be left out of the suite that is asked about",
            "leave it out, or ask with --population scenes",
        )
    return text


def print_end(decided: Decided) -> None:
    """Print verdict, numbers and guarantee."""
    print(verdict_line(decided.record))
    for line in metric_lines(decided.record):
        print(line)
