"""Measure how well neighbouring cameras agree where they see the same surface: each camera's frame
is carried into its neighbours' views by the true depth.

Usage: python docs/scripts/camera_agreement.py urban/one_way smoke/curve
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import cv2
import numpy as np

from alpasim_plugin import load_scenario, make_renderer
from alpasim_plugin.core.geometry import inverse, transform_points
from alpasim_plugin.core.types import F64, Bool, Frame, RenderRequest, Scenario
from alpasim_plugin.runs.cameras import recorded_requests

RIG = "cameras=[{name: front, hfov_deg: 100, x_m: 1.7}, {name: left, hfov_deg: 100, x_m: 1.7, y_m: 0.4, yaw_deg: 60}, {name: right, hfov_deg: 100, x_m: 1.7, y_m: -0.4, yaw_deg: -60}]"
FRAMES, STEP_US, FIRST_US = 20, 100_000, 1_000_000
LATERAL_OFFSET_M = 1.0
SAME_DEPTH = 0.03  # of a surface in two views
BRIGHT, ROAD_M = 150, 0.15  # lane markings: grey level, and height above the road


def requests_at(scenario: Scenario, t_us: int) -> list[RenderRequest]:
    """Return a request for each camera, to the left of the recorded path."""
    requests = recorded_requests(scenario, t_us)
    shift = np.eye(4)
    shift[:3, 3] = LATERAL_OFFSET_M * rig_of(requests[0])[:3, 1]
    return [replace(one, T_world_camera=shift @ one.T_world_camera) for one in requests]


def rig_of(request: RenderRequest) -> F64:
    """Return the pose of the rig, ``(4, 4)``."""
    return request.T_world_camera[1] @ inverse(request.camera.T_rig_camera)


def surface(request: RenderRequest, depth: F64) -> F64:
    """Return the world point of each pixel, ``(H, W, 3)``."""
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    pixels = np.stack([column, row, np.ones_like(row)], axis=-1)
    rays = pixels @ np.linalg.inv(request.camera.K).T
    points = transform_points(request.T_world_camera[1], (rays * depth[..., None]).reshape(-1, 3))
    return points.reshape(*depth.shape, 3)


def carried(source: RenderRequest, frame: Frame, depth: F64, points: F64) -> tuple[F64, Bool]:
    """Return the colours of a frame at world points ``(H, W, 3)``, and where it sees them."""
    there = transform_points(inverse(source.T_world_camera[1]), points.reshape(-1, 3))
    there = there.reshape(points.shape)
    at = there @ source.camera.K.T / np.maximum(there[..., 2:], 1e-6) - 0.5
    column, row = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    seen_m = cv2.remap(depth, column, row, cv2.INTER_NEAREST)  # 0 outside of the image
    is_seen = np.abs(seen_m - there[..., 2]) < SAME_DEPTH * there[..., 2]
    return cv2.remap(frame.rgb, column, row, cv2.INTER_LINEAR).astype(float), is_seen


def main(scenes: Sequence[str]) -> None:
    """Print PSNR in decibels behind each renderer."""
    for scene in scenes:
        scenario = load_scenario(scene, overrides=[RIG])
        times = [scenario.start_us + FIRST_US + i * STEP_US for i in range(FRAMES)]
        instants = [requests_at(scenario, t_us) for t_us in times]
        clean = make_renderer("clean", scenario)
        depths = [[frame.depth for frame in clean.render_batch(requests)] for requests in instants]
        for name in ("clean", "3dgs", "onefixer"):
            renderer = make_renderer(name, scenario)
            squares: dict[str, list[F64]] = defaultdict(list)
            for requests, depth in zip(instants, depths, strict=True):
                frames = renderer.render_batch(requests)
                for a, b in permutations(range(len(requests)), 2):
                    points = surface(requests[b], depth[b])
                    colours, is_seen = carried(requests[a], frames[a], depth[a], points)
                    is_seen &= depth[b] > 0
                    error = (colours - frames[b].rgb) ** 2
                    height_m = points[..., 2] - rig_of(requests[b])[2, 3]
                    is_marked = (frames[b].rgb.min(axis=2) > BRIGHT) & (np.abs(height_m) < ROAD_M)
                    squares["all"].append(error[is_seen])
                    squares["lane markings"].append(error[is_seen & is_marked])
            print(scene, name, {what: round(psnr(value), 1) for what, value in squares.items()})


def psnr(squares: Sequence[F64]) -> float:
    """Return the PSNR of squared errors in grey levels, in decibels."""
    return float(10 * np.log10(255**2 / np.concatenate(squares).mean()))


if __name__ == "__main__":
    main(sys.argv[1:])
