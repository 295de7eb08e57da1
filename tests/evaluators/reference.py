"""Reference implementations that tests hold the route, plan and lane evaluators to: one step at a
time, no filters, no caches.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, interpolate, rectangle_corners, yaw_of
from evaluators.metrics.footprint import origin_of
from evaluators.metrics.presets import PRESETS
from evaluators.metrics.route import moving, recorded_path
from tests.evaluators.reference_rules import actor_corners, exact, point_to_segment, sides_of, touch


def convex_contains(ring, body):
    """Return whether a convex ring ``(N, 2)`` in either order contains a body's corners, its border
    included. Exact.
    """
    exact_ring = exact(ring)
    for x, y in exact(body):
        turns = [
            (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in sides_of(exact_ring)
        ]
        if not (all(turn >= 0 for turn in turns) or all(turn <= 0 for turn in turns)):
            return False
    return True


# --- recorded path


@dataclass(frozen=True)
class StepRoute:
    """Where one step stands against the recording."""

    distance_m: float
    away_m: float  # from the recorded position at the same time
    progress: float
    progress_rel: float


def route_by_step(rollout):
    """Project every step on the recorded path, segment by segment; the recording must cover all
    steps and have a length.
    """
    recorded = recorded_path(rollout, PRESETS["paper"])
    path = recorded.xyz[:, :2]
    there = interpolate(recorded, rollout.ego.t_us)[:, :2, 3]
    line = path[moving(path)]
    out = []
    s = float(np.interp(rollout.ego.t_us[0], recorded.t_us[moving(path)], arc_lengths(line)))
    before = there[0]
    for i in range(len(rollout.ego)):
        point = rollout.ego.xyz[i, :2]
        distance_m, _, _ = _along(path, point)
        _, s, length = _along(line, point, s, 2 + 2 * math.dist(point, before))
        before = point
        _, s_rel, length_rel = _along(there[: i + 1], point)
        rel = s_rel / length_rel if length_rel > 0 else 1.0
        out.append(StepRoute(distance_m, float(np.linalg.norm(point - there[i])), s / length, rel))
    return out


def _along(path, point, about_m=0.0, reach_m=math.inf):
    """Return (distance, arc length of the first nearest point at most ``reach_m`` from ``about_m``,
    total length).
    """
    best = math.inf
    best_s = 0.0
    s = 0.0
    if len(path) == 1:
        return float(np.linalg.norm(point - path[0])), 0.0, 0.0
    for a, b in pairwise(path.tolist()):
        length = math.dist(a, b)
        low, high = (
            min(max((about_m + sign * reach_m - s) / length, 0.0), 1.0) if length > 0 else 0.0
            for sign in (-1, 1)
        )
        ends = [[p + f * (q - p) for p, q in zip(a, b, strict=True)] for f in (low, high)]
        distance, f = point_to_segment(point.tolist(), *ends)
        if distance < best and s <= about_m + reach_m and s + length >= about_m - reach_m:
            best = distance
            best_s = s + (low + f * (high - low)) * length
        s += length
    return best, best_s, s


# --- plans


def open_loop_by_plan(rollout, preset):
    """Return for each plan with poses whether any of them within the horizon touches an actor;
    sharp-cornered footprints only.
    """
    origin = origin_of(rollout.ego_log, preset)
    size = np.array(preset.ego_size_m or (rollout.ego_box.length_m, rollout.ego_box.width_m)) * (
        1.0 - preset.shrink
    )
    out = []
    for plan in rollout.plans:
        hit = False
        for t_us in plan.trajectory.t_us.tolist():
            if not plan.now_us < t_us <= plan.now_us + preset.open_loop_horizon_us:
                continue
            pose = interpolate(plan.trajectory, t_us) @ rollout.T_rig_box
            ego = rectangle_corners(
                pose[None, :2, 3] - origin[:2], np.array([yaw_of(pose)]), size[None]
            )[0]
            boxes = [
                actor_corners(actor, t_us, preset, origin) for actor in rollout.actors.values()
            ]
            hit = hit or any(box is not None and touch(ego, box) for box in boxes)
        if len(plan.trajectory):
            out.append(hit)
    return out
