"""The numbers of a run, or of several: means, intervals, paired differences and verdicts, policy by policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from alpasim_plugin.run_folder.columns import RendererColumns, RolloutTable
from alpasim_plugin.run_folder.schema import cell_name
from evaluators.aggregate.paired import base_pairs_of_sides, paired_sides
from evaluators.aggregate.summary import aggregate_sides
from evaluators.metrics import METRICS, MetricTable

Sides = Mapping[str, RendererColumns]
NO_BASES: Mapping[str, str] = {}


def numbers(
    table: RolloutTable, baseline: str | None = None, bases: Mapping[str, str] = NO_BASES, known: MetricTable = METRICS
) -> dict[str, Any]:
    """Return the blocks ``metrics``, ``paired`` and ``paired_with_base`` of ``summary.json`` (docs/statistics.md).

    Args:
        table: The rollouts.
        baseline: Renderer that the others are compared with; None, or one that a policy did not meet, is the first.
        bases: Renderer with a fixer -> the renderer below it; where both were driven and it is not the baseline, the two are paired too.
        known: What the metrics are.
    """
    sides = {policy: table.sides(policy) for policy in table.policies}
    return {
        "metrics": by_policy(sides, lambda some: aggregate_sides(some, table.metrics, known)),
        "paired": by_policy(sides, lambda some: _pairs(some, table.metrics, baseline, known)),
        "paired_with_base": by_policy(
            sides, lambda some: base_pairs_of_sides(some, table.metrics, _baseline(some, baseline), bases, known)
        ),
    }


def by_policy(of: Mapping[str, Any], table: Callable[[Any], Mapping[str, Any]]) -> dict[str, Any]:
    """Make a table per policy. With one policy its keys are RENDERER, with several RENDERER/POLICY: policies are never averaged.

    Args:
        of: POLICY -> what the table is made of.
        table: Gives RENDERER -> entry.
    """
    out: dict[str, Any] = {}
    for policy, some in of.items():
        part = table(some)
        out |= part if len(of) == 1 else {cell_name(renderer, policy): entry for renderer, entry in part.items()}
    return out


def _pairs(sides: Sides, metrics: list[str], baseline: str | None, known: MetricTable) -> Mapping[str, Any]:
    chosen = _baseline(sides, baseline)
    return {} if chosen is None else paired_sides(sides, metrics, chosen, known=known)


def _baseline(sides: Sides, baseline: str | None) -> str | None:
    """Return the renderer that the others are compared with; None where there is nothing to compare."""
    if len(sides) < 2:
        return None
    return baseline if baseline is not None and baseline in sides else next(iter(sides))
