"""From series over a rollout to one value per metric: which steps count, and how their values are
reduced.

Order (paper, appendix "Closed-loop replay evaluation"): steps before the policy takes over are
    dropped; steps after the first off-road or
collision event are dropped, the event's own step stays; flags are reduced by their maximum, other
metrics as they say themselves.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import F64, I64, Aggregation, MetricInfo, MetricSeries
from alpasim_plugin.log.run_folder.records import Ledger, MetricValue
from evaluators.metrics import METRICS
from evaluators.metrics.presets import DEFAULT, Preset
from evaluators.metrics.presets import preset as find_preset

EVENTS = (
    "collision_at_fault",
    "collision_front",
    "collision_lateral",
    "collision_rear",
    "offroad",
    "wrong_lane",
    "left_route",
    "ended_in_danger",
    "stalled",
    "braked_without_cause",
    "hard_brake",
    "wrong_way",
    "red_light",
)

NEVER_ENGAGED = "the policy never took over: every step belongs to the warm-up"
BLACK = "dropped: a camera image is black in the scored part"


@dataclass(frozen=True)
class Reduction:
    """Everything that the reduction of one rollout gives."""

    values: dict[str, MetricValue]
    ledger: Ledger
    events: tuple[
        JsonObject, ...
    ]  # {"metric", "t_us"}: first time of each kind of event among the scored steps

    def as_row(self) -> JsonObject:
        """Return flat columns: METRIC and METRIC_valid, as in rollouts.parquet."""
        row: JsonObject = {}
        for name, value in self.values.items():
            row[name], row[f"{name}_valid"] = value.value, value.valid
        return row


def rollout_values(
    series: Sequence[MetricSeries], preset: str | Preset = DEFAULT
) -> dict[str, MetricValue]:
    """Return one value per metric of a rollout, after dropping the steps that do not count.

    Args:
        series: What `score` gave for the rollout.
        preset: The preset it was scored with.

    Raises:
        EvaluatorError: ``eval_relevant`` is missing.
    """
    return reduce_rollout(series, preset).values


def reduce_rollout(series: Sequence[MetricSeries], preset: str | Preset = DEFAULT) -> Reduction:
    """Reduce a rollout and say what was dropped on the way; see `rollout_values`."""
    chosen = find_preset(preset)
    table = {metric_series.name: metric_series for metric_series in series}
    if "eval_relevant" not in table:
        raise EvaluatorError(
            f"series {sorted(table)}: no eval_relevant",
            "pass everything that score() returned",
        )
    for name, parts in _DERIVED_FLAGS.items():
        if name not in table and all(part in table for part in parts):
            table[name] = _any_of(name, [table[part] for part in parts])
    first_us, last_us, ledger = _window(table, chosen)
    # eval_relevant selects steps; as a value of its own it says nothing, but AlpaSim's tables have
    # it.
    values = {
        name: _reduce(metric_series, first_us, last_us, chosen, ledger.dropped)
        for name, metric_series in table.items()
        if chosen.aliases or name != "eval_relevant"
    }
    if not ledger.dropped:
        line = table["eval_relevant"].t_us
        scored = line[(line >= first_us) & (line <= last_us)]
        values["duration_frac_20s"] = _value(
            METRICS["duration_frac_20s"], float(scored[-1] - scored[0]) / 20e6
        )
    if "progress_rel_to_total" in values:
        values["progress_clipped_rel"] = values["progress_rel_to_total"]
    events = () if ledger.dropped else _events(table, first_us, last_us)
    return Reduction(values, ledger, events)


_DERIVED_FLAGS = {
    "collision_at_fault": ("collision_front", "collision_lateral"),
    "offroad_or_collision": ("collision_any", "offroad"),
    "offroad_or_collision_at_fault": ("collision_at_fault", "offroad"),
}


def _any_of(name: str, flags: Sequence[MetricSeries]) -> MetricSeries:
    """Return a flag that is 1 where any of some flags is known to be 1, and unknown where none is
    and one is unknown.
    """
    fired = np.any([np.where(flag.valid, flag.value, 0.0) > 0 for flag in flags], axis=0)
    is_valid = fired | np.all([flag.valid for flag in flags], axis=0)
    value = np.where(is_valid, fired.astype(np.float64), np.nan)
    reason = "" if bool(is_valid.all()) else next(flag.reason for flag in flags if flag.reason)
    return MetricSeries(METRICS[name], flags[0].t_us, value, is_valid, reason)


def _events(
    table: Mapping[str, MetricSeries], first_us: int, last_us: int
) -> tuple[JsonObject, ...]:
    """Return the events between two instants, each with the time at which it begins, in order."""
    begins = [(_first_time(table[name], first_us), name) for name in EVENTS if name in table]
    times = [(t_us, name) for t_us, name in begins if t_us is not None and t_us <= last_us]
    times.sort(key=lambda event: event[0])
    return tuple({"metric": name, "t_us": t_us} for t_us, name in times)


def _window(table: dict[str, MetricSeries], preset: Preset) -> tuple[int, int, Ledger]:
    """Return the first and last scored time and the ledger."""
    line = table["eval_relevant"].t_us
    engaged = table["eval_relevant"].value > 0
    n = len(line)
    if engaged.any():
        first = int(np.argmax(engaged))
    elif preset.replay_is_scored:
        first = 0
    else:
        return 0, -1, Ledger(n, n, 0, 0, 0, NEVER_ENGAGED)
    first_us = int(line[first])
    if (
        preset.drop_black
        and "img_is_black" in table
        and _first_time(table["img_is_black"], first_us) is not None
    ):
        return 0, -1, Ledger(n, first, 0, 0, 0, BLACK)
    stops = [_first_time(table[name], first_us) for name in preset.stop_after if name in table]
    event_us = min((t for t in stops if t is not None), default=int(line[-1]))
    after_event = int(np.sum(line > event_us))
    last_us = event_us
    if preset.stop_beyond_gt_m is not None and "dist_to_gt_trajectory" in table:
        distance = table["dist_to_gt_trajectory"]
        far = (
            (distance.value >= preset.stop_beyond_gt_m)
            & (distance.t_us >= first_us)
            & (distance.t_us <= event_us)
        )
        if far.any():
            last_us = int(distance.t_us[np.argmax(far)])
    if preset.ends_with_recording and "dist_to_gt_trajectory" in table:
        distance = table["dist_to_gt_trajectory"]
        behind = ~distance.valid & (distance.t_us >= first_us) & (distance.t_us <= last_us)
        if behind.any():
            last_us = int(distance.t_us[np.argmax(behind)])
    scored = int(np.sum((line >= first_us) & (line <= last_us)))
    return (
        first_us,
        last_us,
        Ledger(n, first, after_event, n - first - after_event - scored, scored, ""),
    )


def _first_time(metric_series: MetricSeries, first_us: int) -> int | None:
    fired = metric_series.valid & (metric_series.value > 0) & (metric_series.t_us >= first_us)
    return int(metric_series.t_us[np.argmax(fired)]) if fired.any() else None


def _reduce(
    metric_series: MetricSeries, first_us: int, last_us: int, preset: Preset, dropped: str
) -> MetricValue:
    if dropped:
        return _value(metric_series.metric, None, dropped)
    rows = (metric_series.t_us >= first_us) & (metric_series.t_us <= last_us)
    value = metric_series.value[rows]
    valid = metric_series.valid[rows]
    if not len(value):
        return _value(metric_series.metric, None, "no value among the scored steps")
    # Combined events have no value where a part is unknown; such rows are empty in AlpaSim's tables
    # and never read.
    if not preset.honour_valid and not metric_series.metric.derived:
        return _value(
            metric_series.metric,
            _REDUCE[metric_series.metric.aggregation](value, metric_series.t_us[rows]),
        )
    if metric_series.metric.aggregation == "last":
        return (
            _value(metric_series.metric, float(value[-1]))
            if valid[-1]
            else _value(metric_series.metric, None, metric_series.reason)
        )
    valid_values = value[valid]
    fired = bool(np.any(valid_values > 0))
    if not len(valid_values) or (
        metric_series.metric.is_flag
        and metric_series.metric.aggregation == "max"
        and not fired
        and not valid.all()
    ):
        # A flag that did not fire where it is known may have fired where it is not: unknown, never
        # zero.
        return _value(metric_series.metric, None, metric_series.reason)
    return _value(
        metric_series.metric,
        _REDUCE[metric_series.metric.aggregation](valid_values, metric_series.t_us[rows][valid]),
    )


_REDUCE: dict[Aggregation, Callable[[F64, I64], float]] = {
    "mean": lambda value, t_us: float(np.mean(value)),
    "median": lambda value, t_us: float(np.median(value)),
    "max": lambda value, t_us: float(np.max(value)),
    "min": lambda value, t_us: float(np.min(value)),
    "last": lambda value, t_us: float(value[np.argmax(t_us)]),
}


def _value(metric: MetricInfo, value: float | None, reason: str = "") -> MetricValue:
    return MetricValue(value, value is not None, reason, metric.unit, metric.direction)
