"""Fit a street to photographs with distortion twice, with as many updates: whole, through their lens, and
freed of their distortion first. Both models are compared with photographs that neither saw, in the lens's
own image: in all of it, where the image without distortion reaches, and beyond.

Usage: python docs/scripts/lens_fits.py [--steps N] [--count N] [--width PIXELS] [--images FOLDER]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from lens_times import STREET
from pages import table

from alpasim_plugin import load_scenario
from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.types import U8, Bool, RenderRequest
from alpasim_plugin.gaussians.fit.drive import fit_drive
from alpasim_plugin.gaussians.fit.lens import Lens, gain_near, through_lens, without_distortion
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.runs.renderer import make_renderer

CAMERAS = {
    "OpenCV, k1 = -0.3": {
        "lens": "opencv", "hfov_deg": 100, "coefficients": [-0.3, 0.08, 0, 0],
    },
    "fisheye, 150 degrees": {"lens": "fisheye", "hfov_deg": 150},
}  # fmt: skip
EVERY = 8  # photographs, of which one is held out
WAY_S = 6.0
HEAD = ["lens", "fitted", "all, dB", "inside, dB", "beyond, dB", "beyond, share", "CPU, s"]


def photographs(name: str, count: int, width: int) -> list[PosedView]:
    """Return what a camera sees along the street without road users, through its lens."""
    camera = {"name": "lens", "width": width, "height": width * 5 // 8, **CAMERAS[name]}
    scene = {
        "version": 1,
        "extends": [str(STREET)],
        "scene_id": "lens-fits",  # of which the street's houses depend
        "cameras": [camera],
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lens-fits.yaml"
        path.write_text(yaml.safe_dump(scene), encoding="utf-8")
        scenario = load_scenario(path)
    renderer = make_renderer("clean", scenario)
    spec = scenario.cameras[0]
    begin = int(scenario.ego_log.t_us[0])
    views = []
    for i, t_us in enumerate(np.linspace(begin, begin + 1e6 * WAY_S, count).astype(np.int64)):
        T = interpolate(scenario.ego_log, int(t_us)) @ spec.T_rig_camera
        frame = renderer.render(RenderRequest(int(t_us), spec, np.stack([T] * 2), {}))
        through = Lens.of(spec).camera(name, T)
        mask = None if through.visible.all() else through.visible
        views.append(PosedView(through, frame.rgb, f"lens-{i:06d}", mask=mask, t_us=int(t_us)))
    return views


def rendered(views: Sequence[PosedView], held: Sequence[PosedView], steps: int) -> list[U8]:
    """Return what a model that is fitted to views shows where other photographs were taken."""
    recipe = replace(SplatRecipe.street(), steps=steps)
    done = fit_drive(views, None, recipe=recipe, threads=1, scene_id="lens-fits")
    graph = done.model.graph()
    centres = np.array([view.camera.centre_world for view in views])
    gains = np.array([done.exposures[view.name] for view in views])
    images = []
    for view in held:
        gain = gain_near("lens", view.camera.centre_world, ["lens"] * len(views), centres, gains)
        images.append(graph.render(view.camera, {}).exposed(gain).to_uint8())
    return images


def row_of(
    name: str, way: str, views: Sequence[PosedView], steps: int, images: Path | None
) -> list[str]:
    """Return the row of a lens and a way to fit to its photographs."""
    held = views[EVERY // 2 :: EVERY]
    fitted = [view for view in views if view not in held]
    if way == "without distortion":
        fitted = [without_distortion(view) for view in fitted]
    began = time.process_time()
    renders = rendered(fitted, held, steps)
    seconds = time.process_time() - began
    camera = held[0].camera
    assert isinstance(camera, LensCamera)
    ones = np.ones((camera.height, camera.width), dtype=np.float32)
    inside = through_lens(camera, without_distortion(held[0]).pinhole, ones) > 0
    visible = camera.visible
    parts = visible, inside & visible, visible & ~inside
    numbers = [f"{decibels(renders, held, part):.2f}" for part in parts]
    if images is not None:
        pair = np.concatenate([held[1].rgb, renders[1]], axis=0)
        cv2.imwrite(str(images / f"{name[:7]}-{way}.png"), pair[..., ::-1])
    share = f"{parts[2].sum() / visible.sum():.2f}"
    return [name, way, *numbers, share, f"{seconds:.0f}"]


def decibels(images: Sequence[U8], views: Sequence[PosedView], part: Bool) -> float:
    """Return the mean PSNR of images over a part of their pixels."""
    pairs = zip(images, views, strict=True)
    return float(np.mean([psnr_db(image[part], view.rgb[part]) for image, view in pairs]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=1300)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--images", type=Path)
    options = parser.parse_args()
    rows = []
    for lens_name in CAMERAS:
        taken = photographs(lens_name, options.count, options.width)
        for chosen in ("through the lens", "without distortion"):
            print(f"{lens_name}, {chosen}", file=sys.stderr)
            rows.append(row_of(lens_name, chosen, taken, options.steps, options.images))
            print(rows[-1], file=sys.stderr)
    print(table(HEAD, rows))
