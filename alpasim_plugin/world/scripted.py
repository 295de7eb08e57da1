"""Tracks of scripted road users, made once when a scene is loaded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import F64, I64, Box, Trajectory
from alpasim_plugin.world.path import Path, smoothstep

STEP_US = 50_000  # a 20 Hz track: linear interpolation errs by less than 3 mm at 7 m/s^2


def grid(start_us: int, end_us: int, step_us: int = STEP_US) -> I64:
    """Return times from start to end in steps; the last one is the end itself."""
    t = np.arange(start_us, end_us, step_us, dtype=np.int64)
    return np.append(t, np.int64(end_us))


def speed_profile(t_us: I64, rows: Sequence[tuple[float, float]]) -> F64:
    """Return speeds ``(T,)`` of rows (time in seconds after ``t_us[0]``, m/s), linear in between, constant outside."""
    t_s = (t_us - t_us[0]).astype(np.float64) * 1e-6
    times, values = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
    return np.asarray(np.interp(t_s, times, values))


def brake_rows(
    speed_mps: float, brake_at_us: int, decel_mps2: float, end_speed_mps: float, resume_at_us: int | None, accel_mps2: float = 2.0
) -> list[tuple[float, float]]:
    """Return the speed rows of a driver who brakes and may drive on."""
    t0 = brake_at_us * 1e-6
    t1 = t0 + (speed_mps - end_speed_mps) / decel_mps2
    rows = [(t0, speed_mps), (t1, end_speed_mps)]
    if resume_at_us is not None:
        t2 = max(resume_at_us * 1e-6, t1 + 1e-3)
        rows += [(t2, end_speed_mps), (t2 + (speed_mps - end_speed_mps) / accel_mps2, speed_mps)]
    return rows


def integrate(t_us: I64, speed_mps: F64, s0_m: float) -> F64:
    """Return arc lengths ``(T,)`` of a speed that is linear between samples."""
    dt = np.diff(t_us).astype(np.float64) * 1e-6
    return np.concatenate([[s0_m], s0_m + np.cumsum(dt * 0.5 * (speed_mps[1:] + speed_mps[:-1]))])


def track_on_path(path: Path, t_us: I64, s_m: F64, box: Box, offset_m: npt.ArrayLike = 0.0) -> Trajectory:
    """Return the box-centre track of a body at arc lengths ``(T,)`` of a path, cut where the path ends (the body leaves the scene).

    A lateral offset that changes turns the body by the slope of its motion.
    """
    offset = np.broadcast_to(np.asarray(offset_m, dtype=np.float64), s_m.shape)
    keep = (s_m >= 0) & (s_m <= path.length_m)
    if not keep.all():
        keep = np.arange(len(s_m)) < (int(np.argmin(keep)) or 0)
    xyz, yaw = path.at(s_m, offset)
    if len(s_m) > 1 and np.ptp(offset) > 0:
        ds, dd = np.gradient(s_m), np.gradient(offset)
        yaw = yaw + np.arctan2(dd, np.maximum(ds, 1e-6))
    xyz = xyz + np.array([0.0, 0.0, box.height_m / 2])
    return Trajectory(t_us[keep], xyz[keep], quat_from_yaw(yaw[keep]))


def cut_in_track(path_from: Path, path_to: Path, t_us: I64, s_m: F64, box: Box, at_us: int, change_us: int) -> Trajectory:
    """Return the track of a lane change: quintic in time between two neighbouring paths.

    Args:
        path_from: Middle of the lane at the start.
        path_to: Middle of the lane afterwards.
        t_us: ``(T,)`` times; ``at_us`` counts from the first.
        s_m: ``(T,)`` arc lengths on ``path_from``.
        box: Size of the vehicle.
        at_us: Start of the lateral motion.
        change_us: Its duration.
    """
    points, _ = path_from.at(s_m)
    _, distance = path_to.project(points[:, :2])
    share = smoothstep((t_us - t_us[0] - at_us) / change_us)
    return track_on_path(path_from, t_us, s_m, box, -distance * share)


def walk_track(start: F64, end: F64, t_us: I64, begin_us: int, speed_mps: float, box: Box) -> Trajectory:
    """Return the track of someone who stands at ``start``, walks to ``end`` from ``begin_us`` on, and stands there.

    Speed rises and falls within 0.4 s at the ends; the mean crossing is at ``speed_mps``.
    """
    distance = float(np.hypot(*(end - start)[:2]))
    t_s = (t_us - begin_us).astype(np.float64) * 1e-6
    ramp_s = min(0.4, distance / speed_mps / 2)
    total_s = distance / speed_mps + ramp_s
    t = np.clip(t_s, 0.0, total_s)
    up = np.minimum(t, ramp_s)
    down = np.maximum(t - (total_s - ramp_s), 0.0)
    s = speed_mps * (up * up / (2 * ramp_s) + np.maximum(t - ramp_s, 0.0) - down * down / (2 * ramp_s))
    share = np.clip(s / distance, 0.0, 1.0)[:, None]
    xyz = start + share * (end - start)
    xyz = xyz + np.array([0.0, 0.0, box.height_m / 2])
    yaw = np.arctan2(end[1] - start[1], end[0] - start[0])
    return Trajectory(t_us, xyz, quat_from_yaw(np.full(len(t_us), yaw)))


def standing_track(x_m: float, y_m: float, z_m: float, yaw_rad: float, t_us: I64, box: Box) -> Trajectory:
    """Return the track of a body that never moves: two poses, at the first and the last time."""
    ends = np.array([t_us[0], t_us[-1]], dtype=np.int64)
    xyz = np.tile([x_m, y_m, z_m + box.height_m / 2], (2, 1))
    return Trajectory(ends, xyz, quat_from_yaw(np.full(2, yaw_rad)))
