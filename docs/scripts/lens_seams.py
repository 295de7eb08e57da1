"""Measure whether a lens shows the edges of the cube of pinholes that would cover it: how much the image
changes across these edges, over how much it changes across the same lines 12 to 30 pixels beside them.
Above 1, the edges stand out.

Usage: python docs/scripts/lens_seams.py [--images FOLDER]. It draws 24 frames of ``clean``: six streets, a
fisheye of 190 degrees that looks to the left and one that looks ahead, two times, each in one pass and
by pinholes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from lens_times import CAMERAS, seen_through
from pages import table

from alpasim_plugin.cameras.lens import SIDES, rays_of
from alpasim_plugin.cameras.lens_cover import LensCover
from alpasim_plugin.core.types import F64, I64, U8, CameraSpec
from alpasim_plugin.renderers.gaussian import clear_cache
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.lenses import LensRenderer
from alpasim_plugin.runs.renderer import make_renderer

STREETS = 6
YAWS_DEG = (90, 0)
TIMES_US = (1_500_000, 3_000_000)
BESIDE_PX = (-30, -24, -18, -12, 12, 18, 24, 30)
WITHIN_RAD = np.deg2rad(88.0)  # of the axis, where the edges are looked at
LEAST_STEP = 0.2  # grey levels, added to every median, which is often of whole numbers
HEAD = ["drawn", "mean ratio", "largest ratio"]


def edges_of(camera: CameraSpec) -> tuple[I64, I64]:
    """Return the rows and columns ``(2, N)`` of the pixels to the right of which another side of the
    cube covers the image of a camera, and of those below which another does.
    """
    shape = camera.height, camera.width
    ray = rays_of(camera).ray.reshape(*shape, 3)
    side = np.argmax([ray @ np.array(axes[2]) for axes in SIDES.values()], axis=0)
    near = np.arccos(np.clip(ray[..., 2], -1, 1)) < WITHIN_RAD
    across = np.argwhere((side[:, 1:] != side[:, :-1]) & near[:, 1:])
    down = np.argwhere((side[1:] != side[:-1]) & near[1:])
    return across.T, down.T


def step_at(grey: F64, edges: tuple[I64, I64], shift_px: int) -> float:
    """Return the median change of an image ``(H, W)`` over three pixels across lines that lie so far
    beside the edges.
    """
    steps = []
    for image, (row, column) in ((grey, edges[0]), (grey.T, edges[1][::-1])):
        place = column + shift_px
        inside = (place > 6) & (place < image.shape[1] - 7)
        row, place = row[inside], place[inside]
        steps.append(np.abs(image[row, place + 2] - image[row, place - 1]))
    return float(np.median(np.concatenate(steps))) + LEAST_STEP


def ratio_of(rgb: U8, edges: tuple[I64, I64]) -> float:
    """Return the change across the edges over that beside them."""
    grey = rgb.astype(np.float64).mean(axis=-1)
    return step_at(grey, edges, 0) / float(np.median([step_at(grey, edges, k) for k in BESIDE_PX]))


def ratios(images: Path | None) -> list[tuple[float, float]]:
    """Return the ratios of every image in one pass and by pinholes; write the images if asked to."""
    out = []
    for street in range(STREETS):
        for yaw_deg in YAWS_DEG:
            keys = {**CAMERAS["fisheye, 190 degrees"], "yaw_deg": yaw_deg}
            scenario = seen_through(keys, f"street{street}")
            cover = LensCover(scenario.cameras)
            edges = edges_of(scenario.cameras[0])
            one_pass = make_renderer("clean", scenario)
            pinholes = LensRenderer(make_renderer("clean", cover.drawn(scenario)), cover)
            for t_us in TIMES_US:
                start_us = int(scenario.ego_log.t_us[0])
                (request,) = recorded_requests(scenario, start_us + t_us)
                frames = [renderer.render(request).rgb for renderer in (one_pass, pinholes)]
                out.append((ratio_of(frames[0], edges), ratio_of(frames[1], edges)))
                if images is not None:
                    name = f"street{street}-{yaw_deg}-{t_us}.png"
                    cv2.imwrite(str(images / name), np.hstack(frames)[..., ::-1])
            clear_cache()
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--images", type=Path)
    folder = parser.parse_args().images
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    measured = np.array(ratios(folder))
    rows = [
        [name, f"{column.mean():.2f}", f"{column.max():.2f}"]
        for name, column in zip(("in one pass", "by pinholes"), measured.T, strict=True)
    ]
    print(table(HEAD, rows))
