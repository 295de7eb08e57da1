"""The gate: margins, limits and the least amount of data as YAML (docs/ci.md); its verdict on a
run, and the outcome that follows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from alpasim_plugin.core.config import load_yaml, validate
from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.yaml_positions import Document
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
from evaluators.statistics.arms import Arm, Base, as_policy, base_named, short_name, usual_base
from evaluators.statistics.baselines import of_policy, policies_of
from evaluators.statistics.paired import compare, reach_of
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
    shipped = LIBRARY / f"{path_or_name}.yaml"
    path = next(
        (candidate for candidate in (Path(path_or_name), shipped) if candidate.is_file()), None
    )
    if path is None:
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
Sides = Mapping[str, Side]  # RENDERER -> its rollouts


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
    rows: Sequence[Row],
    spec: GateSpec,
    stored: Sequence[Row] | None = None,
    stored_name: str = "",
    known: MetricTable = METRICS,
) -> GateVerdict:
    """Judge rollout rows.

    Args:
        rows: Every planned rollout of the run (`rows_of_run`).
        spec: The gate.
        stored: Rows of a stored baseline; without it the baseline is a renderer of the run itself.
        stored_name: How to call the stored baseline.
        known: What the metrics are.

    Raises:
        InputError: A renderer that the gate names is not there, or nothing is left to judge.
    """
    return judge_sides(
        _sides(rows),
        failures_of(rows),
        spec,
        None if stored is None else _sides(stored),
        stored_name,
        known,
    )


def judge_table(
    table: RolloutTable,
    spec: GateSpec,
    stored: Sequence[Row] | None = None,
    stored_name: str = "",
    known: MetricTable = METRICS,
) -> GateVerdict:
    """Judge rollouts in columns; see `judge`."""
    by_class = table.failures()
    failures = {
        "n_rollouts": table.n_rollouts,
        "n_failed": sum(by_class.values()),
        "by_class": by_class,
    }
    sides = {policy: table.sides(policy) for policy in table.policies}
    return judge_sides(
        sides, failures, spec, None if stored is None else _sides(stored), stored_name, known
    )


def judge_sides(
    sides: Mapping[str, Sides],
    failures: Mapping[str, Any],
    spec: GateSpec,
    stored: Mapping[str, Sides] | None,
    stored_name: str,
    known: MetricTable = METRICS,
) -> GateVerdict:
    """Judge rollouts that are laid out by cell; see `judge`.

    Args:
        sides: POLICY -> RENDERER -> its rollouts, in order of appearance.
        failures: As `failures_of` gives them.
        spec, stored_name, known: As for `judge`.
        stored: The same of a stored baseline.
    """
    if not any(sides.values()):
        raise InputError("its rollouts: there are none", "give a run with rollouts")
    checks: list[Check] = []
    arms = [
        Arm(renderer, policy) for policy, by_renderer in sides.items() for renderer in by_renderer
    ]
    has_margin = any(rule.margin is not None for rule in spec.metrics.values())
    base, base_sides = _base(arms, spec, stored, has_margin), sides if stored is None else stored
    for arm in _judged(arms, spec, base, has_margin):
        side = sides[arm.policy][arm.renderer]
        other = _partner(arm, base, base_sides, stored is not None) if has_margin else arm
        behind = (
            as_policy(base_sides[other.policy][other.renderer], arm.policy) if has_margin else side
        )
        checks_of: dict[str, Check] = {}
        for wanted, rule in spec.metrics.items():
            metric = known.info(wanted)
            if rule.margin is not None:
                name = short_name(other, arm)
                against = (
                    name if stored is None else f"{name} of {stored_name or 'the baseline'}"
                )  # else it reads "clean against clean"
                checks_of[wanted] = _margin(
                    side, behind, (arm.renderer, arm.policy), name, against, metric, rule, spec
                )
            if rule.max is not None or rule.min is not None:
                checks.append(_limit(side, (arm.renderer, arm.policy), metric, rule))
        checks += [
            _with_event(check, checks_of, known) if spec.population == "scenes" else check
            for check in checks_of.values()
        ]
    causes = [
        Outcome(check.cause, (check.text,))
        for check in checks
        if check.binding or check.cause == "regression"
    ]
    outcome = worst([outcome_of_failures(failures, spec.max_failed), *causes])
    kind = (
        ""
        if base is None or (base.renderer and base.policy)
        else "renderer "
        if base.renderer
        else "policy "
    )
    name = (
        stored_name if base is None or stored is not None else f"{kind}{base.name} of the same run"
    )
    return GateVerdict(outcome, tuple(checks), failures, name)


def _sides(rows: Sequence[Row]) -> dict[str, Sides]:
    return {policy: by_renderer(of_policy(rows, policy)) for policy in policies_of(rows)}


def failures_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Count rollouts that did not run to their end, as summary.json does."""
    by_class: dict[str, int] = {}
    for row in rows:
        if not is_ok(row):
            by_class[failure_of(row)] = by_class.get(failure_of(row), 0) + 1
    return {"n_rollouts": len(rows), "n_failed": sum(by_class.values()), "by_class": by_class}


def _base(
    arms: Sequence[Arm], spec: GateSpec, stored: Mapping[str, Sides] | None, has_margin: bool
) -> Base | None:
    """Return what arms are compared with; None: with the same arm of a stored baseline, or limits
    alone hold for all policies.
    """
    if spec.baseline is None:
        by_policy_alone = len({arm.renderer for arm in arms}) == 1 and not has_margin
        return None if stored is not None or by_policy_alone else usual_base(arms)
    arms_there = (
        arms
        if stored is None
        else [
            Arm(renderer, policy)
            for policy, by_renderer in stored.items()
            for renderer in by_renderer
        ]
    )
    return base_named(
        spec.baseline, arms_there, "the run" if stored is None else "the stored baseline"
    )


def _judged(arms: Sequence[Arm], spec: GateSpec, base: Base | None, has_margin: bool) -> list[Arm]:
    known = {arm.renderer for arm in arms}
    absent = [name for name in spec.renderers if name not in known]
    if absent:
        raise InputError(
            f"renderers {absent}: the run has none of these",
            f"it has {', '.join(sorted(known))}",
        )
    if spec.renderers:
        return [arm for arm in arms if arm.renderer in spec.renderers]
    judged = [arm for arm in arms if base is None or base.of(arm) != arm]
    if not judged and has_margin and base is not None:
        raise InputError(
            f"baseline {base.name!r}: the run has nothing else to compare with it",
            "run two renderers or two policies, or give --baseline-file",
        )
    return judged or list(arms)  # a gate of limits alone needs no second arm


def _partner(arm: Arm, base: Base | None, stored: Mapping[str, Sides], is_stored: bool) -> Arm:
    """Return the arm that an arm is compared with; of a stored baseline of one other policy, that
    policy's.

    Raises:
        InputError: There is none.
    """
    known = [
        Arm(renderer, policy) for policy, by_renderer in stored.items() for renderer in by_renderer
    ]
    wanted = arm if base is None else base.of(arm)
    if wanted not in known and base is None and len(stored) == 1:
        wanted = Arm(arm.renderer, next(iter(stored)))
    if wanted in known:
        return wanted
    where = "the stored baseline" if is_stored else "the run"
    names = ", ".join(arm_known.name for arm_known in known)
    raise InputError(
        f"baseline {wanted.name!r}: {where} does not have it",
        f"`baseline` of the gate may be one of: {names}",
    )


def _margin(
    side: Side,
    base: Side,
    variant: tuple[str, str],
    name: str,
    against: str,
    metric: MetricInfo,
    rule: MetricRule,
    spec: GateSpec,
) -> Check:
    entry = compare(
        side, base, metric, name, rule.margin or 0.0, sampled=spec.population == "scenes"
    )
    planned = entry["n_cells"] + entry["n_missing"]
    cause: Cause = {"non-inferior": "pass", "worse": "regression", "undecided": "undecided"}[
        entry["verdict"]
    ]  # type: ignore[assignment]
    text = _paired_text(entry, metric.name, variant[0], against)
    least = scenes_without_event(entry["margin"], reach_of(metric, entry["margin"])) or 0
    if entry["n_scenes"] < spec.min_scenes:
        cause = "undecided"
        text += f"; {entry['n_scenes']} scene{'' if entry['n_scenes'] == 1 else 's'}, the gate asks for {spec.min_scenes}"
    elif cause == "undecided" and entry["n_scenes"] < least:
        text += f"; fewer than {least} scenes cannot exclude harm in others"
    elif cause != "regression" and entry["n_missing"] > spec.max_missing * planned:
        cause = "undecided"
        text += f"; {entry['n_missing']} of {planned} cells have no pair, the gate allows {spec.max_missing:.0%}"
    return Check(*variant, metric.name, "margin", cause, text, entry, rule.must_decide)


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


def _limit(side: Side, variant: tuple[str, str], metric: MetricInfo, rule: MetricRule) -> Check:
    values = side.values(metric.name)
    known = values[np.isfinite(values)]
    bounds = {"max": rule.max, "min": rule.min}
    limits = " and ".join(
        f"{kind} {value:g}" for kind, value in bounds.items() if value is not None
    )
    if not len(known):
        text = f"{variant[0]}: {metric.name} has no valid value, its limit is {limits}"
        return Check(
            *variant,
            metric.name,
            "limit",
            "undecided",
            text,
            {"mean": None, **bounds},
            rule.must_decide,
        )
    mean = float(known.mean())
    broken = (rule.max is not None and mean > rule.max) or (
        rule.min is not None and mean < rule.min
    )
    text = f"{variant[0]}: {metric.name} {_number(mean, metric.unit)}, limit {limits}"
    return Check(
        *variant,
        metric.name,
        "limit",
        "regression" if broken else "pass",
        text,
        {"mean": mean, **bounds, "n_rollouts": len(known)},
    )


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
        more = entry["more_scenes"]
        text += (
            f", about {more} more scenes would decide it"
            if more
            else ", more scenes of this kind would not decide it"
        )
    return text


def _number(value: float, unit: str, sign: bool = False) -> str:
    text = f"{value:+.4g}" if sign else f"{value:.4g}"
    return f"{text} {unit}".rstrip()
