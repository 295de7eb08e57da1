"""Paired differences within a run, or between two runs on the cells that both have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.run_folder.columns import RolloutTable
from alpasim_plugin.run_folder.schema import cell_name
from evaluators.metrics import METRICS, MetricTable
from evaluators.opening import Run
from evaluators.statistics.baselines import check_scenes, scene_hashes, table_of_run
from evaluators.statistics.paired import LISTED, compare

DOING = "comparing runs"


@dataclass(frozen=True)
class Comparison:
    """Paired differences.

    Attributes:
        paired: VARIANT -> METRIC -> what `statistics.paired.compare` gives; a variant is RENDERER, or RENDERER/POLICY where there are
            several policies.
        with_base: The same of renderers with a fixer against the renderer below it, where that is not the baseline.
        metrics: What the metrics are.
        notes: What a reader must know, such as policies that were paired although their names differ.
    """

    paired: Mapping[str, Mapping[str, Mapping[str, Any]]]
    notes: tuple[str, ...] = field(default=())
    with_base: Mapping[str, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)
    metrics: MetricTable = field(default_factory=lambda: METRICS)


def compare_within(run: Run, baseline: str | None = None, margins: Mapping[str, float] | None = None, listed: int = LISTED) -> Comparison:
    """Compare the renderers of one run with one of them, by default the run's own baseline or its first.

    Raises:
        InputError: Only one renderer, or an unknown baseline.
    """
    table = table_of_run(run)
    known = table.renderers
    name = baseline or (run.info.get("config") or {}).get("baseline") or (known[0] if known else "")
    if name not in known:
        raise InputError(DOING, f"baseline {name!r}", f"{run.folder} does not have it", f"choose one of {', '.join(known) or 'none'}")
    if len(known) < 2:
        raise InputError(DOING, str(run.folder), f"only one renderer, {name}", "name a second run, or run two renderers")
    bases = {one: base for one, base in (run.info.get("bases") or {}).items() if one in known and base in known and name not in (one, base)}
    found = _pairs(table, table, {other: name for other in known if other != name}, "", margins, run.table, listed)
    with_base = {} if baseline is not None else _pairs(table, table, bases, "", margins, run.table, listed)
    return Comparison(found, (), with_base, run.table)


def compare_runs(
    first: Run, second: Run, baseline: str | None = None, margins: Mapping[str, float] | None = None, listed: int = LISTED
) -> Comparison:
    """Compare the second run with the first: each renderer with the same name, or all with ``baseline`` of the first run.

    A policy is paired with the policy of the same name; where the runs share none and have one each, with the other's.

    Raises:
        InputError: The runs differ in preset or in a scene's content, share no scene, a renderer or policy has no partner, or a metric is
            another quantity in the other run.
    """
    both = f"{first.folder} and {second.folder}"
    presets = [str(run.summary.get("preset")) for run in (first, second)]
    if presets[0] != presets[1]:
        raise InputError(DOING, both, f"presets {presets[0]!r} and {presets[1]!r}", "give the command of one run again with --preset")
    check_scenes(scene_hashes(first), scene_hashes(second), both, DOING, "run both on the same scene files")
    table, base = table_of_run(second), table_of_run(first)
    partner_of = {policy: policy for policy in table.policies if policy in base.policies}
    notes: tuple[str, ...] = ()
    if not partner_of:
        theirs, ours = base.policies, table.policies
        if len(theirs) != 1 or len(ours) != 1:
            do = "compare runs of one policy each, or of the same policies"
            raise InputError(DOING, f"policies {theirs} and {ours}", "none in common", do)
        partner_of, notes = {ours[0]: theirs[0]}, (f"policy {ours[0]} is compared with policy {theirs[0]}",)
    there, here = base.renderers, table.renderers
    if baseline is not None and baseline not in there:
        raise InputError(DOING, f"baseline {baseline!r}", f"{first.folder} does not have it", f"choose one of {', '.join(there)}")
    alone = there[0] if len(there) == 1 else None
    partner = {name: baseline or (name if name in there else alone) for name in here}
    lone = [name for name, other in partner.items() if other is None]
    if lone:
        raise InputError(DOING, f"renderers {lone} of {second.folder}", f"{first.folder} has {', '.join(there)}", "name one by --baseline")
    chosen = {name: other for name, other in partner.items() if other is not None}
    metrics = second.table.joined(first.table, {*table.metrics} & {*base.metrics}, DOING, both)
    return Comparison(_pairs(table, base, chosen, f"{first.folder}: ", margins, metrics, listed, partner_of), notes, metrics=metrics)


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
        here, there = table.sides(policy), base.sides(of_base, policy) if of_base in base.policies else {}
        for renderer, other in partner.items():
            if renderer in here and other in there:
                variant = renderer if len(table.policies) == 1 else cell_name(renderer, policy)
                out[variant] = {
                    name: compare(here[renderer], there[other], metrics.info(name), prefix + other, (margins or {}).get(name), listed)
                    for name in dict.fromkeys([*table.metrics, *base.metrics])
                }
    return out
