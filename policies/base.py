"""Policies by name, and what policies share: the times of a plan, the camera to look through and
its newest frame, and the way from a path and a wish for speed to a plan that a car can drive.
"""

import math
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.geometry import arc_lengths, heading_of, left_of, resample
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.parts import build, unidentified
from alpasim_plugin.core.spline import CubicSpline
from alpasim_plugin.core.types import F64, I64, CameraSpec, Frame, Observation, Scenario

# AlpaSim's minADE needs samples that reach its longest horizon, 5 s; shorter ones lose all four
# metrics
PLAN_HORIZON_S = 5.0
PLAN_STEP_US = 100_000

MIN_CRUISE_MPS = 6.0  # where the drive begins at standstill there is no speed to keep
MAX_LATERAL_MPS2 = 2.5  # comfort in curves
COMFORT_BRAKE_MPS2 = 2.0  # before a curve
# Towards a limit of speed
ACCEL_MPS2 = 1.5
BRAKE_MPS2 = 4.0
FAR_M = 10.0  # a route that begins farther ahead has no points nearer
MIN_LOOKAHEAD_M = 3.0
CUT_M = 0.15
LOOKAHEAD_S = 0.7
SMOOTH_S = 0.8
MAX_CURVATURE_1PM = 0.2  # turning radius 5 m
MAX_PURSUIT_MPS2 = 4.0  # a target far to the side is met no harder than this


def make_policy(name: str, scenario: Scenario) -> Policy:
    """Return a policy for a scenario.

    Args:
        name: A policy as `alpasim_plugin.core.parts.resolve` takes it: a registered name,
            ``package.module:Class`` or ``file.py:Class``.
        scenario: What the policy will drive in. A policy under test should take no more from it
            than its cameras.

    Raises:
        InputError: The name is unknown, the import fails, or what it makes is not a policy.
        PolicyError: The policy raised while it was made.
    """
    return build(unidentified("policy", name), scenario=scenario)


def plan_times(t_us: int) -> I64:
    """Return the times ``(T,)`` of a plan made at ``t_us``: now and every 0.1 s up to the
    horizon.
    """
    n = round(PLAN_HORIZON_S * 1_000_000 / PLAN_STEP_US)
    return t_us + PLAN_STEP_US * np.arange(n + 1)


def seconds(times_us: I64) -> F64:
    """Return the seconds ``(T,)`` from the first of the times; the difference is taken in
    integers.
    """
    return (times_us - times_us[0]) * 1e-6


def front_camera(scenario: Scenario) -> CameraSpec:
    """Return the camera to look through: the first pinhole with "front" in its name, else the first
    one that looks ahead.

    Raises:
        InputError: No pinhole looks ahead.
    """
    ahead = [
        camera
        for camera in scenario.cameras
        if camera.T_rig_camera[0, 2] > 0.7 and camera.lens is None
    ]
    for camera in sorted(ahead, key=lambda camera: "front" not in camera.name):
        return camera
    raise InputError(
        f"scene {scenario.scene_id!r}: no pinhole looks ahead among its cameras {', '.join(camera.name for camera in scenario.cameras)}",
        "Set `lens: pinhole` of one that looks ahead in `cameras`, add one, or choose another policy.",
    )


def camera_frame(observation: Observation, camera: CameraSpec, policy: str) -> Frame:
    """Return the newest frame of a camera.

    Args:
        observation: What the policy receives.
        camera: Which camera, and at which size.
        policy: Name of the policy, for the error.

    Raises:
        PolicyError: The observation has no frame of the camera, or one of another size.
    """
    frame = observation.frames.get(camera.name)
    expected = (camera.height, camera.width)
    if frame is None or frame.size != expected:
        problem = (
            f"frames of {sorted(observation.frames)}"
            if frame is None
            else f"a frame of {frame.size}"
        )
        raise PolicyError(
            f"policy {policy!r} at {observation.t_us} us: {problem}; needed is {camera.name!r} of {expected} (height, width)",
            "render the cameras that the policy names in `sensors`, at the scenario's size",
        )
    return frame


@dataclass(frozen=True)
class Path:
    """A path in the rig frame, one point every ``SPACING_M``."""

    SPACING_M = 1.0

    xy: F64  # (N, 2) metres
    curvature: F64  # (N,) 1/m, left positive


def route_left(route_rig: F64) -> F64 | None:
    """Return the points ``(M, 2)`` of the route ``(20, 3)`` before its NaN rows; None where less
    than half a metre of it is left.

    The route begins at the ego's projection, so the first point may lie beside the ego. Where its
    points begin far ahead (``route.start_offset_m``), a straight line leads there from the ego.
    """
    points = route_rig[np.isfinite(route_rig).all(axis=1), :2]
    if len(points) and points[0, 0] > FAR_M:
        points = np.concatenate([np.zeros((1, 2)), points])
    return points if len(points) >= 2 and float(np.hypot(*(points[-1] - points[0]))) > 0.5 else None


def route_points(route_rig: F64) -> F64:
    """Return the points of `route_left`; straight ahead where no route is left."""
    left = route_left(route_rig)
    if left is not None:
        return left
    points = route_rig[np.isfinite(route_rig).all(axis=1), :2]
    start = points[0] if len(points) else np.zeros(2)
    return np.stack([start, start + np.array([1.0, 0.0])])


def smooth_line(points: F64) -> F64:
    """Return the cubic spline through points ``(M, 2)``, at every `Path.SPACING_M` of chord length.

    A route comes as points 4.2 m apart; on a bend of 10 m radius its polyline runs 0.2 m inside the
    road.
    """
    s = arc_lengths(points)
    keep = np.concatenate([[True], s[1:] - s[:-1] > 1e-6])
    samples = np.arange(0.0, max(float(s[-1]), Path.SPACING_M) + 1e-9, Path.SPACING_M)
    if keep.sum() < 3:
        return resample(points, samples, s)
    return CubicSpline.through(s[keep], points[keep]).at(np.minimum(samples, s[-1]))


def extended(points: F64, length_m: float) -> F64:
    """Return a line through points ``(M, 2)``, one every `Path.SPACING_M`, that goes straight on up
    to ``length_m``.
    """
    s = arc_lengths(points)
    tail = points[-1] - resample(points, [max(s[-1] - 5.0, 0.0)], s)[0]
    tail = tail / max(float(np.hypot(*tail)), 1e-9)
    missing = max(length_m - s[-1], 1.0)
    line = np.concatenate([points, (points[-1] + missing * tail)[None]])
    return resample(line, np.arange(0.0, s[-1] + missing, Path.SPACING_M))


def make_path(points: F64, length_m: float = 120.0, speed_mps: float = 0.0) -> Path:
    """Return a path through points ``(M, 2)``, resampled and extended straight to ``length_m``.

    Its curvature is that of a heading averaged over what is driven in `SMOOTH_S`, at least 5 m: a
    coarse polyline has corners, an estimate wobbles, and a car feels neither.

    Args:
        points: In driving order, at least two apart by more than a centimetre.
        length_m: Shortest length of the result.
        speed_mps: At which it will be driven.
    """
    xy = extended(points, length_m)
    step = np.gradient(xy, axis=0)
    heading = np.unwrap(heading_of(step))
    half = round(max(5.0, SMOOTH_S * speed_mps) / Path.SPACING_M / 2)
    kernel = np.full(2 * half + 1, 1.0 / (2 * half + 1))
    padded = np.concatenate([np.full(half, heading[0]), heading, np.full(half, heading[-1])])
    return Path(xy, np.gradient(np.convolve(padded, kernel, mode="valid"), Path.SPACING_M))


def shifted(line: F64, left_m: float) -> F64:
    """Return a line ``(M, 2)`` shifted to the left."""
    step = np.gradient(line, axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
    return line + left_m * left_of(step) / length[:, None]


def curve_speeds(path: Path, cruise_mps: float) -> F64:
    """Return the speed limit ``(N,)`` along the path: comfort in curves, reached with a comfortable
    brake.
    """
    curve = np.sqrt(MAX_LATERAL_MPS2 / np.maximum(np.abs(path.curvature), 1e-4))
    limit = np.minimum(curve, cruise_mps)
    # Backward pass: v_i^2 <= v_j^2 + 2 a (s_j - s_i) for every j > i.
    reach = 2 * COMFORT_BRAKE_MPS2 * Path.SPACING_M * np.arange(len(limit))
    squared = np.minimum.accumulate((limit**2 + reach)[::-1])[::-1] - reach
    return np.sqrt(np.maximum(squared, 0.0))


def speed_profile(speed_mps: float, limits: F64, t_s: F64) -> F64:
    """Return the progress ``(T,)`` at times ``(T,)`` of a car that nears the limits ``(N,)`` along
    its path within its comfort.
    """
    progress = np.zeros_like(t_s)
    speed = speed_mps
    ahead = limits.tolist()
    for k in range(1, len(t_s)):
        dt = float(t_s[k] - t_s[k - 1])
        limit = ahead[min(int(progress[k - 1] / Path.SPACING_M), len(ahead) - 1)]
        after = min(max(limit, speed - BRAKE_MPS2 * dt), speed + ACCEL_MPS2 * dt)
        progress[k] = progress[k - 1] + 0.5 * (speed + after) * dt
        speed = after
    return progress


def follow(path: Path, progress: F64, speed_mps: float) -> tuple[F64, F64]:
    """Return positions ``(T, 2)`` and headings ``(T,)`` of a car that starts at the rig origin and
    pursues the path.

    Pure pursuit (Coulter 1992, CMU-RI-TR-92-01): at each moment an arc to the path point one
    lookahead away. Each step of the roll-out is an exact arc, so the plan starts at the car's pose
    and heading and can be driven.
    """
    lookahead = max(MIN_LOOKAHEAD_M, LOOKAHEAD_S * speed_mps)
    # On an arc of curvature k the chord of a lookahead cuts the corner by lookahead^2 k / 8.
    tightest = float(np.abs(path.curvature[: round(15.0 / Path.SPACING_M)]).max())
    lookahead = min(lookahead, max((8 * CUT_M / max(tightest, 1e-6)) ** 0.5, MIN_LOOKAHEAD_M))
    limit = min(MAX_CURVATURE_1PM, MAX_PURSUIT_MPS2 / max(speed_mps**2, 1.0))
    points = path.xy.tolist()
    x = y = yaw = 0.0
    out = [(x, y, yaw)]
    nearest = 0
    for ds in np.diff(progress).tolist():
        nearest, target = _targets(points, x, y, nearest, lookahead * lookahead)
        dx = points[target][0] - x
        dy = points[target][1] - y
        left = -math.sin(yaw) * dx + math.cos(yaw) * dy
        curvature = min(max(2 * left / max(dx * dx + dy * dy, 1e-6), -limit), limit)
        half = 0.5 * curvature * ds
        chord = ds * (math.sin(half) / half if abs(half) > 1e-8 else 1.0)
        x += chord * math.cos(yaw + half)
        y += chord * math.sin(yaw + half)
        yaw += 2 * half
        out.append((x, y, yaw))
    poses = np.array(out)
    return poses[:, :2].copy(), poses[:, 2].copy()


def _targets(
    points: list[list[float]], x: float, y: float, start: int, far_m2: float
) -> tuple[int, int]:
    """Return the index of the nearest of eight points from ``start`` on, and of the first later
    point at least so far away, squared.
    """
    near = [(dx := px - x) * dx + (dy := py - y) * dy for px, py in points[start : start + 8]]
    nearest = near.index(min(near))
    for i in range(nearest, len(near)):
        if near[i] >= far_m2:
            return start + nearest, start + i
    for i in range(start + len(near), len(points)):
        if (points[i][0] - x) ** 2 + (points[i][1] - y) ** 2 >= far_m2:
            return start + nearest, i
    return start + nearest, len(points) - 1
