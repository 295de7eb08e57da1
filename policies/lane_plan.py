"""From the estimated lane, route and obstacle to a plan: path, speed, and sampled alternatives."""

import math
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, direction_of, heading_of, left_of, resample
from alpasim_plugin.core.types import F64
from policies.base import Path, make_path
from policies.lane_filter import LaneState
from policies.obstacle_vision import ObstacleTrack

ROUTE_SIGMA_M = 0.75  # how far a lane's centre may lie from the route, for all the policy knows
SAME_LANE_M = 1.5
PATH_M = 70.0
# The route leaves the lane where it is this far off and points this much elsewhere
LEAVE_M = 1.2
LEAVE_RAD = 0.2
LEAVE_BEFORE_M = 8.0

HEADWAY_S = 1.3
MIN_GAP_M = 3.5
IDM_ACCEL_MPS2 = 1.5
IDM_BRAKE_MPS2 = 2.0
HARD_BRAKE_MPS2 = 7.0
IDM_TWICE_MPS2 = 2 * math.sqrt(IDM_ACCEL_MPS2 * IDM_BRAKE_MPS2)

N_SAMPLES = 6
NOISE_LATERAL_M = 0.15
NOISE_SPEED = 0.03
NOISE_S = 3.0
DRIFT_STEPS = 40  # rows of a plan over which a sample drifts by NOISE_SPEED: 4 s
MAX_NOISE_M = 0.5
NOISE_RAMP_M = 12.0


@dataclass(frozen=True)
class RoutePrior:
    """The route near the ego, as a weak guess for the lane."""

    offset_m: float
    heading_rad: float
    curvature_1pm: float


def route_prior(points: F64) -> RoutePrior:
    """Fit the next 20 m of route points ``(M, 2)`` by a parabola in the rig frame."""
    s = arc_lengths(points)
    near = resample(points, np.arange(0.0, min(20.0, max(float(s[-1]), 2.0)) + 0.5, 1.0), s)
    x = near[:, 0]
    y = near[:, 1]
    if x[-1] - x[0] < 5.0:
        return RoutePrior(float(y[0]), float(np.arctan2(y[-1] - y[0], max(x[-1] - x[0], 0.1))), 0.0)
    half_curvature, heading, offset = np.polyfit(x, y, 2)
    return RoutePrior(float(offset), float(heading), float(2 * half_curvature))


@dataclass(frozen=True)
class Blend:
    """The path to drive and how it came about."""

    path: Path
    # Share of the route in the lateral position 10 m ahead; 0: lane markings alone.
    route_weight: float
    route_leaves_m: float  # distance at which the route leaves the lane; inf: it does not


def blend(lane: LaneState | None, route: F64 | None, speed_mps: float) -> Blend:
    """Return the path of `fuse`, to be driven at a speed."""
    points, route_weight, route_leaves_m = fuse(lane, route)
    return Blend(make_path(points, PATH_M, speed_mps), route_weight, route_leaves_m)


def fuse(lane: LaneState | None, route: F64 | None) -> tuple[F64, float, float]:
    """Fuse the lane seen and the route ``(M, 2)``, each weighted by its inverse variance, distance
    by distance.

    Near the car the standard deviation of lane markings is a few centimetres against
    `ROUTE_SIGMA_M` of the route, so the route does not affect the lateral position; it takes over
    beyond the lane markings that are seen, where it turns away from the lane (an intersection, an
    exit), and where the two are more than `SAME_LANE_M` apart.

    Returns:
        Points ``(N, 2)``, and the other two of `Blend`.
    """
    if lane is None:
        points = np.array([[0.0, 0.0], [10.0, 0.0]]) if route is None else route
        return points, 0.0 if route is None else 1.0, np.inf
    if route is None:
        x = np.arange(0.0, 40.0)
        y = _straight_beyond(lane, x, max(lane.seen_to_m, 10.0))
        return np.column_stack([x, y]), 0.0, np.inf
    s = arc_lengths(route)
    points = resample(route, np.arange(0.0, max(float(s[-1]), 2.0), 1.0), s)
    step = np.gradient(points, axis=0)
    heading = np.unwrap(heading_of(step))
    x = points[:, 0]
    y = points[:, 1]
    usable = np.logical_and.accumulate((np.abs(heading) < 1.0) & (step[:, 0] > 0.3) & (x > -5.0))
    y_lane = _straight_beyond(lane, x, max(lane.seen_to_m + 15.0, 25.0))
    sigma = lane.sigma(np.maximum(x, 0.0))
    apart = np.abs((y - y_lane) - (y[0] - y_lane[0])) > LEAVE_M
    turned = (
        np.abs(heading - np.arctan(lane.slope(np.minimum(np.maximum(x, 0.0), 30.0)))) > LEAVE_RAD
    )
    leaves = np.inf
    if (apart & turned & usable).any():
        leaves = float(x[np.argmax(apart & turned & usable)])
        sigma = np.hypot(sigma, 0.3 * np.maximum(x - (leaves - LEAVE_BEFORE_M), 0.0))
    off = y_lane - y
    # A lane far from the route is another lane than the route's, not a better estimate of it.
    same_lane = np.exp(-((np.maximum(np.abs(off) - SAME_LANE_M, 0.0) / 0.7) ** 2))
    lane_share = same_lane * ROUTE_SIGMA_M**2 / (ROUTE_SIGMA_M**2 + sigma**2)
    correction = np.where(usable, lane_share * off, 0.0)
    if not usable.all():
        last = max(int(np.argmin(usable)) - 1, 0)
        beyond = np.arange(len(x)) > last
        correction = np.where(
            beyond, correction[last] * np.exp(-(np.arange(len(x)) - last) / 8.0), correction
        )
    normal = left_of(direction_of(heading))
    # The correction is measured along the rig's y axis; along the path's normal it is shorter by
    # the cosine.
    fused = points + normal * (correction * np.cos(heading))[:, None]
    at_10 = int(np.argmin(np.abs(x - 10.0)))
    return fused, float(1.0 - lane_share[at_10]), leaves


def idm_progress(
    speed_mps: float,
    limits: F64,
    t_s: F64,
    obstacle: ObstacleTrack | None,
    bumper_m: float,
    cruise_mps: float,
) -> F64:
    """Return the progress ``(T,)`` of a car that keeps the limits along its path and its distance
    to the obstacle ahead.

    Intelligent driver model (Treiber, Hennecke, Helbing 2000), the obstacle ahead continuing at its
    speed.
    """
    ahead = limits.tolist()
    end = len(ahead) - 1
    cruise = max(float(cruise_mps), 0.1)
    progress = [0.0]
    s = 0.0
    v = max(float(speed_mps), 0.0)
    other_m, other = (
        (math.inf, 0.0)
        if obstacle is None
        else (float(obstacle.distance_m), max(float(obstacle.speed_mps), 0.0))
    )
    for t, dt in zip(t_s.tolist(), np.diff(t_s).tolist(), strict=False):
        sample = int(s / Path.SPACING_M)
        limit = ahead[sample if sample < end else end]
        accel = IDM_ACCEL_MPS2 * (1 - (v / cruise) ** 4) if v < limit else (limit - v) / 0.5
        accel = max(min(accel, (limit - v) / dt), -4.0)
        if obstacle is not None:
            gap = other_m + other * t - s - bumper_m
            wish = MIN_GAP_M + max(v * HEADWAY_S + v * (v - other) / IDM_TWICE_MPS2, 0.0)
            follow = IDM_ACCEL_MPS2 * (1 - (v / max(limit, 0.1)) ** 4 - (wish / max(gap, 0.1)) ** 2)
            accel = max(min(accel, follow), -HARD_BRAKE_MPS2)
        after = max(v + accel * dt, 0.0)
        s += 0.5 * (v + after) * dt
        v = after
        progress.append(s)
    return np.array(progress)


def correlated_noise(before: F64 | None, dt_s: float, random: np.random.Generator) -> F64:
    """Return the noise ``(N_SAMPLES, 2)`` of a step, lateral and speed in standard deviations,
    given that of the step before.

    A first-order Markov process with `NOISE_S` as its time: a policy that errs keeps erring for a
    while. White noise would be filtered away by the vehicle.
    """
    fresh = random.normal(0.0, 1.0, (N_SAMPLES, 2))
    if before is None:
        return fresh
    keep = float(np.exp(-dt_s / NOISE_S))
    return keep * before + np.sqrt(1 - keep**2) * fresh


def sample_sigma_m(lane_sigma_m: float) -> float:
    """Return the lateral standard deviation of the samples, which grows with that of the lane.

    Args:
        lane_sigma_m: Standard deviation of the lane's centre.
    """
    return min(float(np.hypot(NOISE_LATERAL_M, lane_sigma_m)), MAX_NOISE_M)


def sampled(xy: F64, yaw: F64, noise: F64, sigma_m: float) -> list[F64]:
    """Return `N_SAMPLES` versions ``(T, 3)`` of a plan; the first is the plan, which was made with
    the first sample's errors.

    The others differ from it as their errors do: shifted to a side over the first metres, and
    drifting ahead or back over the horizon, so that each is as drivable as the plan itself.

    Args:
        xy: ``(T, 2)`` the plan.
        yaw: ``(T,)`` its headings.
        noise: ``(N_SAMPLES, 2)`` from `correlated_noise`.
        sigma_m: From `sample_sigma_m`.
    """
    s = arc_lengths(xy)
    ramp = np.minimum(s / NOISE_RAMP_M, 1.0)
    ramp_slope = np.where(s < NOISE_RAMP_M, 6 * ramp * (1 - ramp) / NOISE_RAMP_M, 0.0)
    ramp = ramp * ramp * (3 - 2 * ramp)
    ahead = np.arange(len(s)) / DRIFT_STEPS
    shift_m, faster = (noise[1:] - noise[0]).T[:, :, None]
    shift_m = sigma_m * shift_m  # (N_SAMPLES - 1, 1)
    lines = np.empty((len(shift_m), len(s), 3))
    lines[..., :2] = xy + (shift_m * ramp)[..., None] * left_of(direction_of(yaw))
    lines[..., 2] = yaw + np.arctan(shift_m * ramp_slope)
    return [
        np.column_stack([xy, yaw]),
        *_retimed(lines, s, s * (1.0 + NOISE_SPEED * faster * ahead)),
    ]


def _retimed(lines: F64, s: F64, progress: F64) -> F64:
    """Return ``lines`` (K, T, 3) at progress ``progress`` (K, T), straight on beyond the end; a standing
    plan is unchanged.

    Args:
        lines: Rows at progress ``s``.
        s: ``(T,)``.
        progress: Progress of each line.
    """
    if s[-1] < 0.1:
        return lines
    keep = np.concatenate([[True], s[1:] - s[:-1] > 1e-9])
    knots = s[keep]
    kept = lines[:, keep]
    out = np.empty_like(lines)
    for k in range(len(lines)):
        for d in range(3):
            out[k, :, d] = np.interp(progress[k], knots, kept[k, :, d])
    over = np.maximum(progress - s[-1], 0.0)
    end = lines[:, -1:, 2]
    out[..., 0] += over * np.cos(end)
    out[..., 1] += over * np.sin(end)
    return out


def _straight_beyond(lane: LaneState, x: F64, limit_m: float) -> F64:
    """Return the lane's centre, carried on along its tangent beyond ``limit_m``, where a cubic
    would run away.
    """
    inside = np.minimum(np.maximum(x, 0.0), limit_m)
    return lane.centre(inside) + (x - inside) * lane.slope(inside)
