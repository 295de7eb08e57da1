"""From rollout rows to one paired difference a scene, and from these how many seeds to drive in the
next scenes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.types import F64, Bool, Direction
from alpasim_plugin.log.run_folder.sides import Side


@dataclass(frozen=True)
class SceneDifferences:
    """Paired differences of one metric, scene by scene in the order of the drawing.

    Attributes:
        diff: ``(n,)`` candidate minus baseline, mean over the scene's pairs, in the metric's own
            sign; NaN where a pair is missing.
        within: ``(n,)`` variance between the pairs of the scene; NaN with fewer than two.
        pairs: ``(n,)`` pairs of the scene.
        missing: Cells without a pair.
    """

    diff: F64
    within: F64
    pairs: F64
    missing: int

    @property
    def known(self) -> Bool:
        """Tell which scenes have a difference ``(n,)``."""
        return np.isfinite(self.diff)

    def harm(self, direction: Direction) -> F64:
        """Return the differences with the sign that makes positive worse; without a better side as
        they are.
        """
        return -self.diff if direction == "higher" else self.diff


def scene_differences(
    candidate: Side, baseline: Side, metric: str, scenes: Sequence[str]
) -> SceneDifferences:
    """Return the differences of the scenes named, in their order.

    A scene with a cell that lacks its pair has no difference: which pairs are lost may depend on
    how the drive went.

    Args:
        candidate: Rollouts of the renderer in question, of one policy.
        baseline: Those of the renderer that it is compared with.
        metric: Its name.
        scenes: In the order in which they were drawn.
    """
    mine, base = candidate.values(metric), baseline.values(metric)
    index = candidate.place_in(baseline)
    partner = np.where(index >= 0, base[index], np.nan) if len(base) else np.full(len(mine), np.nan)
    of_scene: dict[str, list[float]] = {}
    for (_, scene, _), value in zip(candidate.cells, mine - partner, strict=True):
        of_scene.setdefault(scene, []).append(float(value))
    alone = [
        cell
        for cell, place in zip(baseline.cells, baseline.place_in(candidate), strict=True)
        if place < 0
    ]
    for _, scene, _ in alone:
        of_scene.setdefault(scene, []).append(float("nan"))
    values = [np.array(of_scene.get(scene, [np.nan])) for scene in scenes]
    return SceneDifferences(
        np.array([v.mean() for v in values]),
        np.array([v.var(ddof=1) if len(v) > 1 else np.nan for v in values]),
        np.array([len(v) for v in values], dtype=np.float64),
        int(sum(np.isnan(v).sum() for v in values)),
    )


PILOT_SEEDS = 2  # of the first scenes: one seed says nothing of the variance between seeds


def variances(found: SceneDifferences) -> tuple[float, float] | None:
    """Return the variance between scenes and between the seeds of a scene, by the method of
    moments; None before both are known.

    The variance of scene means is that between scenes plus the mean of within / seeds; where the
    first comes out negative it is 0.
    """
    several = np.isfinite(found.within)
    if several.sum() < 2 or found.known.sum() < 3:
        return None
    within = float(found.within[several].mean())
    total = float(np.var(found.diff[found.known], ddof=1))
    return max(0.0, total - within * float(np.mean(1.0 / found.pairs[found.known]))), within


def best_seeds(between: float, within: float, scene_cost: float, most: int) -> int:
    """Return the seeds a scene that give the least variance for the cost: sqrt(scene_cost * within
    / between), from 1 to ``most``.

    The classic allocation of two-stage sampling (Cochran, Sampling Techniques, 1977, section 10.6).

    Args:
        between: Variance between scenes.
        within: Variance between the seeds of a scene.
        scene_cost: What a new scene costs, in pairs of rollouts: fitting its reconstruction, for
            example.
        most: Seeds that there are.

    Example:
        >>> best_seeds(between=1.0, within=4.0, scene_cost=4.0, most=5)
        4
    """
    if within == 0.0 or scene_cost == 0.0:
        return 1
    if between == 0.0:
        return most
    return int(min(most, max(1, round(math.sqrt(scene_cost * within / between)))))


def scarce_seeds(
    between: float, within: float, distance: float, log_bar: float, scenes: int, most: int
) -> int:
    """Return the fewest seeds with which a suite of ``scenes`` is expected to suffice; ``most``
    where none is.

    A bet at the planned distance needs about 2 log(1 / alpha) variance / distance^2 scenes.
    """
    for seeds in range(1, most + 1):
        if 2.0 * log_bar * (between + within / seeds) <= scenes * distance**2:
            return seeds
    return most


def next_seeds(
    found: SceneDifferences,
    distance: float | None,
    log_bar: float,
    scene_cost: float,
    scenes: int,
    most: int,
) -> int:
    """Return the seeds of the next scenes; they depend on earlier scenes only, so the guarantee
    stays.

    Args:
        found: Of the metric that is furthest from a decision.
        distance: Planned distance from the threshold; None: scenes are never taken to be scarce.
        log_bar: Log of 1 / alpha.
        scene_cost: As in `best_seeds`.
        scenes: Scenes of the suite.
        most: Seeds that there are.
    """
    known = variances(found)
    if known is None:
        return min(PILOT_SEEDS, most)
    by_cost = best_seeds(*known, scene_cost, most)
    return (
        by_cost
        if distance is None
        else max(by_cost, scarce_seeds(*known, distance, log_bar, scenes, most))
    )
