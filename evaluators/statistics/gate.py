"""The gate: margins, limits and the least amount of data as YAML (docs/ci.md); its verdict on a
run, and the outcome that follows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from alpasim_plugin.core.config import Document, load_yaml, validate
from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.log.run_folder.sides import (
    RolloutTable,
    Row,
    Side,
    by_renderer,
    failure_of,
    is_ok,
)
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.metrics.presets import PRESETS
from evaluators.statistics.baselines import of_policy, policies_of
from evaluators.statistics.paired import compare, reach_of
from evaluators.statistics.variants import (
    Base,
    Variant,
    as_policy,
    base_named,
    short_name,
    usual_base,
)
from evaluators.statistics.verdicts import (
    Cause,
    Outcome,
    outcome_of_failures,
    scenes_without_event,
    worst,
)

LIBRARY = Path(__file__).resolve().parents[2] / "configs" / "gates"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class MetricRule(_Strict):
    """What one metric must meet: a margin on the paired difference, limits on the mean, or both."""

    margin: float | None = Field(
        default=None,
        ge=0.0,
        description="How much worse is accepted (without a better side: either way).",
    )
    max: float | None = Field(default=None, description="Largest mean accepted.")
    min: float | None = Field(default=None, description="Smallest mean accepted.")
    must_decide: bool = Field(
        default=True, description="Undecided fails the gate with code 3; false: only worse does."
    )

    @model_validator(mode="after")
    def _says_something(self) -> MetricRule:
        if self.margin is None and self.max is None and self.min is None:
            raise ValueError(
                "a rule without margin, max or min | add one of them, or remove the metric"
            )
        return self


class GateSpec(_Strict):
    """A gate file."""

    version: Literal[1] = Field(description="Version of this schema: 1.")
    description: str = Field(default="", description="One sentence for people.")
    preset: str | None = Field(
        default=None, description="Evaluator preset that the run must have been scored with."
    )
    baseline: str | None = Field(
        default=None,
        description="RENDERER, POLICY or both with a slash to compare with; none: the first, or the same of a stored baseline.",
    )
    renderers: tuple[str, ...] = Field(
        default=(), description="Renderers to judge; none: all but the baseline."
    )
    min_scenes: int = Field(
        default=2, ge=2, description="Fewest scenes with a pair that a paired verdict may stand on."
    )
    population: Literal["scenes", "suite"] = Field(
        default="scenes",
        description="suite: these scenes are all that is asked about; else they are draws, and others may be far worse.",
    )
    max_failed: float = Field(
        default=0.0, ge=0.0, lt=1.0, description="Share of rollouts that may fail to run."
    )
    max_missing: float = Field(
        default=0.0, ge=0.0, lt=1.0, description="Share of cells that may lack a pair, per metric."
    )
    metrics: dict[str, MetricRule] = Field(min_length=1, description="Metric to rule.")


def load_gate(path_or_name: str | Path, known: MetricTable = METRICS) -> tuple[GateSpec, str]:
    """Read a gate file, or a shipped gate by name (``default``).

    Args:
        path_or_name: The file or the name.
        known: The metrics that it may name: those of the run that it judges.

    Returns:
        The gate and the file it came from.

    Raises:
        InputError: No such file, bad YAML, an unknown key, metric or preset: with file, line and
            column.
    """
    path = Path(path_or_name)
    if not path.is_file():
        path = LIBRARY / f"{path_or_name}.yaml"
    if not path.is_file():
        raise InputError(
            f"{path_or_name}: no such file",
            f"name a YAML file, or a shipped gate: {', '.join(shipped_gates())}",
        )
    document = load_yaml(path)
    spec = validate(GateSpec, document)
    _check_names(spec, document, known)
    return spec, str(path)


def shipped_gates() -> list[str]:
    """Return the names of the gates that come with the package."""
    return sorted(path.stem for path in LIBRARY.glob("*.yaml"))


def _check_names(spec: GateSpec, document: Document, known: MetricTable) -> None:
    for name, rule in spec.metrics.items():
        try:
            facts = known.info(name)
        except (EvaluatorError, InputError) as error:
            raise document.error(
                ("metrics", name),
                f"no metric {name!r}",
                "simrun list metrics prints the known ones",
            ) from error
        if rule.margin == 0.0 and facts.direction == "none":
            problem = f"a margin of 0 for {name!r}, which has no better side"
            raise document.error(
                ("metrics", name), problem, "give the change to either side that is accepted"
            )
    if spec.preset is not None and spec.preset not in PRESETS:
        raise document.error(("preset",), f"preset {spec.preset!r}", f"known: {', '.join(PRESETS)}")


Kind = Literal["margin", "limit"]
Sides = Mapping[Variant, Side]
CAUSES: dict[str, Cause] = {"non-inferior": "pass", "worse": "regression", "undecided": "undecided"}


@dataclass(frozen=True)
class Check:
    """One metric of one renderer and policy against one rule."""

    renderer: str
    policy: str
    metric: str
    kind: Kind
    cause: Cause
    text: str  # one sentence with the numbers
    entry: Mapping[str, Any]  # the paired comparison, or mean and bounds
    binding: bool = True  # an undecided check that does not bind leaves the gate open


@dataclass(frozen=True)
class GateVerdict:
    """Everything a gate found; `outcome` gives the exit code and the heading."""

    outcome: Outcome
    checks: tuple[Check, ...]
    failures: Mapping[str, Any]
    baseline: str  # what was compared with, in words

    @property
    def exit_code(self) -> int:
        """Give the process exit code."""
        return self.outcome.exit_code

    def as_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        checks = [asdict(check) for check in self.checks]
        return {
            "outcome": self.outcome.as_dict(),
            "baseline": self.baseline,
            "failures": dict(self.failures),
            "checks": checks,
        }


def judge(
    rollouts: RolloutTable | Sequence[Row],
    spec: GateSpec,
    stored: Sequence[Row] | None = None,
    stored_name: str = "",
    known: MetricTable = METRICS,
) -> GateVerdict:
    """Judge rollouts.

    Args:
        rollouts: Every planned rollout of the run, in columns or as rows (`rows_of_run`).
        spec: The gate.
        stored: Rows of a stored baseline; without it the baseline is a renderer of the run itself.
        stored_name: How to call the stored baseline.
        known: What the metrics are.

    Raises:
        InputError: A renderer that the gate names is not there, or nothing is left to judge.
    """
    sides = _sides(rollouts)
    if not sides:
        raise InputError("its rollouts: there are none", "give a run with rollouts")
    owner = "the run" if stored is None else "the stored baseline"
    base_sides = sides if stored is None else _sides(stored)
    has_margin = any(rule.margin is not None for rule in spec.metrics.values())
    base = _base(list(sides), spec, list(base_sides), owner, has_margin)
    checks: list[Check] = []
    for variant in _judged(list(sides), spec, base, has_margin):
        side = sides[variant]
        margins: dict[str, Check] = {}
        for name, rule in spec.metrics.items():
            metric = known.info(name)
            if rule.margin is not None:
                other = _partner(variant, base, list(base_sides), owner)
                label = short_name(other, variant)
                other_side = as_policy(base_sides[other], variant.policy)
                is_sampled = spec.population == "scenes"
                entry = compare(side, other_side, metric, label, rule.margin, sampled=is_sampled)
                if stored is not None:
                    label += f" of {stored_name or 'the baseline'}"
                margins[name] = _margin(entry, variant, label, metric, rule, spec)
            if rule.max is not None or rule.min is not None:
                checks.append(_limit(side, variant, metric, rule))
        if spec.population == "scenes":
            checks += [_with_event(check, margins, known) for check in margins.values()]
        else:
            checks += margins.values()
    failures = failures_of(rollouts)
    outcomes = [
        Outcome(check.cause, (check.text,))
        for check in checks
        if check.binding or check.cause == "regression"
    ]
    outcomes.append(outcome_of_failures(failures, spec.max_failed))
    name = stored_name
    if base is not None and stored is None:
        kind = "" if base.renderer and base.policy else "renderer " if base.renderer else "policy "
        name = f"{kind}{base.name} of the same run"
    return GateVerdict(worst(outcomes), tuple(checks), failures, name)


def _sides(rollouts: RolloutTable | Sequence[Row]) -> Sides:
    """Return the rollouts of each variant, policy by policy."""
    if isinstance(rollouts, RolloutTable):
        by_policy = {policy: rollouts.sides(policy) for policy in rollouts.policies}
    else:
        by_policy = {
            policy: by_renderer(of_policy(rollouts, policy)) for policy in policies_of(rollouts)
        }
    return {
        Variant(renderer, policy): side
        for policy, sides in by_policy.items()
        for renderer, side in sides.items()
    }


def failures_of(rollouts: RolloutTable | Sequence[Row]) -> dict[str, Any]:
    """Count rollouts that did not run to their end, as summary.json does."""
    if isinstance(rollouts, RolloutTable):
        n, by_class = rollouts.n_rollouts, rollouts.failures()
    else:
        n = len(rollouts)
        by_class = dict(Counter(failure_of(row) for row in rollouts if not is_ok(row)))
    return {"n_rollouts": n, "n_failed": sum(by_class.values()), "by_class": by_class}


def _base(
    variants: list[Variant], spec: GateSpec, others: list[Variant], owner: str, has_margin: bool
) -> Base | None:
    """Return what variants are compared with; None: with the same variant of a stored baseline, or
    limits alone hold for all policies.
    """
    if spec.baseline is not None:
        return base_named(spec.baseline, others, owner)
    is_one_renderer = len({variant.renderer for variant in variants}) == 1
    if owner != "the run" or (is_one_renderer and not has_margin):
        return None
    return usual_base(variants)


def _judged(
    variants: list[Variant], spec: GateSpec, base: Base | None, has_margin: bool
) -> list[Variant]:
    known = {variant.renderer for variant in variants}
    absent = [name for name in spec.renderers if name not in known]
    if absent:
        raise InputError(
            f"renderers {absent}: the run has none of these",
            f"it has {', '.join(sorted(known))}",
        )
    if spec.renderers:
        return [variant for variant in variants if variant.renderer in spec.renderers]
    judged = [variant for variant in variants if base is None or base.of(variant) != variant]
    if not judged and has_margin and base is not None:
        raise InputError(
            f"baseline {base.name!r}: the run has nothing else to compare with it",
            "run two renderers or two policies, or give --baseline-file",
        )
    return judged or variants  # a gate of limits alone needs no second variant


def _partner(variant: Variant, base: Base | None, others: list[Variant], owner: str) -> Variant:
    """Return the variant that a variant is compared with; of a stored baseline of one other policy,
    that policy's.

    Raises:
        InputError: There is none.
    """
    wanted = variant if base is None else base.of(variant)
    policies = {other.policy for other in others}
    if wanted not in others and base is None and len(policies) == 1:
        wanted = Variant(variant.renderer, *policies)
    if wanted not in others:
        raise InputError(
            f"baseline {wanted.name!r}: {owner} does not have it",
            f"`baseline` of the gate may be one of: {', '.join(other.name for other in others)}",
        )
    return wanted


def _margin(
    entry: dict[str, Any],
    variant: Variant,
    against: str,
    metric: MetricInfo,
    rule: MetricRule,
    spec: GateSpec,
) -> Check:
    n_scenes, n_missing = entry["n_scenes"], entry["n_missing"]
    planned = entry["n_cells"] + n_missing
    cause = CAUSES[entry["verdict"]]
    text = _paired_text(entry, metric.name, variant.renderer, against)
    least = scenes_without_event(entry["margin"], reach_of(metric, entry["margin"])) or 0
    if n_scenes < spec.min_scenes:
        cause = "undecided"
        scenes = "1 scene" if n_scenes == 1 else f"{n_scenes} scenes"
        text += f"; {scenes}, the gate asks for {spec.min_scenes}"
    elif cause == "undecided" and n_scenes < least:
        text += f"; fewer than {least} scenes cannot exclude harm in others"
    elif cause != "regression" and n_missing > spec.max_missing * planned:
        cause = "undecided"
        allowed = f"the gate allows {spec.max_missing:.0%}"
        text += f"; {n_missing} of {planned} cells have no pair, {allowed}"
    return _check(variant, metric, "margin", cause, text, entry, rule.must_decide)


def _check(variant: Variant, metric: MetricInfo, *facts: Any) -> Check:
    return Check(variant.renderer, variant.policy, metric.name, *facts)


def _with_event(check: Check, checks: Mapping[str, Check], known: MetricTable) -> Check:
    """Return the check of a distance, which passes only together with the event that counts what
    lies beyond its cap.
    """
    event = known.info(check.metric).event
    if check.cause != "pass" or not event or (event in checks and checks[event].cause == "pass"):
        return check
    why = (
        f"{event} is {checks[event].entry['verdict']}"
        if event in checks
        else f"the gate has no margin for {event}"
    )
    return replace(
        check,
        cause="undecided",
        text=f"{check.text}, but a distance decides only together with its event: {why}",
    )


def _limit(side: Side, variant: Variant, metric: MetricInfo, rule: MetricRule) -> Check:
    values = side.values(metric.name)
    known = values[np.isfinite(values)]
    bounds = {"max": rule.max, "min": rule.min}
    limits = " and ".join(
        f"{kind} {value:g}" for kind, value in bounds.items() if value is not None
    )
    head = f"{variant.renderer}: {metric.name}"
    if not len(known):
        text = f"{head} has no valid value, its limit is {limits}"
        entry = {"mean": None, **bounds}
        return _check(variant, metric, "limit", "undecided", text, entry, rule.must_decide)
    mean = float(known.mean())
    is_above = rule.max is not None and mean > rule.max
    is_below = rule.min is not None and mean < rule.min
    cause = "regression" if is_above or is_below else "pass"
    text = f"{head} {_number(mean, metric.unit)}, limit {limits}"
    entry = {"mean": mean, **bounds, "n_rollouts": len(known)}
    return _check(variant, metric, "limit", cause, text, entry)


def _paired_text(entry: Mapping[str, Any], metric: str, renderer: str, against: str) -> str:
    unit = entry["unit"]
    head = f"{renderer}: {metric}"
    if entry["diff"] is None:
        return f"{head} cannot be compared with {against}: {entry['reason']}"
    text = f"{head} {_number(entry['diff'], unit, sign=True)} against {against}"
    if entry["ci95"] is None:
        return f"{text}: {entry['reason']}"
    low, high = (_number(b, unit, sign=True) for b in entry["ci95"])
    text += f" (95 % {low} to {high}, margin {_number(entry['margin'], unit)}): {entry['verdict']}"
    if entry["verdict"] == "undecided":
        if entry["more_scenes"]:
            text += f", about {entry['more_scenes']} more scenes would decide it"
        else:
            text += ", more scenes of this kind would not decide it"
    return text


def _number(value: float, unit: str, sign: bool = False) -> str:
    text = f"{value:+.4g}" if sign else f"{value:.4g}"
    return f"{text} {unit}".rstrip()
