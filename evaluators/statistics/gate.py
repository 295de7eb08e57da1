"""The gate: margins and limits as YAML (docs/gate-file.md); its verdict on a run, and the outcome that
follows.

A gate is about its suite (`evaluators.statistics.suite`), or about the scenes that the suite's
were drawn from (`evaluators.statistics.paired`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.files.config import (
    guess,
    load_yaml,
    own_or_shipped,
    shipped_names,
    validate,
)
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.log.run_folder.sides import RolloutTable, Side
from evaluators.metrics import METRICS, MetricInfo, MetricTable
from evaluators.metrics.measured import BEYOND
from evaluators.metrics.presets import DEFAULT, PRESETS
from evaluators.metrics.presets import preset as find_preset
from evaluators.results import Cause, Failures, Outcome, Verdict, to_json
from evaluators.statistics.numbers import plural, short
from evaluators.statistics.paired import compare, least_scenes
from evaluators.statistics.power import claim_size_text, size_text
from evaluators.statistics.sentences import change_text, difference_text
from evaluators.statistics.suite import (
    LISTED,
    NOISY_EVENTS,
    ROUNDING,
    Change,
    Noise,
    change_of,
    noises_of,
    ran,
    seeds_that_decide,
    verdict_of,
)
from evaluators.statistics.variants import (
    Base,
    Variant,
    as_policy,
    base_named,
    short_name,
    usual_base,
)
from evaluators.statistics.verdicts import outcome_of_failures, worst

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
    max_new: int | None = Field(
        default=None, ge=0, description="New events accepted; none: as the gate says."
    )
    must_decide: bool = Field(
        default=True, description="Undecided fails the gate with code 3; false: only worse does."
    )

    @model_validator(mode="after")
    def _says_something(self) -> MetricRule:
        if not self.is_paired and self.max is None and self.min is None:
            raise ValueError(
                "a rule without margin, max_new, max or min | add one of them, or remove the metric"
            )
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is above max {self.max:g} | swap them")
        return self

    @property
    def is_paired(self) -> bool:
        """Tell whether the rule compares with a baseline."""
        return self.margin is not None or self.max_new is not None

    def new_of(self, accepted: int) -> int:
        """Return the new events accepted: the rule's own number, or that of the gate."""
        return accepted if self.max_new is None else self.max_new

    def margin_of(self, metric: MetricInfo) -> float:
        """Return the accepted change: the rule's own, or what the metric names."""
        return metric.accepted if self.margin is None else self.margin


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
        default=(), description="Renderers to test; none: all but the baseline."
    )
    min_scenes: int = Field(default=1, ge=1, description="Fewest scenes that both sides must have.")
    population: Literal["suite", "scenes"] = Field(
        default="suite",
        description="suite: what changed in these scenes; scenes: the mean over all scenes that these were drawn from.",
    )
    max_new: int = Field(default=0, ge=0, description="New events accepted of a suite, per metric.")
    max_failed: float = Field(
        default=0.0, ge=0.0, lt=1.0, description="Share of rollouts that may fail to run."
    )
    max_missing: float = Field(
        default=0.0,
        ge=0.0,
        lt=1.0,
        description="Share of rollouts that may lack a pair, per metric.",
    )
    metrics: dict[str, MetricRule] = Field(default={}, min_length=1, description="Metric to rule.")
    max_beyond_measured: float | None = Field(
        default=None,
        ge=0.0,
        le=1.0,
        description="Largest mean share of steps beyond where what a renderer shows was compared with the truth.",
    )
    boundary_margin: float | None = Field(
        default=None,
        ge=0.0,
        description="How much more of the range of --vary may fail, in the parameter's unit, of two parameters as a share; in place of metrics.",
    )

    @model_validator(mode="after")
    def _decides_about_its_population(self) -> GateSpec:
        averages = bool(self.metrics) or self.max_beyond_measured is not None
        if averages == (self.boundary_margin is not None):
            raise ValueError(
                "a gate needs either metrics (or max_beyond_measured) or boundary_margin | points of a search are not averaged: write two gates"
            )
        if self.max_beyond_measured is not None and BEYOND in self.metrics:
            raise ValueError(f"max_beyond_measured and a rule for {BEYOND} | remove one of them")
        binding = [rule for rule in self.metrics.values() if rule.is_paired and rule.must_decide]
        if self.population == "scenes" and not binding:
            raise ValueError(
                "population: scenes without a margin that must be decided | limits and other rules are about the scenes of the run: add a margin, or use population: suite"
            )
        return self

    @property
    def is_paired(self) -> bool:
        """Tell whether any rule compares with a baseline."""
        return any(rule.is_paired for rule in self.metrics.values())


def load_gate(
    path_or_name: str | Path, metric_table: MetricTable = METRICS
) -> tuple[GateSpec, str]:
    """Read a gate file, or a shipped gate by name (``default``).

    Args:
        path_or_name: The file or the name.
        metric_table: The metrics that it may name: those of the run that it decides about.

    Returns:
        The gate and the file it came from.

    Raises:
        InputError: No such file, bad YAML, an unknown key, metric or preset: with file, line and
            column.
    """
    path = own_or_shipped(path_or_name, LIBRARY, "gate")
    document = load_yaml(path)
    spec = validate(GateSpec, document)
    for name, rule in spec.metrics.items():
        try:
            facts = metric_table.info(name)
        except (EvaluatorError, InputError) as error:
            raise document.error(
                ("metrics", name),
                f"no metric {name!r}",
                f"{guess(name, metric_table)}simrun list metrics prints the known ones",
            ) from error
        if rule.margin == 0.0 and facts.direction == "none":
            problem = f"a margin of 0 for {name!r}, which has no better side"
            raise document.error(
                ("metrics", name), problem, "give the change to either side that is accepted"
            )
        if rule.max_new is not None and not facts.is_flag:
            problem = f"max_new for {name!r}, which is no event"
            raise document.error(("metrics", name, "max_new"), problem, "give a margin")
    if spec.preset is not None and spec.preset not in PRESETS:
        hint = f"{guess(spec.preset, PRESETS)}known: {', '.join(PRESETS)}"
        raise document.error(("preset",), f"preset {spec.preset!r}", hint)
    return spec, str(path)


def shipped_gates() -> list[str]:
    """Return the names of the gates that come with the package."""
    return shipped_names(LIBRARY)


Kind = Literal["margin", "limit"]
Sides = Mapping[Variant, Side]
UNNAMED = MetricRule(margin=0.0)  # of an event that ends the scored part
SCENES = "about all scenes that these were drawn from"
SUITE = {
    True: "about these scenes and seeds: what changed is a fact",
    False: "about these scenes; the policy is not repeatable: events by exact tests over seeds, other metrics by the mean of drives cut at three margins",
    None: "about these scenes and seeds; run --repeat has not tried whether the policy is repeatable",
}
CAUSES: dict[Verdict, Cause] = {
    "non-inferior": "pass",
    "worse": "regression",
    "undecided": "undecided",
}


@dataclass(frozen=True)
class Check:
    """One metric of one renderer and policy against one rule."""

    renderer: str
    policy: str
    metric: str
    kind: Kind
    cause: Cause
    text: str  # one sentence with the numbers
    entry: JsonView  # the paired comparison, or mean and bounds
    binding: bool = True  # a check that does not bind leaves the gate open


@dataclass(frozen=True)
class GateVerdict:
    """Everything a gate found; `outcome` gives the exit code and the heading."""

    outcome: Outcome
    checks: tuple[Check, ...]
    failures: Failures
    baseline: str  # what was compared with, in words
    about: str  # what it is about, in words
    sizes: tuple[str, ...] = ()  # what pairs or scenes as many as these can show, in sentences
    accepts_failures: bool = False  # rollouts failed, and no more than the gate accepts

    @property
    def exit_code(self) -> int:
        """Give the process exit code."""
        return self.outcome.exit_code

    def with_outcome(self, outcome: Outcome) -> GateVerdict:
        """Return the verdict that follows where another outcome is known besides."""
        return replace(self, outcome=worst([self.outcome, outcome]))

    def as_dict(self) -> JsonObject:
        """Return the verdict for JSON."""
        checks = [asdict(check) for check in self.checks]
        return {
            "outcome": self.outcome.as_dict(),
            "baseline": self.baseline,
            "about": self.about,
            "sizes": list(self.sizes),
            "failures": {
                "n_rollouts": self.failures.n_rollouts,
                "n_failed": self.failures.n_failed,
                "by_class": self.failures.by_class,
            },
            "checks": checks,
        }


def check_gate(
    rollouts: RolloutTable,
    spec: GateSpec,
    stored: RolloutTable | None = None,
    stored_name: str = "",
    metric_table: MetricTable = METRICS,
    preset: str = DEFAULT,
    repeatable: bool | None = None,
) -> GateVerdict:
    """Decide a gate about rollouts.

    Args:
        rollouts: Every planned rollout of the run.
        spec: The gate.
        stored: A stored baseline; without it the baseline is a renderer of the run itself.
        stored_name: How to call the stored baseline.
        metric_table: What the metrics are.
        preset: With which both sides were scored.
        repeatable: What ``run --repeat`` found; False if either side's policy is not; None: not
            tried, and taken as repeatable.

    Raises:
        InputError: A renderer that the gate names is not there, nothing is left to compare, or the
            scenes are too few to pass a gate about others.
    """
    sides = _sides(rollouts)
    if not sides:
        raise InputError("its rollouts: there are none", "give a run with rollouts")
    baseline = _baseline(sides, spec, stored, stored_name)
    checks: list[Check] = []
    partners: set[Variant] = set()
    for variant in _tested_variants(list(sides), spec, baseline.in_the_run):
        side = sides[variant]
        name = variant.renderer if len(rollouts.policies) == 1 else variant.name
        if spec.is_paired or spec.baseline is not None or stored is not None:
            pair = baseline.pair(variant, side, name)
            partners.add(pair.partner)
            if spec.population == "scenes":
                checks += _of_scenes(pair, spec, metric_table)
            else:
                stops = find_preset(preset).stop_after
                checks += _of_suite(pair, spec, metric_table, stops, repeatable is False)
        checks += _limits(side, variant, name, spec, metric_table)
    failures = failures_of(rollouts)
    of_failures = outcome_of_failures(failures, spec.max_failed)
    outcomes = [Outcome(check.cause, (check.text,)) for check in checks if check.binding]
    outcomes.append(of_failures)
    if stored is not None:
        outcomes += _lost_variants(sides, baseline.sides, partners, spec)
    return GateVerdict(
        outcome=worst(outcomes),
        checks=tuple(checks),
        failures=failures,
        baseline=baseline.text,
        about=SCENES if spec.population == "scenes" else SUITE[repeatable],
        sizes=_sizes(checks, spec, metric_table, is_noisy=repeatable is False),
        accepts_failures=failures.n_failed > 0 and of_failures.cause == "pass",
    )


def _limits(
    side: Side, variant: Variant, name: str, spec: GateSpec, metric_table: MetricTable
) -> list[Check]:
    """Test the means of a variant against the limits that the gate sets."""
    checks = [
        _limit(side, variant, name, metric_table.info(metric), rule, spec)
        for metric, rule in spec.metrics.items()
        if rule.max is not None or rule.min is not None
    ]
    if spec.max_beyond_measured is not None:
        rule = MetricRule(max=spec.max_beyond_measured)
        # A rollout of which it is not known is never taken for one that stayed within.
        strict = spec.model_copy(update={"max_missing": 0.0})
        checks.append(_limit(side, variant, name, metric_table.info(BEYOND), rule, strict))
    return checks


def _sizes(
    checks: Sequence[Check], spec: GateSpec, metric_table: MetricTable, is_noisy: bool
) -> tuple[str, ...]:
    """Say what as many pairs or scenes as were compared can show about events, once for each number:
    variants may have different ones, and rules may accept different numbers of new events. Limits
    compare nothing.
    """
    member = "n_scenes" if spec.population == "scenes" else "n_cells"
    by_variant: dict[Variant, int] = {}
    for check in checks:
        if check.kind == "margin" and check.entry[member]:
            variant = Variant(check.renderer, check.policy)
            by_variant[variant] = max(by_variant.get(variant, 0), check.entry[member])
    numbers = sorted(set(by_variant.values()))
    if spec.population == "scenes":
        return tuple(claim_size_text(n) for n in numbers)
    accepted = {
        rule.new_of(spec.max_new)
        for name, rule in spec.metrics.items()
        if rule.is_paired and metric_table.info(name).is_flag
    }
    needed = {n_new + 1 for n_new in accepted or {spec.max_new}}
    if is_noisy:
        needed = {max(NOISY_EVENTS, n_new) for n_new in needed}
    return tuple(size_text(n, n_new, is_noisy) for n in numbers for n_new in sorted(needed))


def _sides(table: RolloutTable) -> Sides:
    """Return the rollouts of each variant, policy by policy."""
    return {
        Variant(renderer, policy): side
        for policy in table.policies
        for renderer, side in table.sides(policy).items()
    }


def failures_of(table: RolloutTable) -> Failures:
    """Count rollouts that did not run to their end, as summary.json does."""
    by_class = table.failures()
    return Failures(sum(by_class.values()), table.n_rollouts, by_class)


def _tested_variants(variants: list[Variant], spec: GateSpec, base: Base | None) -> list[Variant]:
    """Return the variants that a gate tests: those behind the renderers that it names, or all but
    the baseline.

    Args:
        variants: Of the run.
        spec: The gate.
        base: The baseline where it is one of them.

    Raises:
        InputError: A renderer that the gate names is not there, or nothing is left to compare.
    """
    renderers = {variant.renderer for variant in variants}
    absent = [name for name in spec.renderers if name not in renderers]
    if absent:
        raise InputError(
            f"renderers {absent}: the run has none of these",
            f"it has {', '.join(sorted(renderers))}",
        )
    if spec.renderers:
        return [variant for variant in variants if variant.renderer in spec.renderers]
    tested = [variant for variant in variants if base is None or base.of(variant) != variant]
    if not tested and spec.is_paired and base is not None:
        raise InputError(
            f"baseline {base.name!r}: the run has nothing else to compare with it",
            "run two renderers or two policies, or give --baseline-file",
        )
    return tested or variants  # a gate of limits alone needs no second variant


def _lost_variants(
    sides: Sides, base_sides: Sides, partners: set[Variant], spec: GateSpec
) -> list[Outcome]:
    """Return an incomplete outcome for each variant of a stored baseline that the run has lost.

    Args:
        sides, base_sides: Variants of the run and of the stored baseline.
        partners: Variants of the baseline that one of the run is compared with.
        spec: The gate; where it names renderers, others may be lost.
    """
    lost = [variant for variant in base_sides if variant not in sides and variant not in partners]
    if spec.renderers:
        lost = [variant for variant in lost if variant.renderer in spec.renderers]
    text = "the stored baseline has it and the run does not: drive it, or write a new baseline"
    return [Outcome("incomplete", (f"{variant.name}: {text}",)) for variant in lost]


@dataclass(frozen=True)
class _Baseline:
    """What the variants of a run are compared with.

    Attributes:
        sides: The variants to choose from: the run's own, or those of a stored baseline.
        base: Which one it is for each variant; None: the one of the same name.
        stored_name: How to call the stored baseline; None: the run's own variants are compared.
    """

    sides: Sides
    base: Base | None
    stored_name: str | None

    @property
    def owner(self) -> str:
        """Name whose variants these are, for errors."""
        return "the run" if self.stored_name is None else "the stored baseline"

    @property
    def in_the_run(self) -> Base | None:
        """Give the base if it is in the run, where it is not tested itself."""
        return self.base if self.stored_name is None else None

    @property
    def text(self) -> str:
        """Say what was compared with."""
        if self.stored_name is not None:
            return self.stored_name
        if self.base is None:
            return "limits alone"
        kind = ""
        if self.base.policy is None:
            kind = "renderer "
        elif self.base.renderer is None:
            kind = "policy "
        return f"{kind}{self.base.name} of the same run"

    def pair(self, variant: Variant, side: Side, name: str) -> _Pair:
        """Return a variant beside its partner.

        Args:
            variant: Of the run.
            side: Its rollouts.
            name: Of the variant in sentences.

        Raises:
            InputError: It has no partner.
        """
        partner = self.partner(variant)
        label = short_name(partner, variant)
        against = label
        if self.stored_name is not None:
            against += f" of {self.stored_name or 'the baseline'}"
        base_side = as_policy(self.sides[partner], variant.policy)
        return _Pair(variant, partner, name, side, base_side, label, against)

    def partner(self, variant: Variant) -> Variant:
        """Return the variant that a variant is compared with; of a stored baseline of one other
        policy, that policy's.

        Raises:
            InputError: There is none.
        """
        partner = variant if self.base is None else self.base.of(variant)
        policies = {other.policy for other in self.sides}
        if partner not in self.sides and self.base is None and len(policies) == 1:
            partner = Variant(variant.renderer, *policies)
        if partner not in self.sides:
            raise InputError(
                f"baseline {partner.name!r}: {self.owner} does not have it",
                f"`baseline` of the gate may be one of: {', '.join(other.name for other in self.sides)}",
            )
        return partner


def _baseline(
    sides: Sides, spec: GateSpec, stored: RolloutTable | None, stored_name: str
) -> _Baseline:
    """Return what a gate compares the variants of a run with: the baseline that it names; else, of
    a stored baseline, the variants of the same names, and of the run itself the usual one. Where
    a gate sets limits alone and there is one renderer, there is nothing to compare with.

    Raises:
        InputError: No variant has the name that the gate gives.
    """
    if stored is not None:
        baseline = _Baseline(_sides(stored), None, stored_name)
    else:
        is_one_renderer = len({variant.renderer for variant in sides}) == 1
        compares = spec.is_paired or not is_one_renderer
        baseline = _Baseline(sides, usual_base(list(sides)) if compares else None, None)
    if spec.baseline is None:
        return baseline
    base = base_named(spec.baseline, list(baseline.sides), baseline.owner)
    return replace(baseline, base=base)


@dataclass(frozen=True)
class _Pair:
    """A variant with its name in sentences, its partner in the baseline, the rollouts of both, and
    what the baseline is called in entries and in sentences.
    """

    variant: Variant
    partner: Variant
    name: str
    side: Side
    base: Side
    label: str
    against: str

    def check(
        self, metric: MetricInfo, cause: Cause, text: str, entry: JsonView, binding: bool
    ) -> Check:
        """Make the check of a metric."""
        renderer = self.variant.renderer
        policy = self.variant.policy
        sentence = f"{self.name}: {metric.name} against {self.against}: {text}"
        return Check(renderer, policy, metric.name, "margin", cause, sentence, entry, binding)


def _of_scenes(pair: _Pair, spec: GateSpec, metric_table: MetricTable) -> list[Check]:
    """Test what others of the population may show.

    Raises:
        InputError: There are too few scenes for any answer that passes.
    """
    check_number_of_scenes(
        spec,
        len({scene for _, scene, _ in set(pair.side.cells) & set(pair.base.cells)}),
        metric_table,
    )
    checks = []
    for name, rule in spec.metrics.items():
        if not rule.is_paired:
            continue
        metric = metric_table.info(name)
        margin = rule.margin_of(metric)
        entry = compare(pair.side, pair.base, metric, pair.label, margin)
        cause = CAUSES[entry.verdict]
        binding = rule.must_decide or cause == "regression"
        if entry.n_missing > spec.max_missing * (entry.n_cells + entry.n_missing):
            cause = "incomplete"
        text = f"{difference_text(entry, metric)}: {entry.verdict}"
        worst_cells = change_of(pair.side, pair.base, metric, margin, ()).worst()
        facts = to_json(entry) | {"worst": worst_cells}
        checks.append(pair.check(metric, cause, text, facts, binding))
    return checks


def check_number_of_scenes(
    spec: GateSpec, n_scenes: int, metric_table: MetricTable = METRICS
) -> None:
    """Refuse a number of scenes with which a gate cannot pass, whatever they show.

    Raises:
        InputError: There are fewer than `min_scenes`, or too few for a gate about other scenes.
    """
    if n_scenes < spec.min_scenes:
        raise InputError(
            f"{plural(n_scenes, 'scene')}, and the gate wants at least {spec.min_scenes}",
            "Name more scenes.",
        )
    if spec.population == "suite":
        return
    for name, rule in spec.metrics.items():
        if not rule.is_paired or not rule.must_decide:
            continue
        metric = metric_table.info(name)
        margin = rule.margin_of(metric)
        least = least_scenes(metric, margin) if margin else None
        if least is None or n_scenes < least:
            number = "no number of scenes passes" if least is None else f"it takes {least} to pass"
            raise InputError(
                f"{plural(n_scenes, 'scene')}, and a gate about other scenes: {number} {name} with margin {margin:g}",
                "Name more scenes, accept a larger margin, or use population: suite.",
            )


def _of_suite(
    pair: _Pair, spec: GateSpec, metric_table: MetricTable, stops: Sequence[str], is_noisy: bool
) -> list[Check]:
    """Say what changed in these scenes; an event that ends the scored part counts although the gate
    does not name it, since nothing after it was scored.
    """
    named = {name: rule for name, rule in spec.metrics.items() if rule.is_paired}
    rules = named | {stop: UNNAMED for stop in stops if stop not in named}
    changes = []
    for name in rules:
        metric = metric_table.info(name)
        margin = named[name].margin_of(metric) if name in named else metric.accepted
        changes.append(change_of(pair.side, pair.base, metric, margin, stops))
    noises: Sequence[Noise | None] = [None] * len(changes)
    if is_noisy and any(change.harms[0].any() or change.is_cut.any() for change in changes):
        noises = noises_of(changes, [rule.new_of(spec.max_new) for rule in rules.values()])
    checks = [
        _suite_check(pair, change, rule, noise, spec)
        for change, rule, noise in zip(changes, rules.values(), noises, strict=True)
    ]
    if _has_regression(checks):
        # It decides; the rollouts that it cut short need not be compared.
        checks = [replace(check, binding=check.binding and _is_compared(check)) for check in checks]
    named_checks = checks[: len(named)]
    if _has_regression(named_checks):
        return named_checks
    happened = [
        check
        for check, change in list(zip(checks, changes, strict=True))[len(named) :]
        if change.n_new > 0
    ]
    return named_checks + happened


def _has_regression(checks: Sequence[Check]) -> bool:
    return any(check.cause == "regression" for check in checks)


def _is_compared(check: Check) -> bool:
    """Tell whether pairs of rollouts were compared, or some that should be are missing."""
    return bool(check.entry["n_cells"] or check.entry["missing"])


def _suite_check(
    pair: _Pair, change: Change, rule: MetricRule, noise: Noise | None, spec: GateSpec
) -> Check:
    metric = change.metric
    verdict = verdict_of(change, rule.new_of(spec.max_new), noise)
    entry = _suite_entry(pair, change, rule.new_of(spec.max_new), noise, verdict)
    text = change_text(entry, metric)
    cause = CAUSES[verdict]
    n_cells = entry["n_cells"]
    n_missing = entry["n_missing"]
    is_missing = n_missing > spec.max_missing * (n_cells + n_missing)
    n_scenes = len({pair.side.scene[i] for i in np.flatnonzero(change.is_pair | change.is_cut)})
    if is_missing or not n_cells:
        cause = "incomplete"
    if n_scenes < spec.min_scenes:
        cause = "incomplete"
        text += f"; {plural(n_scenes, 'scene')} of at least {spec.min_scenes}"
    binding = rule.must_decide or is_missing or cause == "regression"
    return pair.check(metric, cause, text, entry, binding)


def _suite_entry(
    pair: _Pair, change: Change, max_new: int, noise: Noise | None, verdict: Verdict
) -> JsonObject:
    """Return what gate.json holds of the change of a metric in these scenes.

    Args:
        pair: Whose change it is.
        change: The change.
        max_new: How many new events are accepted.
        noise: What tells a change from chance; None: every change is a fact.
        verdict: What follows.
    """
    metric = change.metric
    n_cells = int(np.sum(change.is_pair))
    if metric.is_flag:
        counts = {"new": change.n_new, "gone": change.n_gone}
    else:
        counts = {"worse": int(np.sum(change.beyond(change.margin)))}
        counts["better"] = int(np.sum(change.harms[0] < -change.margin - ROUNDING))
    n_equal = n_cells - int(np.sum(change.harms[0] != 0.0))
    if not metric.is_flag:
        counts["within the margin"] = n_cells - n_equal - counts["worse"] - counts["better"]
    counts["equal"] = n_equal
    diff = 0.0 - change.mean if metric.direction == "higher" else change.mean
    return {
        "baseline": pair.label,
        "diff": diff if n_cells else None,
        "margin": change.margin,
        "max_new": max_new,
        "p_value": None if noise is None else noise.p_value,
        "cut_mean": None if noise is None else noise.cut_mean,
        "beyond": None if noise is None else noise.beyond,
        "verdict": verdict,
        "n_cells": n_cells,
        "n_scenes": len(change.by_scene(change.now)),
        "n_missing": len(change.missing),
        "n_neither": change.n_neither,
        "n_short": change.n_short,
        "n_far": 0 if metric.is_flag or noise is not None else change.n_far,
        "counts": counts,
        "worst": change.worst(),
        "cut": [
            f"{scene} seed {seed}"
            for (_, scene, seed), is_cut in zip(change.side.cells, change.is_cut, strict=True)
            if is_cut
        ],
        "missing": [to_json(missing) for missing in change.missing[:LISTED]],
        "seeds": seeds_that_decide(change) if verdict == "undecided" else None,
    }


def _limit(
    side: Side, variant: Variant, name: str, metric: MetricInfo, rule: MetricRule, spec: GateSpec
) -> Check:
    """Test the mean of a metric against its limits; a rollout that ran and has no value is missing,
    as a pair is.

    Args:
        side: The rollouts.
        variant: Whose they are.
        name: Of the variant in the sentence.
        metric: The metric.
        rule: Its limits.
        spec: What may be missing.
    """
    values = side.values(metric.name)
    is_valid = np.isfinite(values)
    valid_values = values[is_valid]
    n_ran = int(np.sum(ran(side)))
    n_missing = int(np.sum(ran(side) & ~is_valid))
    n_scenes = len(set(side.scene[is_valid].tolist()))
    mean = float(valid_values.mean()) if len(valid_values) else None
    cause: Cause = "incomplete"
    if mean is not None:
        is_above = rule.max is not None and mean > rule.max
        is_below = rule.min is not None and mean < rule.min
        cause = "regression" if is_above or is_below else "pass"
    bounds = {"max": rule.max, "min": rule.min}
    limits = " and ".join(f"{kind} {end:g}" for kind, end in bounds.items() if end is not None)
    mean_text = "no valid value" if mean is None else short(mean, metric.unit)
    text = f"{name}: {metric.name} {mean_text}, limit {limits}"
    is_missing = n_missing > spec.max_missing * n_ran
    if is_missing:
        cause = "incomplete"
        text += f"; valid in {len(valid_values)} of {plural(n_ran, 'rollout')}"
    if n_scenes < spec.min_scenes:
        cause = "incomplete"
        text += f"; {plural(n_scenes, 'scene')} of at least {spec.min_scenes}"
    worst_places = np.argsort(values if rule.max is None else -values)[: len(valid_values)].tolist()
    entry: JsonObject = {
        "mean": mean,
        **bounds,
        "n_rollouts": len(valid_values),
        "n_missing": n_missing,
    }
    entry["worst"] = [
        {"scene": side.cells[i][1], "seed": side.cells[i][2], "was": None, "now": values[i]}
        for i in worst_places[:LISTED]
    ]
    binding = rule.must_decide or is_missing or cause == "regression"
    return Check(
        variant.renderer, variant.policy, metric.name, "limit", cause, text, entry, binding
    )
