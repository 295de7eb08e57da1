"""What ``simrun decide`` and ``simrun gate --until-decided`` share: the plan, the progress, the printed end."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from alpasim_plugin.cli.progress import Lines, Silent
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.process.signals import Stopped
from alpasim_plugin.run_folder.schema import slug
from alpasim_plugin.runtime.decide import Decided, Design, execute_decision, key_of
from alpasim_plugin.runtime.plan import RunOptions, RunPlan, make_plan
from evaluators.gate import GateSpec, check_made_alike, read_baseline, rows_of_run
from evaluators.gate.stored import StoredSide, stored_side
from evaluators.opening import read_run
from evaluators.report.decision import metric_lines, verdict_line
from evaluators.sequential import control
from evaluators.sequential.control import Control
from evaluators.sequential.decision import State
from evaluators.sequential.question import Method, MetricQuestion, Order, Population, Question, metric_question
from scenarios.suite import ScenarioRef, expand

DOING = "planning a decision"
AUTO = "auto:"


@dataclass(frozen=True)
class What:
    """What is driven: scenes, two renderers, one policy."""

    scenarios: Sequence[str]
    renderers: str
    policy: str
    seeds: Sequence[int]
    options: RunOptions
    overrides: Sequence[str] = ()


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


def plan_of(what: What, stored: bool = False) -> RunPlan:
    """Plan all cells that may be driven.

    Args:
        what: Scenes, renderers, policy.
        stored: The baseline was driven earlier: one renderer is driven.

    Raises:
        InputError: Not two renderers (one, if stored) and one policy, or a scenario or part is invalid.
    """
    names = [name.strip() for name in what.renderers.split(",") if name.strip()]
    if stored:
        if len(names) != 1:
            found = f"{len(names)} renderers beside a stored baseline"
            raise InputError(DOING, f"--renderer {what.renderers}", found, "name the one in question; the baseline is not driven again")
        plan = make_plan(_refs(what), names, [what.policy], what.seeds, replace(what.options, baseline=None))
        return replace(plan, asked=tuple(what.scenarios))
    if len(names) != 2:
        raise InputError(DOING, f"--renderer {what.renderers}", f"{len(names)} renderers", "name two: the baseline and the one in question")
    baseline = what.options.baseline or names[0]
    if baseline not in names:
        raise InputError(DOING, f"--baseline {baseline}", f"the renderers are {', '.join(names)}", "name one of them")
    plan = make_plan(_refs(what), names, [what.policy], what.seeds, replace(what.options, baseline=baseline))
    return replace(plan, asked=tuple(what.scenarios))


def _refs(what: What) -> list[ScenarioRef]:
    return [ref for item in what.scenarios for ref in expand(item, what.overrides)]


def side_of_baseline(path: Path, plan: RunPlan, baseline: str | None, max_missing: float) -> StoredSide:
    """Read a stored baseline, or an earlier run's folder, and check it against what is about to be driven.

    Args:
        path: The baseline's file or folder.
        plan: What may be driven, of one renderer.
        baseline: Renderer whose rollouts are taken; None: the one that is driven.
        max_missing: Share of the plan's scenes and seeds that it may lack.

    Raises:
        InputError: It was made with another preset, other weights or other scenes, or lacks rollouts that may be driven.
    """
    stored = read_baseline(path)
    weights = {file: sha for part in plan.parts for file, sha in part.files.items()}
    check_made_alike(stored, plan.options.preset, {name: one.content_hash for name, one in plan.scenarios.items()}, weights, path)
    planned = {(cell.scene, cell.seed) for cell in plan.cells}
    return stored_side(stored.rows, baseline or plan.renderers[0].name, plan.policies[0].name, planned, max_missing, path)


def questions_of(metrics: Sequence[str], asked: Any, expected: float | None, method: Method | None) -> tuple[MetricQuestion, ...]:
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
            raise InputError(DOING, f"--metric {text}", f"margin {margin!r} is no number", "write NAME=MARGIN, as progress=0.05") from None
        found.append(metric_question(name, value, asked, expected, method=method))
    names = [one.metric for one in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(DOING, f"--metric {twice[0]}", "named twice", "name every metric once")
    return tuple(found)


def questions_of_gate(spec: GateSpec) -> tuple[MetricQuestion, ...]:
    """Return the questions that a gate's margins ask.

    Raises:
        InputError: The gate has no margin.
    """
    found = tuple(
        metric_question(name, rule.margin, "non-inferior", binding=rule.must_decide)
        for name, rule in spec.metrics.items()
        if rule.margin is not None
    )
    if not any(one.binding for one in found):
        raise InputError(DOING, "the gate", "no margin of it must be decided", "give it a metric with a margin, or judge a run without")
    return found


def controls_of(
    texts: Sequence[str], plan: RunPlan, question: Question, order: Order, stored: StoredSide | None = None
) -> dict[str, Control]:
    """Read ``--control``: ``family``, or run folders.

    Args:
        texts: What was given.
        plan: What may be driven.
        question: What is to be decided.
        order: Of the scenes.
        stored: The baseline's side, where it was driven earlier.

    Raises:
        InputError: Controls for the population ``scenes``, families that the order takes out already, or one that cannot be had.
    """
    if not texts:
        return {}
    if question.population != "suite":
        found = "the mean of a control over a population of scenes is not known"
        raise InputError(DOING, f"--control {texts[0]}", found, "ask about the suite itself with --population suite, or leave it out")
    if "family" in texts and order == "stratified":
        found = "with --order stratified, families are taken out by the order"
        raise InputError(DOING, "--control family", found, "leave out one of the two")
    scenes, baseline = list(plan.scenarios), str(plan.options.baseline) if stored is None else stored.renderer
    candidate = next(spec.name for spec in plan.renderers if stored is not None or spec.name != baseline)
    paths = {cell.scene: cell.ref.path for cell in plan.cells}
    out: dict[str, Control] = {}
    for text in texts:
        rows = None if text == "family" else rows_of_run(read_run(Path(text)))
        for one in question.metrics:
            made = control.of_families(paths) if rows is None else control.of_rows(rows, one.metric, scenes, candidate, baseline, text)
            out[one.metric] = control.join(out[one.metric], made) if one.metric in out else made
    return out


def default_folder(plan: RunPlan) -> Path:
    """Return the default folder of a decision; it depends on the command alone."""
    return Path("runs", f"decide-{slug(next(iter(plan.scenarios)))}-{plan.command_key}")


def decide_into(
    plan: RunPlan,
    question: Question,
    design: Design,
    controls: Mapping[str, Control],
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
        controls: From `controls_of`.
        root: Run folder; None: named after the command.
        quiet: No progress.
        stored: The baseline's side, where it was driven earlier.
        how: Further arguments of `execute_decision`.
    """
    plan = replace(plan, question=key_of(question, design, controls, stored))
    folder = root or default_folder(plan)
    progress = SilentLooks() if quiet else LookLines()
    try:
        return execute_decision(
            plan, question, design, folder, command=["simrun", *sys.argv[1:]], progress=progress, controls=controls, stored=stored, **how
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
        found = "scenes without a pair would be left out of the suite that is asked about"
        raise InputError(DOING, allowed_by, found, "leave it out, or ask with --population scenes")
    return text


def print_end(decided: Decided) -> None:
    """Print verdict, numbers and guarantee."""
    print(verdict_line(decided.record))
    for line in metric_lines(decided.record):
        print(line)
