"""Paired differences between renderers on shared scene-seed cells.

Two renderers meet the same scenes, seeds and noise, so the difference per cell is far less spread than either value. Cells of one scene are
not independent: differences are averaged per scene, and the scene is the unit of interval and test.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from scipy import stats

from alpasim_plugin.errors import InputError
from alpasim_plugin.types import F64, Direction
from evaluators.aggregate.intervals import cluster_means, clustered
from evaluators.aggregate.rows import Row, column, metric_names, renderers
from evaluators.metrics import info

Verdict = Literal["better", "worse", "undecided"]
ALPHA = 0.05


def paired(rows: Sequence[Row], baseline: str, metrics: Sequence[str] | None = None) -> dict[str, dict[str, dict[str, Any]]]:
    """Compare every renderer with a baseline, cell by cell.

    Args:
        rows: As for `aggregate`.
        baseline: Renderer that the others are compared with.
        metrics: Which metrics; all that any row has by default.

    Returns:
        RENDERER -> METRIC -> ``baseline``, ``diff`` (renderer minus baseline: mean over scenes of the scene's mean difference), ``ci95``
        ([low, high], t interval on the scenes' mean differences), ``p_value``, ``test``, ``verdict`` (better, worse, undecided),
        ``n_cells``, ``n_scenes``, ``n_missing`` (cells that only one side has), ``unit``, ``direction``; ``reason`` where numbers are None.

    Raises:
        InputError: No row has the baseline.
    """
    known = renderers(rows)
    if baseline not in known:
        raise InputError("pairing renderers", f"baseline {baseline!r}", "no rollout has it", f"choose one of {', '.join(known)}")
    names = list(metrics) if metrics is not None else metric_names(rows)
    split = {name: [row for row in rows if row["renderer"] == name] for name in known}
    return {
        renderer: {metric: compare(split[renderer], split[baseline], metric, baseline) for metric in names}
        for renderer in known
        if renderer != baseline
    }


def compare(rows: Sequence[Row], base_rows: Sequence[Row], metric: str, baseline: str) -> dict[str, Any]:
    """Compare one metric of two sets of rows on their shared cells; see `paired`."""
    facts = info(metric)
    here, there = column(rows, metric), column(base_rows, metric)
    of_base = dict(zip(there.cells, there.values, strict=True))
    shared = [(cell, value - of_base[cell]) for cell, value in zip(here.cells, here.values, strict=True) if cell in of_base]
    entry: dict[str, Any] = {
        "baseline": baseline,
        "diff": None,
        "ci95": None,
        "p_value": None,
        "test": None,
        "verdict": "undecided",
        "n_cells": len(shared),
        "n_scenes": len({cell[1] for cell, _ in shared}),
        "n_missing": len(set(here.cells) ^ set(there.cells)),
        "unit": facts.unit,
        "direction": facts.direction,
    }
    if not shared:
        return entry | {"reason": "no scene-seed cell has this metric on both sides"}
    difference = np.array([d for _, d in shared])
    scenes = [cell[1] for cell, _ in shared]
    interval = clustered(difference, scenes)
    entry["diff"], entry["ci95"] = interval.centre, interval.bounds
    if interval.reason:
        return entry | {"reason": interval.reason}
    entry["p_value"], entry["test"] = p_value(cluster_means(difference, scenes)[0], facts.is_flag)
    entry["verdict"] = verdict(interval.bounds, entry["p_value"], interval.centre, facts.direction)
    return entry


def p_value(means: F64, is_flag: bool) -> tuple[float, str]:
    """Test that scene differences ``(G,)`` centre on zero.

    Flags, and differences that are all alike (where t has no spread to go by), take the exact two-sided sign test on the scenes that
    changed; other metrics the paired t test.
    """
    if is_flag or bool(np.all(means == means[0])):
        up, down = int(np.sum(means > 0)), int(np.sum(means < 0))
        return (1.0 if up + down == 0 else float(stats.binomtest(up, up + down).pvalue)), "exact sign test on scenes"
    return float(stats.ttest_1samp(means, 0.0).pvalue), "paired t test on scene means"


def verdict(bounds: list[float] | None, p: float, diff: float, direction: Direction) -> Verdict:
    """Call a difference better or worse only where interval and test agree that it is not zero, and the metric has a better side."""
    if bounds is None or direction == "none" or p >= ALPHA or bounds[0] <= 0.0 <= bounds[1]:
        return "undecided"
    return "better" if (diff < 0) == (direction == "lower") else "worse"
