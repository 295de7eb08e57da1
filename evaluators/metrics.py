"""Facts about every metric: unit, better side, reduction over time, and one line of help.

`METRICS` is what ``simrun list metrics`` prints and what reports read; an evaluator builds its series through `evaluators.base.series`,
which takes these facts from here, so a name cannot carry two units.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.pixels import BLACK_MAX
from alpasim_plugin.core.types import Aggregation, Direction
from alpasim_plugin.core.types import MetricInfo as MetricInfo


def _flag(
    help_text: str, direction: Direction = "lower", derived: bool = False, aggregation: Aggregation = "max", is_headline: bool = False
) -> MetricInfo:
    return MetricInfo("", direction, aggregation, help_text, is_flag=True, derived=derived, is_headline=is_headline)


MIN_ADE = "min_ade@{}s({})"  # seconds as Python writes a float: 0.5, 1.0, 0.25

METRICS: dict[str, MetricInfo] = {  # in the order in which reports show them, after the headline ones
    "collision_at_fault": _flag("front or lateral contact", is_headline=True),
    "collision_any": _flag("any contact with another actor", is_headline=True),
    "collision_front": _flag("an actor touches the front bumper"),
    "collision_lateral": _flag("an actor touches the ego at neither bumper"),
    "collision_rear": _flag("an actor touches the rear bumper and not the front one"),
    "min_distance_to_obstacle_m": MetricInfo("m", "higher", "min", "least plan-view gap between the ego and any actor"),
    "contact_time_s": MetricInfo("s", "none", "min", "when the first contact begins, counted from the first ego pose of the log"),
    "contact_x_m": MetricInfo("m", "none", "last", "where the ego is touched first: forward of its rear axle"),
    "contact_y_m": MetricInfo("m", "none", "last", "where the ego is touched first: to the left of its middle"),
    "offroad": _flag("off the road: outside the lanes and touching a road edge (strict: off the drivable surface)", is_headline=True),
    "offroad_margin_m": MetricInfo("m", "higher", "min", "gap to the drivable surface's border; below 0: how far the ego sticks out"),
    "wrong_lane": _flag("the lanes under the ego centre run against it (by more than 120 degrees)"),
    "min_distance_to_lane_boundary_m": MetricInfo("m", "higher", "min", "gap to the border of the joined nearby lanes; 0 when not inside"),
    "dist_to_gt_trajectory": MetricInfo("m", "lower", "max", "distance of the ego centre from the recorded path"),
    "lateral_distance_m": MetricInfo(
        "m", "lower", "mean", "mean distance to the side of the recorded path, which goes straight on beyond its ends", is_headline=True
    ),
    "route_distance_m": MetricInfo(
        "m", "lower", "mean", "the paper's: mean distance from the recorded path; driving past its end counts as distance"
    ),
    "lateral_bias_m": MetricInfo("m", "none", "mean", "mean signed distance to the side of the recorded path, left of it positive"),
    "lateral_dist_to_gt_trajectory": MetricInfo(
        "m", "lower", "max", "distance of the ego centre from the recorded path, which goes straight on at its far end"
    ),
    "left_corridor_laterally": _flag("the ego left the recorded path to the side, by 4 m unless AlpaSim's settings say else"),
    "dist_to_gt_location": MetricInfo("m", "lower", "max", "distance of the ego centre from where the recording is at that time"),
    "progress": MetricInfo("", "higher", "last", "share of the recorded path's length that was reached", is_headline=True, is_share=True),
    "progress_rel": MetricInfo("", "higher", "min", "share reached of the path that the recording has driven by then", is_share=True),
    "progress_rel_to_total": MetricInfo("", "higher", "last", "progress; in later AlpaSim of what the recording reaches by then"),
    "dist_traveled_m": MetricInfo("m", "none", "last", "metres driven"),
    "gt_dist_traveled_m": MetricInfo("m", "none", "last", "length of the recorded path"),
    "plan_deviation": MetricInfo("m", "lower", "mean", "how far consecutive plans differ at common times, near ones weigh more"),
    "open_loop_collision": _flag("a plan touches where another actor really is within 3 s", aggregation="mean"),
    **{
        MIN_ADE.format(horizon, "gt"): MetricInfo(
            "m", "lower", "mean", f"mean error over {horizon} s of the best sampled plan against the recording"
        )
        for horizon in (0.5, 1.0, 2.5, 5.0)
    },
    "img_is_black": _flag(f"a camera image is black (no byte above {BLACK_MAX})"),
    "img_is_frozen": _flag("a camera image equals the one before although the ego moved"),
    "safety_monitor_triggered": _flag("the policy's own safety monitor fired", direction="none"),
    "eval_relevant": _flag("the policy drives: the warm-up is over", direction="none"),
    "offroad_or_collision": _flag("off-road or any contact", derived=True),
    "offroad_or_collision_at_fault": _flag("off-road or contact at fault", derived=True),
    "duration_frac_20s": MetricInfo("", "none", "last", "scored time over 20 s", derived=True),
    "scene_score": MetricInfo("", "higher", "last", "AlpaSim's score: 0 after a fault, else saturated progress", derived=True),
    "progress_clipped_rel": MetricInfo("", "higher", "last", "progress at the last scored step", derived=True, is_share=True),
}

OWN = frozenset(METRICS)
_MIN_ADE_NAME = re.compile(r"min_ade@(\d+\.\d+)s\((gt|self)\)")


def info(name: str) -> MetricInfo:
    """Return the facts of a metric; minADE exists for any horizon and for the targets ``gt`` and ``self``.

    Raises:
        EvaluatorError: Nobody declared this metric.

    Example:
        >>> info("route_distance_m").unit
        'm'
        >>> info("min_ade@3.0s(gt)").aggregation
        'mean'
    """
    if name in METRICS:
        return METRICS[name]
    match = _MIN_ADE_NAME.fullmatch(name)
    if match:
        target = "the recording" if match[2] == "gt" else "the driven path"
        return replace(METRICS[MIN_ADE.format(0.5, "gt")], help=f"mean error over {match[1]} s of the best sampled plan against {target}")
    raise EvaluatorError(
        "looking up a metric", f"name {name!r}", "no evaluator declares it", "name it in the evaluator's `metrics`, or check the spelling"
    )


SIGNED = frozenset({"contact_x_m", "contact_y_m", "offroad_margin_m", "lateral_bias_m"})


def value_range(name: str) -> tuple[float, float]:
    """Return the least and the greatest value that a metric can have; infinite where it has no bound or is not ours.

    Example:
        >>> value_range("progress"), value_range("lateral_distance_m"), value_range("lateral_bias_m")
        ((0.0, 1.0), (0.0, inf), (-inf, inf))
    """
    facts = info(name)
    if facts.is_flag or facts.is_share:
        return 0.0, 1.0
    is_length_or_time = (name in OWN or _MIN_ADE_NAME.fullmatch(name) is not None) and facts.unit in ("m", "s")
    return (0.0 if is_length_or_time and name not in SIGNED else -math.inf), math.inf


def difference_range(name: str) -> tuple[float, float]:
    """Return the least and the greatest difference of two values of a metric."""
    low, high = value_range(name)
    return low - high, high - low


def declare(name: str, facts: MetricInfo) -> None:
    """Add a metric of a third-party evaluator.

    Raises:
        EvaluatorError: The name is declared already with other facts.
    """
    if METRICS.get(name, facts) != facts:
        raise EvaluatorError("declaring a metric", f"name {name!r}", "it is declared already with other facts", "choose another name")
    METRICS[name] = facts


def declared() -> dict[str, dict[str, Any]]:
    """Return the facts of all metrics that third-party evaluators have declared, for ``run.json``."""
    return {name: asdict(facts) for name, facts in METRICS.items() if name not in OWN}


def declare_from(info: Mapping[str, Any]) -> None:
    """Declare the third-party metrics that a run's ``run.json`` describes, so that it can be read where its plug-ins are not installed."""
    for name, facts in info.get("metrics", {}).items():
        declare(name, MetricInfo(**facts))
