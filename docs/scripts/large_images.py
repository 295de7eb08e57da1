"""Measure how far images with the pixels per radian of 1900 across 120 degrees are from the built
street drawn at four times their size and averaged.

Usage: python docs/scripts/large_images.py urban/one_way
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import cv2
import numpy as np

from alpasim_plugin import load_scenario, make_renderer
from alpasim_plugin.core.geometry import inverse, transform_points
from alpasim_plugin.core.types import F64, RenderRequest
from alpasim_plugin.fixers.warp import on_boxes, place_boxes
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from alpasim_plugin.renderers.gaussian import scene_of
from alpasim_plugin.runs.cameras import recorded_requests

CAMERA = "cameras=[{name: front, width: 960, height: 540, hfov_deg: 55.8, x_m: 1.7, z_m: 1.45, pitch_down_deg: 0}]"
SMALLER = "scale=5"  # as a third of the wide camera of alpasim-4 has
T_US, STEP_US, FRAMES, LATERAL_OFFSET_M = 3_500_000, 100_000, 3, 0.6
TIMES, BANDS = 4, 4


def request_at(scenario, t_us: int) -> RenderRequest:
    """Return the camera's request, to the left of the recorded path."""
    (one,) = recorded_requests(scenario, t_us)
    rig = one.T_world_camera[1] @ inverse(one.camera.T_rig_camera)
    shift = np.eye(4)
    shift[:3, 3] = LATERAL_OFFSET_M * rig[:3, 1]
    return replace(one, T_world_camera=shift @ one.T_world_camera)


def averaged(graph: SceneGraph, request: RenderRequest) -> F64:
    """Return the street drawn at four times the size and averaged, grey levels ``(H, W, 3)``."""
    spec = request.camera
    K = np.diag([TIMES, TIMES, 1.0]) @ spec.K
    width, height = TIMES * spec.width, TIMES * spec.height
    whole = PinholeCamera.from_pose(width, height, K, request.T_world_camera[1])
    parts = []
    for i in range(BANDS):
        rows = slice(i * height // BANDS, (i + 1) * height // BANDS)
        rgb = graph.render(whole.window(rows, slice(0, width)), request.actors).rgb
        parts.append(rgb.reshape(-1, TIMES, spec.width, TIMES, 3).mean(axis=(1, 3)))
    return 255 * np.concatenate(parts).astype(np.float64)


def regions(scenario, graph: SceneGraph, request: RenderRequest, truth: F64):
    """Return by name which pixels belong to a part of the street."""
    spec, T = request.camera, request.T_world_camera[1]
    camera = PinholeCamera.from_pose(spec.width, spec.height, spec.K, T)
    out = graph.render(camera, request.actors)
    depth = np.where(out.alpha > 0.5, out.depth, 0)
    boxes = {actor.actor_id: actor.box for actor in scenario.actors}
    vehicles = on_boxes(
        depth.shape, place_boxes(depth.shape, spec.K, T, request.actors, boxes).seen
    )
    row, column = np.mgrid[: spec.height, : spec.width] + 0.5
    rays = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(spec.K).T
    points = rays * depth[..., None]
    above_m = transform_points(T, points.reshape(-1, 3))[:, 2].reshape(depth.shape)
    above_m -= request.T_world_camera[1][2, 3] - spec.T_rig_camera[2, 3]
    away_m = np.linalg.norm(points, axis=-1)
    sky, low = depth == 0, (depth > 0) & (above_m < 0.2) & ~vehicles
    bright = (truth.min(axis=2) > 140) | (truth[..., 0] - truth[..., 2] > 60)
    marked = low & (cv2.dilate(bright.astype(np.uint8), np.ones((5, 5))) > 0) & (away_m < 60)
    green = (truth[..., 1] > truth[..., 0] + 4) & (truth[..., 1] > truth[..., 2] + 8)
    leaves = ~sky & ~vehicles & (above_m > 1.5) & green
    return {
        "all": np.ones_like(sky),
        "lane markings": marked,
        "vehicles": vehicles & ~sky,
        "vegetation": leaves,
        "houses": ~sky & ~vehicles & ~leaves & (above_m > 0.5) & (away_m < 40),
        "sky": sky,
        "beyond 40 m": ~sky & (away_m > 40),
    }


def main(scene: str) -> None:
    """Print PSNR in decibels by region and CPU seconds a frame behind each renderer."""
    scenario = load_scenario(scene, overrides=[CAMERA])
    graph = scene_of(scenario)
    last = request_at(scenario, T_US)
    truth = averaged(graph, last)
    parts = regions(scenario, graph, last, truth)
    for name in ("clean", "3dgs", "onefixer"):
        began = time.process_time()
        renderer = make_renderer(name, scenario, overrides=[SMALLER] if name == "onefixer" else [])
        built_s = time.process_time() - began
        for i in reversed(range(FRAMES)):
            began = time.process_time()
            frame = renderer.render(request_at(scenario, T_US - i * STEP_US))
            frame_s = time.process_time() - began
        squares = (frame.rgb.astype(np.float64) - truth) ** 2
        levels = {
            part: round(float(10 * np.log10(255**2 / squares[where].mean())), 1)
            for part, where in parts.items()
        }
        print(scene, name, levels, f"{built_s:.0f} s to build, {frame_s:.2f} s a frame", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
