"""Whether a drive stays where what its renderer shows was compared with the truth.

The nearer to the recorded path, the more a reconstruction shows what was there. How near a renderer
comes to photographs is known on that path, and as far beside it as a camera that no fit saw was
mounted (`simrun bench real`); farther away nobody has looked. On a built scene the truth is what
`clean` shows, and its file may say how far beside the path the policy's plans behind a renderer are
near those behind `clean` (`simrun bench real --range`).
"""

import numpy as np

from alpasim_plugin.core.geometry import interpolate, wrap_angle, yaw_from_quat
from alpasim_plugin.core.types import (
    F64,
    Bool,
    MetricSeries,
    PlanRange,
    RolloutLog,
    Scene,
    Trajectory,
)
from evaluators.metrics.footprint import ego_footprints, origin_of
from evaluators.metrics.presets import Preset
from evaluators.metrics.route import recorded_path, to_path
from evaluators.metrics.score import series, with_preset

BEYOND = "beyond_measured_share"
ON_PATH_M = 0.25  # nearer than this counts as on the path
SAME_TURN_DEG = 5.0  # a view that is turned by less shows nearly the same
TRUTH = "clean"  # of a built scene
NOT_LOOKED_FOR = (
    "how far beside the path plans are near was not looked for with this renderer and policy"
)
OTHER_SCENE = "the scene is another one than that on which the range of its plans was looked for"
OTHER_PARTS = (
    "the code, settings or weights of the renderer or the policy are others than those with which "
    "the range of its plans was looked for"
)
UNKNOWN = (NOT_LOOKED_FOR, OTHER_SCENE, OTHER_PARTS)  # why a drive has no share


def evaluate_measured(
    rollout: RolloutLog, scene: Scene | None, preset: Preset
) -> list[MetricSeries]:
    """Give ``beyond_measured_share``: 1 at a step that lies beyond what was compared, by place or by
    heading. Built scenes without a range have none, and presets that copy AlpaSim's tables neither.
    """
    if scene is None or preset.aliases:
        return []
    if scene.measured is not None:
        measured = scene.measured
        if not measured.n_photographs:
            return [series(BEYOND, rollout.ego.t_us, 1.0)]
        limits = (measured.lateral_m, measured.turn_deg)
        return [series(BEYOND, rollout.ego.t_us, _is_beyond(rollout, preset, *limits))]
    if not scene.plan_ranges:
        return []
    renderer, policy = _variant(rollout)
    if renderer == TRUTH:
        return [series(BEYOND, rollout.ego.t_us, 0.0)]
    entry = _range_of(scene.plan_ranges, renderer, policy)
    reason = _why_unknown(entry, rollout)
    if entry is None or reason:
        return [series(BEYOND, rollout.ego.t_us, np.nan, False, reason)]
    if entry.near_to_m is None:
        return [series(BEYOND, rollout.ego.t_us, 1.0)]
    return [series(BEYOND, rollout.ego.t_us, _is_beyond(rollout, preset, entry.near_to_m, 0.0))]


def _is_beyond(rollout: RolloutLog, preset: Preset, lateral_m: float, turn_deg: float) -> Bool:
    """Return for each pose of the ego ``(T,)`` whether it lies farther from the recorded path, or is
    turned farther from it, than what was compared.
    """
    path = recorded_path(rollout, preset)
    origin = origin_of(rollout.ego_log, preset)
    ego = ego_footprints(rollout, preset, origin).centres()
    line = path.xyz[:, :2] - origin[:2]
    distance_m, along_m = to_path(line, ego)
    turns_deg = _turns_deg(path, line, along_m, rollout.ego)
    is_far: Bool = distance_m > max(lateral_m, ON_PATH_M)
    return is_far | (turns_deg > max(turn_deg, SAME_TURN_DEG))


def _variant(rollout: RolloutLog) -> tuple[str, str]:
    """Return the names of renderer and policy of a log, empty where it does not say them; a log has
    the weights of a fixer in brackets behind its name.
    """
    versions = rollout.info.get("versions", {})
    return versions.get("sensorsim", "").split(" (")[0], versions.get("egodriver", "")


def _range_of(ranges: tuple[PlanRange, ...], renderer: str, policy: str) -> PlanRange | None:
    """Return the range of a renderer and a policy; None where none was looked for."""
    for entry in ranges:
        if (entry.renderer, entry.policy) == (renderer, policy):
            return entry
    return None


def _why_unknown(entry: PlanRange | None, rollout: RolloutLog) -> str:
    """Say why a range does not hold for a rollout; empty where it holds."""
    if entry is None:
        return NOT_LOOKED_FOR
    if not entry.is_current:
        return OTHER_SCENE
    digests = rollout.info.get("digests", {})
    looked_with = {"sensorsim": entry.renderer_digest, "egodriver": entry.policy_digest}
    # A part without a digest, such as one on a server, is known by its name alone.
    has_same_parts = all(
        digest is None or digests.get(service) == digest for service, digest in looked_with.items()
    )
    return "" if has_same_parts else OTHER_PARTS


def _turns_deg(path: Trajectory, line: F64, along_m: F64, ego: Trajectory) -> F64:
    """Return the angle ``(T,)`` between the ego's heading and the recording's where it passed
    there.
    """
    steps_m = np.hypot(*np.diff(line, axis=0).T)
    path_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    # The first of the times at which the recording stood at a place.
    moves = np.concatenate([[True], steps_m > 0])
    t_us = np.interp(along_m, path_m[moves], path.t_us[moves].astype(np.float64))
    poses = interpolate(path, t_us.astype(np.int64))
    recorded = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return np.abs(np.degrees(wrap_angle(yaw_from_quat(ego.quat) - recorded)))


FACTORY = with_preset(evaluate_measured)
