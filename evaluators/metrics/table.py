"""The metrics: each is one object that says what it is, and a table of them is a value that is
passed.

`METRICS` holds ours; `table_of` adds those of the evaluators that score a run, and
`MetricTable.of_run` reads the table that a run folder carries. There is no other place where a fact
about a metric stands.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import reduce
from typing import TYPE_CHECKING, Any

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.image_metrics import BLACK_MAX
from alpasim_plugin.core.types import Aggregation, Direction
from alpasim_plugin.core.types import MetricInfo as MetricInfo
from evaluators.metrics.score_table import BENCHMARKS

if TYPE_CHECKING:
    from alpasim_plugin.core.parts.spec import PartSpec

MIN_ADE = "min_ade@{}s({})"  # seconds as Python writes a float: 0.5, 1.0, 0.25
_MIN_ADE_NAME = re.compile(r"min_ade@(\d+\.\d+)s\((gt|self)\)")
AGREE = (
    "unit",
    "direction",
    "aggregation",
)  # facts without which values of two runs cannot be set side by side


class MetricTable(Mapping[str, MetricInfo]):
    """Metrics by name, in the order in which reports show them after the headline ones. Never
    changed: adding gives another table.
    """

    def __init__(self, metrics: Mapping[str, MetricInfo], is_read: bool = False) -> None:
        self._is_read = is_read  # from a run folder: what it lacks is the folder's fault
        self._metrics = {name: replace(facts, name=name) for name, facts in metrics.items()}

    def __getitem__(self, name: str) -> MetricInfo:
        """Return a metric.

        Raises:
            KeyError: The table does not hold it.
        """
        return self._metrics[name]

    def __iter__(self) -> Iterator[str]:
        """Go through the names."""
        return iter(self._metrics)

    def __len__(self) -> int:
        """Count the metrics."""
        return len(self._metrics)

    def info(self, name: str) -> MetricInfo:
        """Return a metric; minADE exists for any horizon and for the targets ``gt`` and ``self``.

        Raises:
            EvaluatorError: The table does not hold it.
            InputError: The same, of the table of a run folder.

        Example:
            >>> METRICS.info("route_distance_m").unit
            'm'
            >>> METRICS.info("min_ade@3.0s(gt)").aggregation
            'mean'
        """
        facts = self.shown(name)
        if facts.help:
            return facts
        if self._is_read:
            raise InputError(
                f"metric {name!r}: run.json does not say what it is",
                "give a folder that simrun wrote, or score its logs again",
            )
        raise EvaluatorError(
            f"name {name!r}: no evaluator declares it",
            "name it in the evaluator's `metrics`, or check the spelling",
        )

    def shown(self, name: str) -> MetricInfo:
        """Return a metric as `info` does, or one that has nothing but its name where the table does
        not hold it.
        """
        match = _MIN_ADE_NAME.fullmatch(name)
        if name in self._metrics or match is None:
            return self._metrics.get(name) or replace(UNKNOWN, name=name)
        return replace(
            _min_ade(match[1], "the recording" if match[2] == "gt" else "the driven path"),
            name=name,
        )

    @property
    def headline(self) -> tuple[str, ...]:
        """Give the metrics that a report leads with; the others are one click away."""
        return tuple(name for name, facts in self.items() if facts.is_headline)

    @property
    def primary(self) -> str:
        """Give the metric that a run's one primary question is about; empty where it declared none,
        as earlier versions did.
        """
        return next((name for name, facts in self.items() if facts.is_primary), "")

    @property
    def rates(self) -> frozenset[str]:
        """Give the metrics that lie in [0, 1], as means of zeros and ones."""
        return frozenset(name for name, facts in self.items() if facts.is_flag)

    def ordered(self, names: Iterable[str]) -> list[str]:
        """Sort names: headline metrics, then the others of the table in its order, then those that
        it does not hold by name.
        """
        order = dict.fromkeys([*self.headline, *self])
        rank = {name: index for index, name in enumerate(order)}
        return sorted(set(names), key=lambda name: (rank.get(name, len(rank)), name))

    def first_curves(self) -> tuple[str, ...]:
        """Return the series over time that a viewer shows first."""
        chosen = [facts for facts in (*self.values(), *STEP_SERIES.values()) if facts.curve]
        return tuple(facts.name for facts in sorted(chosen, key=lambda facts: facts.curve))

    def adding(self, metrics: Mapping[str, MetricInfo]) -> MetricTable:
        """Return a table with more metrics.

        Raises:
            EvaluatorError: It holds one of them already, and that is another one.
        """
        for name, facts in metrics.items():
            if self._metrics.get(name, replace(facts, name=name)) != replace(facts, name=name):
                raise EvaluatorError(
                    f"name {name!r}: it is declared already with other facts", "choose another name"
                )
            if facts.is_primary and name != self.primary:
                raise EvaluatorError(
                    f"name {name!r}: {self.primary!r} is primary",
                    "leave is_primary out",
                )
        return MetricTable({**self._metrics, **metrics})

    @classmethod
    def of_run(cls, metrics: Mapping[str, MetricInfo]) -> MetricTable:
        """Return the table of the metrics that a run's ``run.json`` states; ours for what it lacks,
        so that a run can be read without its plug-ins.
        """
        return cls({**METRICS, **metrics}, is_read=True)

    def joined(self, other: MetricTable, names: Iterable[str], who: str) -> MetricTable:
        """Return the table of two runs that are set side by side: this one's metrics, and what only
        the other has.

        Args:
            other: The other run's table.
            names: The metrics that are compared: unit, better side and reduction must agree. What
                is said about them need not.
            who: For the error.

        Raises:
            InputError: A metric is not the same quantity in both.
        """
        for name in names:
            if name in self and name in other:
                traits, other_traits = (
                    [getattr(table[name], key) for key in AGREE] for table in (self, other)
                )
                if traits != other_traits:
                    raise InputError(
                        f"{who}, metric {name!r}: unit, better side and reduction are {traits} and {other_traits}",
                        "choose runs of one version of the metric",
                    )
        return MetricTable({**other._metrics, **self._metrics})


def table_of(evaluators: Iterable[PartSpec]) -> MetricTable:
    """Return our metrics and those that evaluators bring.

    Raises:
        EvaluatorError: Two declare one metric differently.
    """
    return reduce(lambda table, spec: table.adding(spec.metrics), evaluators, METRICS)


def _flag(
    help_text: str, direction: Direction = "lower", aggregation: Aggregation = "max", **more: Any
) -> MetricInfo:
    return MetricInfo("", direction, aggregation, help_text, is_flag=True, **more)


def _metres(
    help_text: str, direction: Direction, aggregation: Aggregation, **more: Any
) -> MetricInfo:
    """Return a distance, which is 0 or more unless ``limits`` says otherwise."""
    return MetricInfo("m", direction, aggregation, help_text, **({"limits": (0.0, None)} | more))


def _min_ade(horizon: float | str, target: str) -> MetricInfo:
    formula = (
        "least over the plan's samples of the mean distance to `p`, over logged times from the query time to the first at or after now + "
        "the horizon"
    )
    text = f"mean error over {horizon} s of the best sampled plan against {target}"
    return _metres(
        text,
        "lower",
        "mean",
        reference=CENTRE,
        formula=formula,
        invalid="log, recording or every sample ends before",
    )


LEFT_ROUTE_M = 4.0  # AlpaSim's corridor
FOOTPRINT = "footprint, plan view"
CENTRE = "box centre, plan view"
UNKNOWN = MetricInfo("", "none", "last", "")
_SIGNED = (None, None)
_FEW = "three steps or fewer"
_NO_LANES = "no lanes"
_NO_CONTACT = "steps without contact"
_SHORT = "`P` is shorter than 1 m"
_UNCOVERED = "the recording does not cover `t`"
_NO_IMAGE = "no image"
_EITHER = "unknown unless one fired"
_BEGAN = "where on `F` the contact that touches now began; `strict` only"

METRICS = MetricTable(
    {  # in the order in which reports show them, after the headline ones
        "collision_at_fault": _flag(
            "contact at fault: strict by nuPlan's rules, else also where the ego is hit at its side",
            is_headline=True,
            label="at-fault collisions",
            reference=FOOTPRINT,
            formula="`collision_front` or `collision_lateral`; `strict`: [at fault](fault.md#contact-in-preset-strict)",
        ),
        "collision_any": _flag(
            "any contact with another actor",
            is_headline=True,
            label="collisions",
            reference=FOOTPRINT,
            formula="front, rear or lateral",
        ),
        "collision_front": _flag(
            "an actor touches the front bumper",
            reference=FOOTPRINT,
            formula="an actor's rectangle touches `F` and its front side",
        ),
        "collision_lateral": _flag(
            "an actor touches the ego at neither bumper",
            reference=FOOTPRINT,
            formula="an actor's rectangle touches `F` and neither its front nor its rear side",
        ),
        "collision_rear": _flag(
            "an actor touches the rear bumper and not the front one",
            reference=FOOTPRINT,
            formula="an actor's rectangle touches `F` and its rear side, not its front side",
        ),
        "collision_standing": _flag(
            "the ego touches something that stands in the reconstruction of a recorded drive",
            reference=FOOTPRINT,
            formula="`F` touches the box of a standing obstacle, whose name says how exactly it is known; recorded drives only",
        ),
        "min_distance_to_obstacle_m": _metres(
            "least plan-view gap between the ego and any actor",
            "higher",
            "min",
            margin=0.25,
            curve=3,
            reference=FOOTPRINT,
            formula="least distance from `F` to any actor's rectangle, 0 on touch",
            invalid="steps with no other actor",
        ),
        "contact_time_s": MetricInfo(
            "s",
            "none",
            "min",
            "when the first contact begins, counted from the first ego pose of the log",
            limits=(0.0, None),
            reference=FOOTPRINT,
            invalid=_NO_CONTACT,
            formula="when the contact that touches now began (the earliest, if several do), since the log's first pose; `strict` only",
        ),
        "contact_x_m": _metres(
            "where the ego is touched first: forward of its rear axle",
            "none",
            "last",
            limits=_SIGNED,
            reference="footprint, rig frame",
            formula=f"{_BEGAN}: ahead of the rear axle",
            invalid=_NO_CONTACT,
        ),
        "contact_y_m": _metres(
            "where the ego is touched first: to the left of its middle",
            "none",
            "last",
            limits=_SIGNED,
            reference="footprint, rig frame",
            formula=f"{_BEGAN}: to the left",
            invalid=_NO_CONTACT,
        ),
        "offroad": _flag(
            "off the road: outside the lanes and touching a road edge (strict: off the drivable surface)",
            is_headline=True,
            label="off-road rollouts",
            reference=FOOTPRINT,
            formula="[contact and off-road](fault.md#off-road)",
            invalid="no lanes; or an edge is needed and the map has none",
        ),
        "offroad_margin_m": _metres(
            "gap to the drivable surface's border; below 0: how far the ego sticks out",
            "higher",
            "min",
            limits=_SIGNED,
            reference=FOOTPRINT,
            formula="signed distance to the border of the drivable surface; `strict` only",
            invalid="no road on the ego's level",
        ),
        "wrong_lane": _flag(
            "the lanes under the ego centre run against it (by more than 120 degrees)",
            reference=CENTRE,
            invalid=_NO_LANES,
            formula="all nearby lanes that contain `c` run against the ego by more than 120 degrees, and there is one",
        ),
        "no_car_lane_share": MetricInfo(
            "",
            "lower",
            "mean",
            "share of the steps at which only shoulders, parking strips, bicycle or bus lanes are under the ego's centre",
            is_share=True,
            label="steps in no lane for cars",
            margin=0.02,
            reference=CENTRE,
            invalid=_NO_LANES,
            formula="1 where lanes on the ego's level contain `c` and none of them is for cars; `strict` only",
        ),
        "min_distance_to_lane_boundary_m": _metres(
            "gap to the border of the joined nearby lanes; 0 when not inside",
            "higher",
            "min",
            margin=0.05,
            reference=FOOTPRINT,
            formula="distance from `F` to the border of the union of nearby lanes if that contains `F`, else 0",
            invalid=_NO_LANES,
        ),
        "dist_to_gt_trajectory": _metres(
            "distance of the ego centre from the recorded path",
            "lower",
            "max",
            margin=0.25,
            reference=CENTRE,
            formula="distance from `c` to `P`",
        ),
        "lateral_distance_m": _metres(
            "mean distance to the side of the recorded path, which goes straight on beyond its ends",
            "lower",
            "mean",
            is_headline=True,
            label="lateral distance",
            margin=0.1,
            cap=LEFT_ROUTE_M,
            event="left_route",
            reference=CENTRE,
            invalid=_SHORT,
            formula="[distance to the side](metrics.md#lateral-distance) from `c` to `P`, which goes straight on beyond its ends",
        ),
        "route_distance_m": _metres(
            "the paper's: mean distance from the recorded path; driving past its end counts as distance",
            "lower",
            "mean",
            label="route distance",
            margin=0.1,
            cap=LEFT_ROUTE_M,
            reference=CENTRE,
            formula="distance from `c` to `P` as it stands: the paper's route distance, which [charges for driving past the end](metrics.md#presets)",
        ),
        "lateral_bias_m": _metres(
            "mean signed distance to the side of the recorded path, left of it positive",
            "none",
            "mean",
            limits=_SIGNED,
            margin=0.1,
            curve=1,
            cap=LEFT_ROUTE_M,
            event="left_route",
            reference=CENTRE,
            formula="lateral distance with sign: left of `P` positive",
            invalid=_SHORT,
        ),
        "lateral_dist_to_gt_trajectory": _metres(
            "distance of the ego centre from the recorded path, which goes straight on at its far end",
            "lower",
            "max",
            reference=CENTRE,
            formula="distance from `c` to `P` with its far end going straight on; later `alpasim` only",
        ),
        "left_corridor_laterally": _flag(
            "the ego left the recorded path to the side, by 4 m unless AlpaSim's settings say else",
            reference=CENTRE,
            formula="`lateral_dist_to_gt_trajectory` is 4 m or more; later `alpasim` only",
        ),
        "left_route": _flag(
            "the ego left the recorded path to the side by 4 m or more",
            label="rollouts that left the route",
            reference=CENTRE,
            invalid=_SHORT,
            formula="`lateral_distance_m` is 4 m or more",
        ),
        "ended_in_danger": _flag(
            "the path of the rollout ended less than 2 s before the ego would touch a road user",
            label="rollouts that ended in danger",
            reference=FOOTPRINT,
            formula="1 at the last step where the ego has passed the end of its path (a goal, the end of the known road or of a recording) and "
            "`time_to_collision_s` is below 2 s",
        ),
        "stalled": _flag(
            "the ego stands although nothing is in its way and the recording drove on; not behind the recording's end",
            label="stalled rollouts",
            reference=CENTRE,
            invalid=_SHORT,
            formula="[stalled and braked without a cause](outcomes.md)",
        ),
        "braked_without_cause": _flag(
            "the ego drives at less than half the speed of the recording there, which it had before, although nothing is in its way; not behind the recording's end",
            label="rollouts that braked without a cause",
            reference=CENTRE,
            invalid=_SHORT,
            formula="[stalled and braked without a cause](outcomes.md)",
        ),
        "hard_brake": _flag(
            "the ego brakes harder than 4.05 m/s2",
            label="hard brake",
            reference="rear axle",
            formula="deceleration along the vehicle, smoothed over 0.8 s, above 4.05 m/s2 (nuPlan's bound)",
            invalid=_FEW,
        ),
        "uncomfortable": _flag(
            "an acceleration, a jerk or the turning is beyond nuPlan's bounds of comfort",
            reference="box centre along and across, rear axle in all",
            invalid=_FEW,
            formula="outside one of: acceleration -4.05 to 2.40 along and 4.89 m/s2 across, jerk 4.13 along and 8.37 m/s3 in all, yaw 0.95 "
            "rad/s and 1.93 rad/s2",
        ),
        "time_to_collision_s": MetricInfo(
            "s",
            "higher",
            "min",
            "time until the ego and a road user touch if all go straight on; at most 3 s",
            limits=(0.0, 3.0),
            reference=FOOTPRINT,
            formula="least time after which `F` and another's rectangle, from whatever side, touch if both keep velocity and heading; 3 if none",
        ),
        "rss_margin_m": _metres(
            "gap to who is ahead, less the distance that responsibility-sensitive safety asks for",
            "higher",
            "min",
            limits=_SIGNED,
            reference=FOOTPRINT,
            invalid="steps with nobody ahead",
            formula="gap in the strip straight ahead minus v + 1.75 + (v + 3.5)^2 / 8 - u^2 / 16 (at least 0), v and u the speeds of both",
        ),
        "impact_speed_mps": MetricInfo(
            "m/s",
            "lower",
            "max",
            "relative speed at the first contact with a road user",
            limits=(0.0, None),
            reference=FOOTPRINT,
            formula="size of the difference of both velocities at the first step at or after the beginning of a contact",
            invalid="steps at which no contact begins",
        ),
        "wrong_way": _flag(
            "the ego has driven 2 m against its lanes within the last second",
            label="wrong way",
            reference=CENTRE,
            invalid=_NO_LANES,
            formula="metres against the best agreeing lane under `c` within 1 s are 2 or more",
        ),
        "red_light": _flag(
            "the ego has passed the line of a traffic light that is red",
            label="red light",
            reference=FOOTPRINT,
            invalid="no states are known",
            formula="the middle of the front of `F` passes a stop line in the direction of its lane while the light of the lane that it follows is red, or red and yellow",
        ),
        "dist_to_gt_location": _metres(
            "distance of the ego centre from where the recording is at that time",
            "lower",
            "max",
            margin=0.5,
            reference=CENTRE,
            formula="distance from `c` to `p(t)`",
            invalid=_UNCOVERED,
        ),
        "progress": MetricInfo(
            "",
            "higher",
            "last",
            "share of the recorded path's length that was reached",
            is_headline=True,
            is_share=True,
            label="progress",
            margin=0.02,
            reference=CENTRE,
            invalid="`P` has no length",
            formula="arc length on `P` of the point nearest to `c` and near the one of the step before, divided by the length of `P`",
        ),
        "progress_rel": MetricInfo(
            "",
            "higher",
            "min",
            "share reached of the path that the recording has driven by then",
            is_share=True,
            margin=0.02,
            reference=CENTRE,
            invalid=_UNCOVERED,
            formula="as `progress` on the part of `P` that the recording has driven by `t`; 1 while that has no length",
        ),
        "progress_rel_to_total": MetricInfo(
            "",
            "higher",
            "last",
            "progress; in later AlpaSim of what the recording reaches by then",
            reference=CENTRE,
            formula="as `progress`; `alpasim` only",
            invalid="`P` has no length",
        ),
        "dist_traveled_m": _metres(
            "metres driven",
            "none",
            "last",
            reference=CENTRE,
            formula="length driven since the policy took control",
        ),
        "gt_dist_traveled_m": _metres(
            "length of the recorded path", "none", "last", reference=CENTRE, formula="length of `P`"
        ),
        "plan_deviation": _metres(
            "how far consecutive plans differ at common times, near ones weigh more",
            "lower",
            "mean",
            margin=0.05,
            curve=4,
            reference=CENTRE,
            formula="weighted mean distance between a plan and the one before it at common times; the k-th weighs exp(-0.1 k); the new plan's "
            "first pose is left out",
            invalid="no common time",
        ),
        "open_loop_collision": _flag(
            "a plan touches where another actor really is within 3 s",
            aggregation="mean",
            reference=FOOTPRINT,
            formula="1 if a planned footprint with now < t <= now + 3 s touches an actor where the log has it at t",
        ),
        **{
            MIN_ADE.format(horizon, "gt"): _min_ade(horizon, "the recording")
            for horizon in (0.5, 1.0, 2.5, 5.0)
        },
        "img_is_black": _flag(
            f"a camera image is black (no byte above {BLACK_MAX})",
            formula=f"any camera image of that time has no byte above {BLACK_MAX}",
            invalid=_NO_IMAGE,
        ),
        "img_is_frozen": _flag(
            "a camera image equals the one before although the ego moved",
            invalid=_NO_IMAGE,
            formula="any camera's image of that time equals, byte for byte, the last other one although the ego has moved more than 0.1 m "
            "since",
        ),
        "beyond_measured_share": MetricInfo(
            "",
            "lower",
            "mean",
            "share of the steps that lie farther from the recorded path, or are turned farther from it, than what the renderer shows was compared with the truth",
            is_share=True,
            label="steps beyond what was compared",
            margin=0.05,
            reference=CENTRE,
            invalid="the scene is built, and its `plan_ranges` do not name the renderer and the policy, or are of another scene or of other code or weights; without `plan_ranges` there is no row",
            formula="1 where `c` is farther from `P` than the farthest camera whose photographs no fit saw, of a built scene than its `plan_ranges` say (at least 0.25 m), or the heading differs by more than that camera's axis does (at least 5 degrees)",
        ),
        "safety_monitor_triggered": _flag(
            "the policy's own safety monitor fired", direction="none", formula="0; `alpasim` only"
        ),
        "eval_relevant": _flag(
            "the policy drives: the warm-up is over",
            "none",
            formula="1 from `render_start + force_gt` on: the forced recording is over",
        ),
        "offroad_or_collision": _flag(
            "off-road or any contact",
            derived=True,
            reference=FOOTPRINT,
            formula="`offroad` or `collision_any`",
            invalid=_EITHER,
        ),
        "offroad_or_collision_at_fault": _flag(
            "off-road or contact at fault",
            derived=True,
            is_headline=True,
            is_primary=True,
            label="off-road or at-fault rollouts",
            reference=FOOTPRINT,
            formula="`offroad` or `collision_at_fault`",
            invalid=_EITHER,
        ),
        "duration_frac_20s": MetricInfo("", "none", "last", "scored time over 20 s", derived=True),
        "scene_score": MetricInfo(
            "",
            "higher",
            "last",
            "AlpaSim's score: 0 after a fault, else saturated progress",
            derived=True,
        ),
        "progress_clipped_rel": MetricInfo(
            "", "higher", "last", "progress at the last scored step", derived=True, is_share=True
        ),
        **BENCHMARKS,
    }
)

# Series of ``steps.parquet`` that are no metrics: they have no value over a rollout.
STEP_SERIES = MetricTable(
    {
        "ego_x_m": MetricInfo(
            "m",
            "none",
            "last",
            "position of the ego's rear axle, world",
            reference="rig origin, world",
        ),
        "ego_y_m": MetricInfo(
            "m",
            "none",
            "last",
            "position of the ego's rear axle, world",
            reference="rig origin, world",
        ),
        "ego_yaw_rad": MetricInfo(
            "rad", "none", "last", "heading of the ego, world", reference="rig, world"
        ),
        "ego_speed_mps": MetricInfo(
            "m/s",
            "none",
            "last",
            "speed of the ego's rear axle",
            reference="rig origin, plan view",
            curve=2,
        ),
        "opacity_mean": MetricInfo(
            "", "none", "last", "mean opacity of the rendered frame", curve=5
        ),
        # Of a speculative fixer: distance of the camera pose of the shown frame, and of the
        # forecast pose, from the true pose.
        "pose_error_m": MetricInfo(
            "m", "none", "last", "distance of the shown frame's camera from where it was"
        ),
        "forecast_error_m": MetricInfo(
            "m", "none", "last", "distance of the forecast camera from where it was"
        ),
        # Of a fixer that looks at recorded frames.
        "recorded_share": MetricInfo(
            "", "none", "last", "share of the image that is recorded frames", is_share=True
        ),
        "guessed_share": MetricInfo(
            "", "none", "last", "share of the image that the fixer made up", is_share=True
        ),
    }
)
