"""Evaluator presets: every convention that changes a number, in one frozen record that is stamped
on the results.

`paper` follows the closed-loop appendix of the OneFixer paper, `alpasim` AlpaSim's code with its
quirks, and `strict` is what we hold to be right. A preset only selects; the evaluators hold the
code of each choice.
"""

import dataclasses
from dataclasses import dataclass, replace
from typing import Any, Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.config import guess


@dataclass(frozen=True)
class Preset:
    """Conventions of one scoring protocol."""

    name: str
    reproduces: str | None = (
        None  # whose evaluation, in which version: stamped on the results with the rest
    )
    protocol: str | None = (
        None  # the benchmark whose score is given as well, by its name in `evaluators.metrics.protocols`
    )
    # Footprint. The sizes of all boxes are scaled by 1 - shrink; corners are rounded by roundness *
    # shorter side / 2.
    ego_size_m: tuple[float, float] | None = None  # length, width; None: as logged
    shrink: float = 0.0
    roundness: float = 0.0
    # Whether boxes have heights: who is on a bridge above the ego or on a road below is not near it.
    levels: bool = True
    # Collision. "every": each touching actor is classified. "last": only the last one that the
    # spatial index returns is.
    hits: Literal["every", "last"] = "every"
    # "at_steps": logged instants only. "between_steps": the motion between them too.
    contact: Literal["at_steps", "between_steps"] = "at_steps"
    # At fault. "by_side": contact at the front or the side, as AlpaSim has it. "nuplan": what nuPlan
    # says of who moves, which side is touched, and whether the ego is between lanes.
    fault: Literal["by_side", "nuplan"] = "by_side"
    # Road. Lanes whose centre passes within lane_radius_m (3-D) of the ego box centre: its line, or
    # only its stored vertices.
    lane_radius_m: float = 6.0
    lane_query: Literal["line", "vertices"] = "line"
    # A lane or an area farther above or below the ground under the ego is another road. None: the
    # radius alone decides.
    lane_height_m: float | None = 2.0
    lane_half_width_m: float = 1.85  # buffer of the centre where an edge is missing
    seam_m: float = 1e-6  # gaps between lanes up to this wide are closed; 1 um is rounding
    # Off the road. "edge_touch": no nearby lane holds the footprint and it touches a road edge.
    # "margin": it sticks out of the drivable surface, all lanes and drivable areas of the ego's
    # level.
    offroad_rule: Literal["edge_touch", "margin"] = "edge_touch"
    edge_touch_m: float = (
        0.001  # off-road below this distance from a road edge, if no lane contains the footprint
    )
    # "any": every edge at the ego's height. "nearest_vertex": the edge that owns the vertex nearest
    # in 3-D. "nearest_of_level": the same of the edges whose vertex beside the ego is at its
    # height.
    edge_query: Literal["any", "nearest_vertex", "nearest_of_level"] = "any"
    edge_height_m: float = 3.0  # edges farther above or below the box centre belong to another road
    alpasim_map: bool = (
        False  # read the road as AlpaSim's own loader does, where the scene says that this differs
    )
    # Wrong lane. "none_agrees": no lane under the ego runs its way. "any_opposes": at least one
    # runs against it.
    missing_road: Literal["invalid", "absent", "error"] = (
        "invalid"  # no map, or an edge is needed and there is none
    )
    wrong_lane_rule: Literal["none_agrees", "any_opposes"] = "none_agrees"
    wrap_heading: bool = True  # compare headings modulo a full turn
    # Precision. False: float64 relative to a local origin. True: coordinates as they stand, poses
    # and corners in float32.
    float32: bool = False
    # Recorded path.
    invented_starts: bool = False  # the first two rows of the recording-based metrics are constants
    distance_from: Literal["handover", "log_start"] = "handover"  # where dist_traveled_m starts
    # What progress_rel_to_total is a share of: the recorded path, or its part up to where the
    # recording is when the rollout ends.
    progress_of: Literal["path", "reachable"] = "path"
    # whether leaving the recorded path to the side by stop_beyond_gt_m is a fault of its own
    corridor: bool = False
    # Plans.
    open_loop_horizon_us: int = 3_000_000
    min_ade_horizons_s: tuple[float, ...] = (0.5, 1.0, 2.5, 5.0)
    min_ade_target: Literal["gt", "self"] = "gt"
    min_ade_rule: Literal["by_time", "by_index"] = "by_time"
    min_ade_with_z: bool = False
    plan_decay: float = 0.1  # weight exp(-plan_decay * k) of the k-th common plan time
    plan_with_z: bool = False
    # Images. None: every logged camera counts.
    image_camera: str | None = None
    image_rule: Literal["own_times", "at_or_after_step"] = "own_times"
    # From steps to one value per rollout.
    aliases: bool = False  # give AlpaSim's second names of the same value as well
    replay_is_scored: bool = (
        False  # a rollout that never leaves the warm-up: scored whole, or invalid
    )
    has_scene_score: bool = False  # AlpaSim's score of a rollout, with its usual settings
    honour_valid: bool = True  # skip invalid steps, or reduce over every row
    stop_after: tuple[str, ...] = (
        "collision_any",
        "offroad",
    )  # rows after the first event are dropped
    stop_beyond_gt_m: float | None = (
        None  # rows after the first one this far from the recorded path are dropped
    )
    # whether rows after the ego has come past the end of a recording that moves there are dropped
    ends_with_recording: bool = False
    # whether a rollout in a scene with a goal is driven, and scored, up to the expert's arrival only:
    # such rules compare the ego with the recorded drive at the same time
    until_recorded: bool = False
    drop_black: bool = False  # a black image in a scored row removes the rollout
    # The loop, not the scores: whether a rollout ends at the end of its path, if its scenario says
    # so. AlpaSim drives on.
    stop_at_path_end: bool = True

    def __post_init__(self) -> None:
        if self.roundness > 0 and (
            self.contact == "between_steps" or self.offroad_rule == "margin"
        ):
            raise InputError(
                f"preset {self.name!r}: roundness {self.roundness} together with contact {self.contact!r} and off-road rule {self.offroad_rule!r}",
                "set roundness to 0: motion between steps and the off-road margin are worked out for sharp corners only",
            )

    def as_dict(self) -> dict[str, Any]:
        """Return every convention by name, for run.json."""
        return dataclasses.asdict(self)


ALPASIM = Preset(
    name="alpasim",
    reproduces="AlpaSim, alpasim_eval 1.36.0 (main, commit 3032e0c, July 2026, wire API 0.54.0)",
    shrink=0.02,
    roundness=0.5,
    levels=False,
    lane_height_m=None,
    hits="last",
    lane_query="vertices",
    seam_m=0.0,
    edge_query="nearest_vertex",
    alpasim_map=True,
    missing_road="absent",
    wrong_lane_rule="any_opposes",
    wrap_heading=False,
    float32=True,
    invented_starts=True,
    distance_from="log_start",
    min_ade_rule="by_index",
    image_camera="camera_front_wide_120fov",
    image_rule="at_or_after_step",
    aliases=True,
    replay_is_scored=True,
    has_scene_score=True,
    honour_valid=False,
    stop_beyond_gt_m=4.0,
    until_recorded=True,
    drop_black=True,
    stop_at_path_end=False,
)
ALPASIM_LATER = replace(
    ALPASIM,
    name="alpasim@6f1029c",
    reproduces="AlpaSim, rules of commit 6f1029c (public challenge, later than July 2026) over alpasim_eval 1.36.0",
    edge_query="nearest_of_level",
    progress_of="reachable",
    corridor=True,
    drop_black=False,
)

PRESETS: dict[str, Preset] = {
    "paper": Preset(
        name="paper", ego_size_m=(4.855, 1.88), lane_height_m=None, ends_with_recording=True
    ),
    ALPASIM.name: ALPASIM,
    ALPASIM_LATER.name: ALPASIM_LATER,
    "strict": Preset(
        name="strict",
        contact="between_steps",
        fault="nuplan",
        seam_m=0.1,
        offroad_rule="margin",
        missing_road="error",
    ),
    # Other benchmarks go on after an event, and have no score where a part of it cannot be
    # measured.
    **{
        name: Preset(
            name=name,
            protocol=name,
            fault="nuplan",
            seam_m=0.1,
            stop_after=(),
            until_recorded=True,
        )
        for name in ("nuplan", "navsim")
    },
}


DEFAULT = "strict"  # for verdicts of our own; the others are conventions that are named

# Least and greatest share of contacts that fall between two logged instants, in two samples
# (docs/metrics.md).
AT_INSTANTS = (
    "contact at logged instants only: missed are 2 to 5 % of contacts at steps of 100 ms, "
    f"3 to 14 % at 200 ms, 8 to 49 % at 500 ms; --preset {DEFAULT} looks between them too"
)


def contact_note(name: str) -> str:
    """Say what a preset that looks for contact at logged instants only does not see; empty for
    others, and for unknown ones.
    """
    chosen = PRESETS.get(name)
    return AT_INSTANTS if chosen is not None and chosen.contact == "at_steps" else ""


HELP = {
    "paper": "the closed-loop protocol of the OneFixer paper",
    "strict": "ours, and the default: contact between steps, a signed margin to the edge of the road; needs a map",
    "nuplan": "nuPlan's closed-loop score",
    "navsim": "NAVSIM's PDM score and extended PDM score",
}


def described() -> dict[str, str]:
    """Return PRESET -> what it is, and what it does not see, the default first."""
    texts = {}
    for name in sorted(PRESETS, key=lambda name: name != DEFAULT):
        chosen = PRESETS[name]
        note = "" if chosen.protocol else contact_note(name)
        texts[name] = "; ".join(filter(None, (HELP.get(name) or chosen.reproduces, note)))
    return texts


def preset(name: str | Preset) -> Preset:
    """Return a preset by name; a `Preset` is passed through.

    Raises:
        InputError: Unknown name.
    """
    if isinstance(name, Preset):
        return name
    if name not in PRESETS:
        raise InputError(
            f"name {name!r}: no preset has that name",
            f"{guess(name, PRESETS)}known: {', '.join(PRESETS)}",
        )
    return PRESETS[name]
