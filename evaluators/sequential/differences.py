"""From rollout rows to one paired difference a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.types import F64, Bool, Direction
from alpasim_plugin.run_folder.sides import Side


@dataclass(frozen=True)
class SceneDifferences:
    """Paired differences of one metric, scene by scene in the order of the drawing.

    Attributes:
        diff: ``(n,)`` candidate minus baseline, mean over the scene's pairs, in the metric's own sign; NaN where a pair is missing.
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
        """Return the differences with the sign that makes positive worse; without a better side as they are."""
        return -self.diff if direction == "higher" else self.diff


def scene_differences(candidate: Side, baseline: Side, metric: str, scenes: Sequence[str]) -> SceneDifferences:
    """Return the differences of the scenes named, in their order.

    A scene with a cell that lacks its pair has no difference: which pairs are lost may depend on how the drive went.

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
    alone = [cell for cell, place in zip(baseline.cells, baseline.place_in(candidate), strict=True) if place < 0]
    for _, scene, _ in alone:
        of_scene.setdefault(scene, []).append(float("nan"))
    values = [np.array(of_scene.get(scene, [np.nan])) for scene in scenes]
    return SceneDifferences(
        np.array([v.mean() for v in values]),
        np.array([v.var(ddof=1) if len(v) > 1 else np.nan for v in values]),
        np.array([len(v) for v in values], dtype=np.float64),
        int(sum(np.isnan(v).sum() for v in values)),
    )
