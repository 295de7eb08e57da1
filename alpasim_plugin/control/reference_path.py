"""A plan as the reference of the tracker: a path over signed arc length, and the arc length over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import yaw_from_quat
from alpasim_plugin.core.types import F64, Trajectory

MIN_SPACING_M = 0.25  # closer poses say nothing about the path's direction


@dataclass(frozen=True)
class ReferencePath:
    """A plan in coordinates around ``origin``; arc length is signed: it falls where the plan drives backwards."""

    t_s: F64  # (T,) seconds after the state's time
    s_m: F64  # (T,) signed progress at t_s; 0 at the first pose
    path_s: F64  # (P,) increasing progress of the path's knots
    path_xy: F64  # (P, 2) metres, world axes, relative to the origin

    def progress(self, t_s: F64) -> F64:
        """Return the progress (K,) planned for times (K,); the first and last pose are held outside the plan."""
        return np.asarray(np.interp(t_s, self.t_s, self.s_m))

    def at(self, s_m: F64) -> tuple[F64, F64]:
        """Return points (K, 2) and left normals (K, 2) of the path at progress (K,), straight beyond its ends."""
        knots = self.path_s
        i = np.clip(np.searchsorted(knots, s_m, side="right") - 1, 0, len(knots) - 2)
        step = self.path_xy[i + 1] - self.path_xy[i]
        span = knots[i + 1] - knots[i]
        point = self.path_xy[i] + ((s_m - knots[i]) / span)[:, None] * step
        tangent = step / np.linalg.norm(step, axis=1, keepdims=True)
        return point, np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)

    def project(self, xy: F64, near_s: float, window_m: float) -> float:
        """Return the progress of the path point nearest to ``xy`` (2,), searched within ``window_m`` of ``near_s``."""
        s = near_s + np.linspace(-window_m, window_m, 41)
        point, _ = self.at(s)
        k = int(np.argmin(np.sum((point - xy) ** 2, axis=1)))
        foot, normal = self.at(s[k : k + 1])
        along = np.array([normal[0, 1], -normal[0, 0]])
        return float(s[k] + np.clip((xy - foot[0]) @ along, -window_m / 20, window_m / 20))


def build_reference_path(plan: Trajectory, t_us: int, origin_xy: F64) -> ReferencePath:
    """Read a checked plan relative to a time and a place.

    A step counts by its component along the pose's heading, so noise on a standing plan adds up to nothing instead of to a speed.
    The path keeps only knots that lie ``MIN_SPACING_M`` further than every knot before; a plan that never gets that far is a point,
    and its path is the straight line through it along its heading.
    """
    xy = plan.xyz[:, :2] - origin_xy
    yaw = yaw_from_quat(plan.quat)
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    mean = heading[:-1] + heading[1:]
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    s = np.concatenate([[0.0], np.cumsum(np.sum(np.diff(xy, axis=0) * mean, axis=1))])
    # Knots in the order of time while the plan drives one way; the way is the sign of the furthest excursion.
    sign = 1.0 if s[np.argmax(np.abs(s))] >= 0 else -1.0
    keep = [0]
    for i in range(1, len(s)):
        # Headings that contradict the motion can make progress where nothing moves: such a step has no direction.
        moved = float(np.hypot(*(xy[i] - xy[keep[-1]])))
        if sign * (s[i] - s[keep[-1]]) >= MIN_SPACING_M and moved >= 0.5 * MIN_SPACING_M:
            keep.append(i)
    path_s, path_xy = s[keep], xy[keep]
    if len(keep) == 1:
        path_s = np.array([s[0] - 1.0, s[0] + 1.0])
        path_xy = np.stack([xy[0] - heading[0], xy[0] + heading[0]])
    elif sign < 0:
        path_s, path_xy = path_s[::-1], path_xy[::-1]
    return ReferencePath((plan.t_us - t_us).astype(np.float64) * 1e-6, s, path_s, path_xy)
