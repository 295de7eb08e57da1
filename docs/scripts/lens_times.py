"""Time a frame of ``clean`` through wide lenses: in one pass, by the pinholes that cover the lens, and
with a rolling shutter, in turn.

Usage: python docs/scripts/lens_times.py [--threads N] [--repeats N]. With one thread times are the
processor's, with more they are the clock's.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from pages import table

import scenarios
from alpasim_plugin import load_scenario
from alpasim_plugin.cameras.lens_cover import LensCover
from alpasim_plugin.cameras.shutter import rolling
from alpasim_plugin.core.types import Exposure, RenderRequest, Scenario
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.lenses import LensRenderer
from alpasim_plugin.runs.renderer import make_renderer

STREET = Path(scenarios.__file__).parent / "urban/one_way.yaml"
AT_US = 3_000_000
SHUTTER_US = 30_000
SPEED_MPS = 9.0
TURN_DPS = 30.0
CAMERAS = {
    "fisheye, 190 degrees": {
        "lens": "fisheye", "width": 960, "height": 720, "hfov_deg": 190, "max_angle_deg": 100,
        "x_m": 2.4, "y_m": 0.95, "z_m": 0.95, "yaw_deg": 90,
    },
    "f-theta, 150 degrees": {"lens": "ftheta", "width": 960, "height": 540, "hfov_deg": 150},
    "f-theta, 120 degrees": {"lens": "ftheta", "width": 1900, "height": 1080, "hfov_deg": 120},
}  # fmt: skip
HEAD = ["lens", "pixels", "one pass, ms", "pinholes, ms", "ratio", "rolling, ms", "ratio"]


def seen_through(camera: dict[str, object], street: str = "street0") -> Scenario:
    """Return a street with one camera; which street depends on the name of the scenario's folder."""
    scene = {"version": 1, "extends": [str(STREET)], "cameras": [{"name": "lens", **camera}]}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / street / "scene.yaml"
        path.parent.mkdir()
        path.write_text(yaml.safe_dump(scene), encoding="utf-8")
        return load_scenario(path)


def rolled(request: RenderRequest) -> RenderRequest:
    """Return a request with a rolling shutter of a car that drives and turns."""
    shutter_s = SHUTTER_US * 1e-6
    R_camera_rig = request.camera.T_rig_camera[:3, :3].T
    turn = R_camera_rig @ [0, 0, np.deg2rad(TURN_DPS) * shutter_s]
    shift = R_camera_rig @ [SPEED_MPS * shutter_s, 0, 0]
    poses = []
    for share in (-0.5, 0.5):
        moved = np.eye(4)
        moved[:3, :3] = cv2.Rodrigues(share * turn)[0]
        moved[:3, 3] = share * shift
        poses.append(request.T_world_camera[1] @ moved)
    camera = replace(request.camera, shutter_us=SHUTTER_US)
    exposure = Exposure(rolling(camera.width, camera.height, "rows", False), dict(request.actors))
    return replace(request, camera=camera, T_world_camera=np.stack(poses), exposure=exposure)


def medians_ms(
    draws: list[Callable[[], object]], repeats: int, clock: Callable[[], float]
) -> list[float]:
    """Return the median time of each of several ways to draw, which take turns."""
    for draw in draws:
        draw()
    times_ms: list[list[float]] = [[] for _ in draws]
    for _ in range(repeats):
        for draw, passed_ms in zip(draws, times_ms, strict=True):
            begin = clock()
            draw()
            passed_ms.append(1e3 * (clock() - begin))
    return [float(np.median(passed_ms)) for passed_ms in times_ms]


def row_of(name: str, threads: int, repeats: int) -> list[str]:
    """Return the row of a lens."""
    scenario = seen_through(CAMERAS[name])
    cover = LensCover(scenario.cameras)
    request = recorded_requests(scenario, int(scenario.ego_log.t_us[0]) + AT_US)[0]
    one_pass = make_renderer("clean", scenario, threads=threads)
    pinholes = LensRenderer(make_renderer("clean", cover.drawn(scenario), threads=threads), cover)
    with_shutter = rolled(request)
    one_ms, pinholes_ms, rolling_ms = medians_ms(
        [
            lambda: one_pass.render(request),
            lambda: pinholes.render(request),
            lambda: one_pass.render(with_shutter),
        ],
        repeats,
        time.process_time if threads == 1 else time.perf_counter,
    )
    ratios = [f"{one_ms / pinholes_ms:.2f}", f"{rolling_ms / one_ms:.2f}"]
    size = f"{request.camera.width}x{request.camera.height}"
    times = [f"{value:.0f}" for value in (one_ms, pinholes_ms, rolling_ms)]
    return [name, size, times[0], times[1], ratios[0], times[2], ratios[1]]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    print(table(HEAD, [row_of(name, options.threads, options.repeats) for name in CAMERAS]))
