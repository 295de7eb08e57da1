"""How the ego moves, also where nothing is touched: comfort, braking, time to collision, who is
ahead, wrong way, red light.

The bounds are nuPlan's (`evaluators.metrics.nuplan`), the safe distance is that of
responsibility-sensitive safety: Shalev-Shwartz et al., "On a formal model of safe and scalable
self-driving cars", definition 1.
"""

import numpy as np

from alpasim_plugin.core.types import F64, MetricSeries, RolloutLog, Scene
from evaluators.metrics import nuplan
from evaluators.metrics.presets import Preset
from evaluators.metrics.score import series, with_preset
from evaluators.metrics.scored import ScoredRollout
from evaluators.metrics.states import EgoStates, Tracks, smooth

RESPONSE_S = 1.0
RSS_ACCEL_MPS2 = 3.5
RSS_BRAKE_MPS2 = 4.0
RSS_MOST_BRAKE_MPS2 = 8.0
NO_ONE_AHEAD = "nobody is ahead in the ego's way"
NO_LANES = "the map has no lanes"
NO_STATES = "the states of traffic lights are not known"
FEW = "the log has three steps or fewer"


def safe_distance_m(v_mps: F64, ahead_mps: F64) -> F64:
    """Return the gap ``(N,)`` at which a vehicle still stops behind one that brakes as hard as it
    can, metres.

    Args:
        v_mps: ``(N,)`` speed of the vehicle behind, which accelerates for `RESPONSE_S` and then
            brakes gently.
        ahead_mps: ``(N,)`` speed of the one ahead; what comes towards it is taken to stand.

    >>> float(safe_distance_m(np.array([10.0]), np.array([10.0]))[0])
    28.28125
    """
    after = v_mps + RESPONSE_S * RSS_ACCEL_MPS2
    stopping_m = (
        v_mps * RESPONSE_S + RSS_ACCEL_MPS2 * RESPONSE_S**2 / 2 + after**2 / (2 * RSS_BRAKE_MPS2)
    )
    return np.maximum(stopping_m - np.maximum(ahead_mps, 0.0) ** 2 / (2 * RSS_MOST_BRAKE_MPS2), 0.0)


def time_to_collision_s(ego: EgoStates, tracks: Tracks) -> F64:
    """Return ``(T,)`` seconds until the ego's box touches that of any road user, from whatever
    side, if all go straight on at their velocity; 0 while it does, infinite where it never will.
    """
    out = np.full(len(ego.t_us), np.inf)
    actor, step = np.nonzero(tracks.is_present)
    first_s, last_s = nuplan.touching_s(ego, tracks, actor, step)
    meets = (first_s <= last_s) & (last_s >= 0.0)
    np.minimum.at(out, step[meets], np.maximum(first_s[meets], 0.0))
    return out


def rss_margin_m(ego: EgoStates, tracks: Tracks) -> F64:
    """Return ``(T,)`` by how much the gap to who is ahead exceeds the safe one, the least of all;
    infinite where nobody is ahead.

    Ahead is whose box reaches into the strip that the ego's box sweeps if it goes straight on, and
    whose middle is before the ego's.
    """
    to = tracks.xy - ego.centre
    along = to[..., 0] * ego.heading[:, 0] + to[..., 1] * ego.heading[:, 1]
    lateral = np.abs(to[..., 1] * ego.heading[:, 0] - to[..., 0] * ego.heading[:, 1])
    c = np.abs(np.cos(tracks.yaw - ego.yaw))
    s = np.abs(np.sin(tracks.yaw - ego.yaw))
    length, width = (tracks.size[:, [axis]] / 2 for axis in (0, 1))
    gap_m = along - ego.size[0] / 2 - (length * c + width * s)
    ahead_mps = (
        tracks.velocity[..., 0] * ego.heading[:, 0] + tracks.velocity[..., 1] * ego.heading[:, 1]
    )
    margin_m = gap_m - safe_distance_m(
        np.broadcast_to(np.maximum(ego.velocity[:, 0], 0.0), gap_m.shape), ahead_mps
    )
    counts = tracks.is_present & (along > 0) & (lateral < ego.size[1] / 2 + length * s + width * c)
    return np.where(counts, margin_m, np.inf).min(axis=0, initial=np.inf)


def evaluate_motion(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give the metrics of motion per step; nothing by AlpaSim's presets, whose metrics are
    AlpaSim's.
    """
    if preset.aliases:
        return []
    t_us = rollout.ego.t_us
    drive = ScoredRollout(rollout, scene, preset, rollout.ego)
    enough = len(t_us) > nuplan.LEAST_INSTANTS
    moves = nuplan.motion(drive.ego) if enough else None
    against = (
        drive.against_m >= nuplan.AGAINST_M
        if drive.has_map
        else np.zeros(len(t_us), dtype=np.bool_)
    )
    margin_m = rss_margin_m(drive.ego, drive.tracks)
    return [
        series(
            "hard_brake",
            t_us,
            False if not enough else smooth(drive.ego.accel[:, 0]) < nuplan.COMFORT["lon_accel"][0],
            enough,
            FEW,
        ),
        series(
            "uncomfortable",
            t_us,
            False if moves is None else nuplan.uncomfortable(moves),
            enough,
            FEW,
        ),
        series(
            "time_to_collision_s",
            t_us,
            np.minimum(time_to_collision_s(drive.ego, drive.tracks), nuplan.TTC_HORIZON_S),
        ),
        series("rss_margin_m", t_us, margin_m, np.isfinite(margin_m), NO_ONE_AHEAD),
        series("wrong_way", t_us, against, drive.has_map, NO_LANES),
        series(
            "red_light",
            t_us,
            False if drive.ran_red is None else drive.ran_red,
            drive.ran_red is not None,
            NO_STATES,
        ),
    ]


FACTORY = with_preset(evaluate_motion)
