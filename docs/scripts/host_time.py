"""Time the host's own work on an instant of N cameras, without a card:

    python docs/scripts/host_time.py N

What serves a card runs on tensors of the CPU of 32x18 pixels, so that little but Python and torch's
dispatch is left; Triton's kernels and the fixer's graph compute nothing. Left out are the driver's
launches, some 5 us each, and recorded frames that are read for the first time. It prints processor
time of one thread, the least of 90 instants, and how many kernels torch would launch.
"""

import sys
import time
from dataclasses import replace
from importlib import import_module

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.types import RenderRequest
from alpasim_plugin.fixers import loop, pixel_fixer
from alpasim_plugin.fixers.references import ReferenceSession
from alpasim_plugin.fixers.semantic_map import on_device, tile_kernel
from alpasim_plugin.gaussians.raster import rasterize_triton, triton_kernels
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.runs.cell import make_renderer
from scenarios.load import load_scenario
from tests.pretended_device import VIEWS

SMALLER = 8
WARM_UP, INSTANTS, STEP_US = 8, 90, 60_000
CHOOSE = ("fixers.pixel_network", "fixers.semantic_map.draw", "gaussians.scene.scene_graph")
CHOOSE = (*CHOOSE, "gaussians.raster.rasterize_triton")


class Idle:
    """A kernel that does nothing."""

    def __getitem__(self, grid):
        return lambda *args, **constants: None


class Kernels:
    """The module of kernels, idle."""

    def __getattr__(self, name):
        value = getattr(triton_kernels, name)
        return Idle() if hasattr(value, "__getitem__") else value


class Graph:
    """A captured function: copies in, copies out."""

    def __init__(self, function, sizes, device):
        self.given = {name: torch.zeros(shape, dtype=dtype) for name, shape, dtype in sizes}
        self.made = function(**self.given)

    def __call__(self, tensors):
        """Return copies of the results."""
        for name, part in tensors.items():
            self.given[name].copy_(part)
        return [part.clone() for part in self.made]


class Launches(TorchDispatchMode):
    """Counts kernels."""

    count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += func.overloadpacket.__name__ not in VIEWS
        return func(*args, **(kwargs or {}))


reading = []
read_s = []
read = ReferenceSession._recorded_images


def timed_read(session, chosen):
    """Read recorded frames as the host does."""
    reading.append(True)
    began = time.thread_time()
    try:
        return read(session, chosen)
    finally:
        reading.pop()
        read_s.append(time.thread_time() - began)


def empty(compositor, shape, dtype):
    """Return what idle kernels write: no pairs, grey."""
    return torch.full(shape, 0.5 if dtype == torch.float32 else 0, dtype=dtype)


torch.set_num_threads(1)
scenario = load_scenario("smoke/curve")
camera = scenario.cameras[0]
K = camera.K.copy()
K[:2] /= SMALLER
camera = replace(camera, width=camera.width // SMALLER, height=camera.height // SMALLER, K=K)
scenario = replace(scenario, cameras=(camera,))
make_renderer("3dgs", scenario, 0, "cpu")  # fits the scene, as the host does

rasterize_triton.FIRST_CAPACITY = 64
rasterize_triton.triton_kernels = Kernels
rasterize_triton.TileCompositor._empty = empty
tile_kernel.draw_tiles = Idle()
pixel_fixer.CapturedFunction = Graph
ReferenceSession._recorded_images = timed_read
loop.time = type("Clock", (), {"perf_counter": time.thread_time})
whole = on_device._uploaded
on_device._uploaded = lambda *args: [part[:4] for part in whole(*args)]  # a map of four lines
for module in CHOOSE:
    path = f"alpasim_plugin.{module}"
    import_module(path).implementation = lambda place, host, card: host if reading else card

cameras = [replace(camera, name=f"camera {i}") for i in range(int(sys.argv[1]))]
renderer = make_renderer("onefixer", scenario, 0, "cpu")
least = {}
for i in range(WARM_UP + INSTANTS):
    t_us = int(scenario.ego_log.t_us[0]) + STEP_US * i
    pose = interpolate(scenario.ego_log, t_us) @ camera.T_rig_camera
    actors = log_actors(scenario, t_us)
    asked = [RenderRequest(t_us, one, np.stack([pose, pose]), actors) for one in cameras]
    read_s.clear()
    if i == WARM_UP - 1:
        with Launches() as launches:
            renderer.render_batch(asked)
        continue
    began = time.thread_time()
    for frame in renderer.render_batch(asked):
        assert frame.rgb is not None
    spent = {"all": 1e3 * (time.thread_time() - began - sum(read_s)), **renderer.stage_ms}
    if i >= WARM_UP:
        least = {name: min(ms, least.get(name, ms)) for name, ms in spent.items()}
print(f"{len(cameras)} cameras: {launches.count} kernels; ms an instant:", end=" ")
print({name: round(ms, 1) for name, ms in least.items()})
