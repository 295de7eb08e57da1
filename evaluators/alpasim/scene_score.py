"""AlpaSim's score of a rollout: 0 after a fault, else how much of the recorded path was driven."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from evaluators.alpasim.settings import SceneScoreSettings

FAULTS = ("collision_at_fault", "offroad")
LATER_FAULTS = (*FAULTS, "left_corridor_laterally")  # from commit 6f1029c on


@dataclass(frozen=True)
class SceneScore:
    """Score of one rollout."""

    score: float  # 0..1
    progress_score: float  # 0..1, what the score would be without a fault
    failure_reason: str | None  # the first of the faults

    @property
    def passed(self) -> bool:
        """Return whether no fault happened, whatever the progress."""
        return self.failure_reason is None


def scene_score(values: Mapping[str, float | None], settings: SceneScoreSettings) -> SceneScore:
    """Score a rollout: ``min(clip(progress, 0, 1) / saturation, 1)``, 1 on recordings shorter than the least distance, 0 after a fault.

    Args:
        values: Rollout values by metric.
        settings: Saturation and least distance.

    Raises:
        EvaluatorError: A metric that is needed is missing or not finite; AlpaSim stops there too.
    """
    found: dict[str, float] = {}
    faults = LATER_FAULTS if LATER_FAULTS[-1] in values else FAULTS  # only a preset that has the rule has the metric
    needed = ("progress_clipped_rel", "gt_dist_traveled_m", *faults)
    for name in needed:
        value = values.get(name)
        if name not in values or value is None or not np.isfinite(value):
            what = f"missing metric {name!r}" if name not in values else f"metric {name!r} is {value}"
            raise EvaluatorError(
                "computing the scene score", f"metrics {', '.join(needed)}", what,
                "give the scene a map with road edges, or set scene_score.enabled: false in --settings",
            )  # fmt: skip
        found[name] = float(value)
    progress = min(min(max(found["progress_clipped_rel"], 0.0), 1.0) / settings.progress_saturation_threshold, 1.0)
    if found["gt_dist_traveled_m"] < settings.min_gt_distance_for_full_score_m:
        progress = 1.0
    reason = next((name for name in faults if found[name] != 0.0), None)
    return SceneScore(0.0 if reason else progress, progress, reason)
