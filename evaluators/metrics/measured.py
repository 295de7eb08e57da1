"""Whether a drive through a reconstruction stays where its renders were compared with photographs.

The nearer to the recorded path, the more a reconstruction shows what was there. How near a renderer
comes to photographs is known on that path, and as far beside it as a camera that no fit saw was
mounted (`simrun bench real`); farther away nobody has looked.
"""

import numpy as np

from alpasim_plugin.core.geometry import interpolate, wrap_angle, yaw_from_quat
from alpasim_plugin.core.types import F64, Bool, MetricSeries, RolloutLog, Scene, Trajectory
from evaluators.metrics.footprint import ego_footprints, origin_of
from evaluators.metrics.presets import Preset
from evaluators.metrics.route import recorded_path, to_path
from evaluators.metrics.score import series, with_preset

BEYOND = "beyond_measured_share"
ON_PATH_M = 0.25  # nearer than this counts as on the path
SAME_TURN_DEG = 5.0  # a view that is turned by less shows nearly the same


def evaluate_measured(
    rollout: RolloutLog, scene: Scene | None, preset: Preset
) -> list[MetricSeries]:
    """Give ``beyond_measured_share``: 1 at a step that lies beyond what was compared, by place or by
    heading. Built scenes have none, and presets that copy AlpaSim's tables neither.
    """
    if scene is None or scene.measured is None or preset.aliases:
        return []
    path = recorded_path(rollout, preset)
    origin = origin_of(rollout.ego_log, preset)
    ego = ego_footprints(rollout, preset, origin).centres()
    line = path.xyz[:, :2] - origin[:2]
    distance_m, along_m = to_path(line, ego)
    turn_deg = _turns_deg(path, line, along_m, rollout.ego)
    measured = scene.measured
    is_beyond: Bool = np.ones(len(ego), dtype=np.bool_)
    if measured.n_photographs:
        is_beyond = (distance_m > max(measured.lateral_m, ON_PATH_M)) | (
            turn_deg > max(measured.turn_deg, SAME_TURN_DEG)
        )
    return [series(BEYOND, rollout.ego.t_us, is_beyond)]


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
