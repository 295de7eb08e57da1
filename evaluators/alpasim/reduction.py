"""From steps to rollout values as AlpaSim does it for a whole run: which metrics exist depends on all its rollouts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import MetricInfo, MetricSeries
from evaluators.aggregate.reduce import Reduction, RolloutValue, reduce_rollout
from evaluators.base import series
from evaluators.presets import Preset

WITHOUT_MAP = "the map was missing, or had no road edge where one was needed"


@dataclass(frozen=True)
class ScoredRollout:
    """A scored log and its names."""

    scene: str
    rollout: str  # the log's folder name
    series: tuple[MetricSeries, ...]
    run_uuid: str | None = None
    run_name: str | None = None


@dataclass(frozen=True)
class ReducedRollout:
    """Its values; metrics of the run that this rollout does not have are None."""

    of: ScoredRollout
    reduction: Reduction

    @property
    def dropped(self) -> str:
        """Say why the whole rollout does not count, or nothing."""
        return self.reduction.ledger.dropped

    @property
    def values(self) -> dict[str, float | None]:
        """Return the value of every metric."""
        return {name: one.value for name, one in self.reduction.values.items()}


def reduce_run(rollouts: Sequence[ScoredRollout], preset: Preset) -> list[ReducedRollout]:
    """Reduce all rollouts of a run.

    Off-road follows AlpaSim: where no rollout of the run has it, it counts as 0 when events are combined and is itself left out; where
    only some have it, events combined with it are unknown for the others unless the other part fired.

    Raises:
        EvaluatorError: No rollout has a camera image: AlpaSim's aggregation needs the black-image test in at least one.
    """
    names = {one.name: one.metric for rollout in rollouts for one in rollout.series}
    if rollouts and "img_is_black" not in names:
        raise EvaluatorError(
            "aggregating as AlpaSim does", f"{len(rollouts)} rollouts", f"no image of camera {preset.image_camera!r} in any log",
            "log that camera, or name another one in scorers.image.camera_logical_id",
        )  # fmt: skip
    return [_reduce(rollout, names, preset) for rollout in rollouts]


def _reduce(rollout: ScoredRollout, names: Mapping[str, MetricInfo], preset: Preset) -> ReducedRollout:
    own = {one.name for one in rollout.series}
    line = next(one.t_us for one in rollout.series if one.name == "eval_relevant")
    added = []
    if "offroad" not in own:
        known = "offroad" not in names
        added.append(series("offroad", line, 0.0 if known else np.nan, known, WITHOUT_MAP))
    reduction = reduce_rollout([*rollout.series, *added], preset)
    values = dict(reduction.values)
    if added and "offroad" not in names:
        del values["offroad"]
    for name, metric in names.items():
        if name not in own:
            facts = values.get(name) or RolloutValue(None, False, "", metric.unit, metric.direction)
            values[name] = replace(facts, value=None, valid=False, reason=reduction.ledger.dropped or "not scored in this rollout")
    return ReducedRollout(rollout, replace(reduction, values=values))
