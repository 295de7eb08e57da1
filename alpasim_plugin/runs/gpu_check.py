"""Check a card against the CPU: agreement first, then rates.

Each section is a process of its own: after an error of CUDA nothing more runs in its process.
``python -m alpasim_plugin.runs.gpu_check SECTION DEVICE`` runs one and prints one line of JSON.
"""

from __future__ import annotations

import itertools
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from alpasim_plugin.cameras.lens import resized
from alpasim_plugin.cameras.shutter import rolling
from alpasim_plugin.core.devices import download, facts_of, require_device, upload
from alpasim_plugin.core.printing import say
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, Exposure, Frame, LensModel, RenderRequest, Scenario
from alpasim_plugin.fixers import make_fixer
from alpasim_plugin.fixers.semantic_map.draw import draw_exposed_maps
from alpasim_plugin.fixers.semantic_map.prepare import prepare_map
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.raster.rasterize_gradient import rasterize_gradient
from alpasim_plugin.gaussians.raster.rasterize_triton import (
    DrawnCloud,
    TileCompositor,
    UploadedClouds,
    compositor_of,
)
from alpasim_plugin.gaussians.raster.splats import Splats
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.gpu_work import COUNTED, H100, PEAKS, transparent_splats
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from policies.base import make_policy
from scenarios.load import load_scenario

SCENE = "smoke/curve"
MIDDLE = (960, 544)
LARGE = (1920, 1080)
SIZES = ((256, 144), MIDDLE, (1920, 1088))
SPLATS = 5_000  # of the image whose gradients are compared
MOVED_M = 0.3  # while a shutter is open: 10 m/s for 30 ms
REPEATS = 5
# Grey levels, or thousandths of the largest gradient, by which a card may differ from the CPU.
LEVELS = 2
ODD_SHARE = 1e-3  # of the numbers may differ by more: splats of nearly equal depth change places

Facts = dict[str, Any]
Call = Callable[[], Any]  # makes an array of the host


def check_gpu(device: str, budget_s: float) -> Iterator[tuple[str, Facts]]:
    """Run every section and yield its name and facts; ``ok`` is false where it failed.

    Args:
        device: The card, or ``cpu`` to try the check itself.
        budget_s: Seconds after which the section in progress is ended, and no other begun.
    """
    end = time.monotonic() + budget_s
    for name in SECTIONS:
        left_s = end - time.monotonic()
        facts = _child(name, device, left_s) if left_s > 0 else _failed("no time was left")
        yield name, facts if facts["ok"] else facts | {"do": AVOIDED_BY.get(name, ON_CPU)}


def _child(name: str, device: str, left_s: float) -> Facts:
    command = [sys.executable, "-m", "alpasim_plugin.runs.gpu_check", name, device]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=left_s)
    except subprocess.TimeoutExpired:
        return _failed(f"it did not end within {left_s:.0f} s")
    if done.returncode != 0:
        return _failed((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
    return json.loads(done.stdout.splitlines()[-1])


def _failed(why: str) -> Facts:
    return {"ok": False, "why": why}


def card(device: str) -> Facts:
    """Return what the card is, after one product of matrices on it."""
    name = require_device(device)
    ones = torch.ones(64, 64, device=name)
    ok = float((ones @ ones).sum()) == 64.0**3
    return {"ok": ok, "torch": torch.__version__, **facts_of(name)}


def rasteriser(device: str) -> Facts:
    """Compare frames of a built street with those of the CPU, and time them."""
    scenario = load_scenario(SCENE)
    renderers = {name: make_renderer("clean", scenario, 0, name) for name in (device, "cpu")}

    def renders(width: int, height: int, name: str) -> Call:
        request = frame_request(scenario, width, height)
        return lambda: renderers[name].render(request).rgb

    return compared(device, renders)


def lens(device: str) -> Facts:
    """Compare frames of a built street through a fisheye of 190 degrees with a rolling shutter with
    those of the CPU, and time them.
    """
    scenario = load_scenario(SCENE)
    renderers = {name: make_renderer("clean", scenario, 0, name) for name in (device, "cpu")}

    def renders(width: int, height: int, name: str) -> Call:
        request = lens_request(scenario, width, height)
        return lambda: renderers[name].render(request).rgb

    return compared(device, renders)


def semantic_map(device: str) -> Facts:
    """Compare maps of a street with those of the CPU, and time them."""
    scenario = load_scenario(SCENE)
    scene = prepare_map(scenario.lane_map)

    def draws(width: int, height: int, name: str) -> Call:
        request = frame_request(scenario, width, height)
        draw = partial(draw_exposed_maps, scene, [request], scenario.actors, device=name)
        return lambda: torch.as_tensor(draw()[0]).cpu().numpy()

    return compared(device, draws)


def fixer(device: str) -> Facts:
    """Compare frames of the fixer with those of the CPU, and time them."""
    return compared(device, partial(_streaming, "onefixer", ["front"]))


def block_fixer(device: str) -> Facts:
    """Compare blocks of the small generator with those of the CPU, and time them."""
    return compared(device, partial(_streaming, "onefixer-dit-tiny", ["front"]), SIZES[:1])


def gradient(device: str) -> Facts:
    """Compare the gradients of an image of splats of all shapes, also behind and beside the camera,
    with those of the CPU, in thousandths of the largest of their kind, and time them.
    """
    rng = stream("gpu-check", 0, "splats")
    cloud = GaussianCloud(
        rng.uniform([-9, -5, -2], [9, 5, 30], (SPLATS, 3)),
        rng.normal(size=(SPLATS, 4)),
        np.exp(rng.normal(-3, 1, (SPLATS, 3))),
        rng.random(SPLATS),
        rng.normal(0, 0.3, (SPLATS, 16, 3)),
    )

    def differentiates(width: int, height: int, name: str) -> Call:
        K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]])
        view = cloud, PinholeCamera(width, height, K, np.eye(4)), compositor_of(name)
        return lambda: np.concatenate(
            [1e3 * part / np.abs(part).max() for part in _gradients(*view)]
        )

    return compared(device, differentiates)


def rollout(device: str) -> Facts:
    """Drive a scene behind the fixer on the device, and time a frame of it."""
    scenario = load_scenario(SCENE)
    renderer = make_renderer("onefixer", scenario, 0, device)
    began = time.perf_counter()
    log = run_rollout(scenario, renderer, make_policy("lane-camera", scenario)).log()
    seconds = time.perf_counter() - began
    frames = len(log.images)
    return {"ok": frames > 0, "frames": frames, "ms_per_frame": round(1e3 * seconds / frames, 2)}


def raster_rate(device: str) -> Facts:
    """Time a frame of many splats beside what it costs at least."""

    def draws() -> Call:
        cloud, camera = transparent_splats(*LARGE)
        clouds, behind = (
            UploadedClouds([cloud], device),
            upload(np.zeros(3, dtype=np.float32), device),
        )
        return lambda: clouds.draw([(camera, [DrawnCloud(0)])], behind)[0].arrays

    return _rated(device, {"splats": draws})


def fixer_rate(device: str) -> Facts:
    """Time a frame of one and of six cameras beside what it costs at least."""

    def fixes(count: int) -> Call:
        return _streaming("onefixer", list(map(str, range(count))), *MIDDLE, device)

    return _rated(device, {f"cameras: {count}": partial(fixes, count) for count in (1, 6)})


SECTIONS: dict[str, Callable[[str], Facts]] = {
    "card": card,
    "rasteriser": rasteriser,
    "lens": lens,
    "semantic_map": semantic_map,
    "fixer": fixer,
    "block_fixer": block_fixer,
    "gradient": gradient,
    "rollout": rollout,
    "raster_rate": raster_rate,
    "fixer_rate": fixer_rate,
}
# What leaves out the part of a section that failed; where nothing does, the card is left out.
ON_CPU = "run with --device cpu"
AVOIDED_BY = {
    "lens": f"give the scenario pinhole cameras, without a lens or shutter_us; otherwise {ON_CPU}",
    "semantic_map": f"--set fixer.uses_map=false fixes without a map; otherwise {ON_CPU}",
    "fixer": f"--renderer 3dgs leaves the fixer out; otherwise {ON_CPU}",
    "block_fixer": f"--renderer onefixer fixes frame by frame; otherwise {ON_CPU}",
    "gradient": "run simrun import drive with --device cpu, and what fits behind 3dgs once as well",
    "fixer_rate": f"--renderer 3dgs leaves the fixer out; otherwise {ON_CPU}",
}


def _rated(device: str, calls: dict[str, Callable[[], Call]]) -> Facts:
    """Return what calls cost at least and, on a card, their times and shares of its peak."""
    name = facts_of(device).get("card")
    facts: Facts = {"ok": True}
    for call_name, make in calls.items():
        work = COUNTED[call_name]
        facts[call_name] = {**work._asdict(), "h100_least_ms": work.least_ms(H100)}
        if name is None:
            continue
        ms = median_ms(make())
        has_peak = name in PEAKS
        share = round(work.least_ms(name) / ms, 3) if has_peak else "not known for this card"
        facts[call_name] |= {"ms": ms, "roofline_share": share}
    return facts


def compared(
    device: str,
    make: Callable[[int, int, str], Call],
    sizes: Sequence[tuple[int, int]] | None = None,
) -> Facts:
    """Return by how many levels arrays of a device differ from the CPU's, and how long each takes.

    Args:
        device: The card.
        make: Returns what makes an array of a width and a height on a device.
        sizes: These widths and heights; None for all.
    """
    facts: Facts = {"ok": True}
    for width, height in sizes or SIZES:
        ours = make(width, height, device)
        theirs = make(width, height, "cpu")
        differs = np.abs(ours().astype(float) - theirs())
        odd_share = float((differs > LEVELS).mean())
        facts[f"{width}x{height}"] = {
            "levels": round(float(differs.max()), 3),
            "different": int((differs > 0).sum()),
            "odd_share": odd_share,
            "launches": _launches(ours),
            "ms": median_ms(ours),
            "cpu_ms": median_ms(theirs),
        }
        if odd_share > ODD_SHARE:
            facts |= {"ok": False, "why": f"it differs from the CPU by more than {LEVELS} levels"}
    return facts


def _launches(make: Call) -> int:
    """Return how many kernels and graphs a call launches on a card."""
    with torch.profiler.profile() as profile:
        make()
    return sum("Launch" in event.name for event in profile.events())


def median_ms(make: Call) -> float:
    """Return the median time of a call, which ends with an array on the host."""
    times_s = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        make()
        times_s.append(time.perf_counter() - began)
    return round(1e3 * statistics.median(times_s), 2)


def frame_request(scenario: Scenario, width: int, height: int) -> RenderRequest:
    """Return a frame of the recorded drive at another size."""
    t_us = int(scenario.ego_log.t_us[0]) + 1_000_000
    request = recorded_requests(scenario, t_us)[0]
    return replace(request, camera=resized(request.camera, width, height))


def lens_request(scenario: Scenario, width: int, height: int) -> RenderRequest:
    """Return the same frame through a fisheye of 190 degrees, whose rows are exposed while the camera
    moves by `MOVED_M`.
    """
    request = frame_request(scenario, width, height)
    most_rad = np.deg2rad(95.0)
    focal_px = width / (2 * most_rad)
    K = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    camera = replace(request.camera, K=K, lens=LensModel("fisheye", max_angle_rad=most_rad))
    end = request.T_world_camera[1]
    start = end.copy()
    start[:3, 3] -= MOVED_M * end[:3, 2]
    exposure = Exposure(rolling(width, height, "rows", backwards=False), dict(request.actors))
    return replace(request, camera=camera, T_world_camera=np.stack([start, end]), exposure=exposure)


def _gradients(
    cloud: GaussianCloud, camera: PinholeCamera, compositor: TileCompositor | None
) -> list[F32]:
    """Return the gradients of the sum of an image's squares by every parameter."""
    device = "cpu" if compositor is None else compositor.device
    splats = [upload(part.numpy(), device).requires_grad_() for part in Splats.from_cloud(cloud)]
    out = rasterize_gradient(Splats(*splats), camera, compositor=compositor)
    planes = torch.cat([out.rgb, out.alpha[..., None], out.depth[..., None]], dim=2)
    planes.square().sum().backward()  # type: ignore[no-untyped-call]
    leaves = [part.grad for part in splats if part.grad is not None]
    pairs, *gradients = download(out.pairs, *leaves)
    if compositor is None or compositor.had_room(compositor.capacity, int(pairs)):
        return [part.ravel() for part in gradients]
    return _gradients(cloud, camera, compositor)


def _streaming(
    fixer_name: str, cameras: Sequence[str], width: int, height: int, device: str
) -> Call:
    """Return a call that fixes the next frames of a drawn clip."""
    session = make_fixer(fixer_name, scene_id="gpu-check", device=device)
    rng = stream("gpu-check", 0, "clip")
    image = rng.integers(0, 255, (height, width, 4), dtype=np.uint8)
    rgb = image[..., :3].copy()
    opacity = rng.random((height, width)).astype(np.float32)
    times_us = iter(range(0, 10**9, 100_000))
    blocks = itertools.count()

    def step() -> Any:
        times = [next(times_us) for _ in range(session.blocks.frames(next(blocks)))]
        frames = [
            Frame(t_us, camera, rgb, opacity, references=(image,))
            for camera in cameras
            for t_us in times
        ]
        return session.step(frames, [rgb] * len(frames))[-1].rgb

    return step


if __name__ == "__main__":
    say(json.dumps(SECTIONS[sys.argv[1]](sys.argv[2])))
