"""Paired differences within a run, or between two runs on the cells that both have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.schema import cell_name
from alpasim_plugin.log.run_folder.sides import RolloutTable
from evaluators.metrics import METRICS, MetricTable
from evaluators.opening import Run
from evaluators.statistics.arms import arms_of, axis_bases, base_named, choices
from evaluators.statistics.baselines import check_scenes, scene_hashes, table_of_run
from evaluators.statistics.paired import LISTED, compare
from evaluators.statistics.summary import paired_arms


@dataclass(frozen=True)
class Comparison:
    """Paired differences.

    Attributes:
        paired: VARIANT -> METRIC -> what `statistics.paired.compare` gives; a variant is RENDERER,
            or RENDERER/POLICY where there are several policies.
        with_base: The same of renderers with a fixer against the renderer below it, where that is
            not the baseline.
        metrics: What the metrics are.
        arms: The same of policies behind one renderer, RENDERER/POLICY -> METRIC; empty where one
            arm is the baseline of all.
        notes: What a reader must know, such as policies that were paired although their names
            differ.
    """

    paired: Mapping[str, Mapping[str, Mapping[str, Any]]]
    notes: tuple[str, ...] = field(default=())
    with_base: Mapping[str, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)
    metrics: MetricTable = field(default_factory=lambda: METRICS)
    arms: Mapping[str, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)


def compare_within(
    run: Run,
    baseline: str | None = None,
    margins: Mapping[str, float] | None = None,
    listed: int = LISTED,
) -> Comparison:
    """Compare the arms of one run with one of them, by default with the run's own baseline, or with
    the first.

    Args:
        run: The run.
        baseline: RENDERER, POLICY or RENDERER/POLICY; None: renderers with the run's own, and
            policies too where there are several.
        margins, listed: As for `evaluators.statistics.paired.paired`.

    Raises:
        InputError: Only one arm, or an unknown baseline.
    """
    table = table_of_run(run)
    arms = arms_of((r, policy) for policy in table.policies for r in table.sides(policy))
    where, known = str(run.folder), table.renderers
    base = None if baseline is None else base_named(baseline, arms, where)
    if len(arms) < 2:
        only = arms[0].name if arms else "none"
        raise InputError(
            f"{where}: only one arm, {only}",
            "name a second run, or run two renderers or two policies",
        )
    if base is not None and base.policy is not None:
        return Comparison(
            paired_arms(table, base.pairs(arms), run.table, margins=margins, listed=listed),
            metrics=run.table,
        )
    by_renderer, by_policy = axis_bases(
        arms, baseline or (run.info.get("config") or {}).get("baseline")
    )
    if base is not None and by_renderer is None:
        raise InputError(
            f"{where}: only one renderer, {known[0]}",
            f"choose one of {', '.join(choices(arms))}",
        )
    name = "" if by_renderer is None else by_renderer.renderer
    bases = {
        fixed: below
        for fixed, below in (run.info.get("bases") or {}).items()
        if fixed in known and below in known
    }
    partner = {other: str(name) for other in known if name and other != name}
    below = {fixed: other for fixed, other in bases.items() if name not in (fixed, other)}
    pairs = _pairs(table, table, partner, "", margins, run.table, listed)
    with_base = (
        {} if baseline is not None else _pairs(table, table, below, "", margins, run.table, listed)
    )
    between = [] if baseline is not None or by_policy is None else by_policy.pairs(arms)
    of_policies = paired_arms(table, between, run.table, margins=margins, listed=listed)
    return Comparison(pairs, (), with_base, run.table, of_policies)


def compare_runs(
    first: Run,
    second: Run,
    baseline: str | None = None,
    margins: Mapping[str, float] | None = None,
    listed: int = LISTED,
) -> Comparison:
    """Compare the second run with the first: each arm with the one of the same name, or all with
    ``baseline`` of the first run.

    A policy is paired with the policy of the same name; where the runs share none and have one
    each, with the other's. A baseline is a RENDERER, a POLICY or a RENDERER/POLICY of the first
    run.

    Raises:
        InputError: The runs differ in preset or in a scene's content, share no scene, a renderer or
            policy has no partner, or a metric is another quantity in the other run.
    """
    both = f"{first.folder} and {second.folder}"
    presets = [str(run.summary.get("preset")) for run in (first, second)]
    if presets[0] != presets[1]:
        raise InputError(
            f"{both}: presets {presets[0]!r} and {presets[1]!r}",
            "give the command of one run again with --preset",
        )
    check_scenes(
        scene_hashes(first), scene_hashes(second), both, "run both on the same scene files"
    )
    table, base = table_of_run(second), table_of_run(first)
    partner_of = {policy: policy for policy in table.policies if policy in base.policies}
    notes: tuple[str, ...] = ()
    if not partner_of and not _names_policy(baseline, base):
        theirs, ours = base.policies, table.policies
        if len(theirs) != 1 or len(ours) != 1:
            raise InputError(
                f"policies {theirs} and {ours}: none in common",
                "compare runs of one policy each or of the same policies, or name one with --baseline RENDERER/POLICY",
            )
        partner_of, notes = (
            {ours[0]: theirs[0]},
            (f"policy {ours[0]} is compared with policy {theirs[0]}",),
        )
    base_renderers, renderers = base.renderers, table.renderers
    notes += weights_note(first, second)
    if baseline is not None:
        theirs_arms = arms_of((r, policy) for policy in base.policies for r in base.sides(policy))
        named = base_named(baseline, theirs_arms, str(first.folder))
        if named.policy is not None:
            own_arms = arms_of(
                (r, policy) for policy in table.policies for r in table.sides(policy)
            )
            chosen_arms = [(arm, named.of(arm)) for arm in own_arms if named.of(arm) in theirs_arms]
            if not chosen_arms:
                raise InputError(
                    f"baseline {baseline!r}: behind no renderer of {second.folder}",
                    "name RENDERER/POLICY",
                )
            metrics = second.table.joined(first.table, {*table.metrics} & {*base.metrics}, both)
            pairs = paired_arms(
                table, chosen_arms, metrics, base, margins, listed, f"{first.folder}: "
            )
            return Comparison(pairs, weights_note(first, second), metrics=metrics)
    alone = base_renderers[0] if len(base_renderers) == 1 else None
    partner = {name: baseline or (name if name in base_renderers else alone) for name in renderers}
    lone = [name for name, other in partner.items() if other is None]
    if lone:
        raise InputError(
            f"renderers {lone} of {second.folder}: {first.folder} has {', '.join(base_renderers)}",
            "name one by --baseline",
        )
    chosen = {name: other for name, other in partner.items() if other is not None}
    metrics = second.table.joined(first.table, {*table.metrics} & {*base.metrics}, both)
    return Comparison(
        _pairs(table, base, chosen, f"{first.folder}: ", margins, metrics, listed, partner_of),
        notes,
        metrics=metrics,
    )


def weights_note(first: Run, second: Run) -> tuple[str, ...]:
    """Say which files of weights are not the same in two runs: their arms differ in these, whatever
    their names.
    """
    before, after = (dict(run.info.get("weights") or {}) for run in (first, second))
    changed = sorted(name for name in before.keys() & after.keys() if before[name] != after[name])
    return (f"other weights: {', '.join(changed)}",) if changed else ()


def _names_policy(baseline: str | None, table: RolloutTable) -> bool:
    """Tell whether a baseline says with which policy to compare."""
    arms = arms_of((r, policy) for policy in table.policies for r in table.sides(policy))
    return (
        baseline in {*table.policies, *(arm.name for arm in arms)}
        and baseline not in table.renderers
    )


def _pairs(
    table: RolloutTable,
    base: RolloutTable,
    partner: Mapping[str, str],
    prefix: str,
    margins: Mapping[str, float] | None,
    metrics: MetricTable,
    listed: int,
    policy_of: Mapping[str, str] | None = None,
) -> dict[str, dict[str, Any]]:
    """Compare renderers with their partners, policy by policy.

    Args:
        table: The rollouts that are compared.
        base: Those that they are compared with.
        partner: RENDERER of ``table`` -> renderer of ``base``.
        prefix: Of the partner's name.
        margins, listed: As for `compare_runs`.
        metrics: What the metrics are.
        policy_of: POLICY of ``table`` -> policy of ``base``; None: the same.
    """
    out: dict[str, dict[str, Any]] = {}
    for policy in table.policies:
        of_base = policy if policy_of is None else policy_of.get(policy)
        sides, base_sides = (
            table.sides(policy),
            base.sides(of_base, policy) if of_base in base.policies else {},
        )
        for renderer, other in partner.items():
            if renderer in sides and other in base_sides:
                variant = renderer if len(table.policies) == 1 else cell_name(renderer, policy)
                out[variant] = {
                    name: compare(
                        sides[renderer],
                        base_sides[other],
                        metrics.info(name),
                        prefix + other,
                        (margins or {}).get(name),
                        listed,
                    )
                    for name in dict.fromkeys([*table.metrics, *base.metrics])
                }
    return out
