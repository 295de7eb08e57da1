"""Check a card against the CPU: agreement first, then rates.

Each section is a process of its own: after an error of CUDA nothing more runs in its process.
``python -m alpasim_plugin.runs.gpu_check SECTION DEVICE`` runs one and prints one line of JSON.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.printing import say
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import Frame, RenderRequest, Scenario
from alpasim_plugin.fixers import make_fixer
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.runs.cell import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from policies.base import make_policy
from scenarios.load import load_scenario

SCENE = "smoke/curve"
SIZES = ((256, 144), (960, 544), (1920, 1088))
REPEATS = 5
LEVELS = 2  # grey levels by which a card may differ from the CPU
ODD_SHARE = 1e-3  # of the pixels may differ by more: splats of nearly equal depth change places

Facts = dict[str, Any]


def check_gpu(device: str, budget_s: float) -> Iterator[tuple[str, Facts]]:
    """Run every section and yield its name and facts; ``ok`` is false where it failed.

    Args:
        device: The card, or ``cpu`` to try the check itself.
        budget_s: Seconds after which the section in progress is ended, and no other begun.
    """
    end = time.monotonic() + budget_s
    for name in SECTIONS:
        left_s = end - time.monotonic()
        yield name, _child(name, device, left_s) if left_s > 0 else _failed("no time was left")


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
    import torch

    name = require_device(device)
    ones = torch.ones(64, 64, device=name)
    facts: Facts = {"ok": float((ones @ ones).sum()) == 64.0**3, "torch": torch.__version__}
    if name != "cpu":
        properties = torch.cuda.get_device_properties(name)
        facts["card"] = properties.name
        facts["memory_gib"] = round(properties.total_memory / 2**30, 1)
        facts["compute_capability"] = f"{properties.major}.{properties.minor}"
        facts["cuda"] = torch.version.cuda
    return facts


def rasteriser(device: str) -> Facts:
    """Compare frames of a built street with those of the CPU, and time them."""
    scenario = load_scenario(SCENE)
    ours, theirs = (make_renderer("clean", scenario, 0, name) for name in (device, "cpu"))
    facts: Facts = {"ok": True}
    for width, height in SIZES:
        request = frame_request(scenario, width, height)
        facts[f"{width}x{height}"] = compared(
            partial(_rendered, ours, request), partial(_rendered, theirs, request)
        )
    return _checked(facts)


def fixer(device: str) -> Facts:
    """Compare frames of the fixer with those of the CPU, and time them."""
    facts: Facts = {"ok": True}
    for width, height in SIZES:
        ours, theirs = _streaming(device, width, height), _streaming("cpu", width, height)
        facts[f"{width}x{height}"] = compared(ours, theirs)
    return _checked(facts)


def rollout(device: str) -> Facts:
    """Drive a scene behind the fixer on the device, and time a frame of it."""
    scenario = load_scenario(SCENE)
    renderer = make_renderer("onefixer", scenario, 0, device)
    began = time.perf_counter()
    log = run_rollout(scenario, renderer, make_policy("lane-camera", scenario)).log()
    seconds = time.perf_counter() - began
    frames = len(log.images)
    return {"ok": frames > 0, "frames": frames, "ms_per_frame": round(1e3 * seconds / frames, 2)}


SECTIONS: dict[str, Callable[[str], Facts]] = {
    "card": card,
    "rasteriser": rasteriser,
    "fixer": fixer,
    "rollout": rollout,
}


def compared(ours: Callable[[], Any], theirs: Callable[[], Any]) -> Facts:
    """Return by how many grey levels two images differ, and how long each takes."""
    differs = np.abs(ours().astype(int) - theirs())
    return {
        "levels": int(differs.max()),
        "odd_share": float((differs > LEVELS).mean()),
        "ms": _median_ms(ours),
        "cpu_ms": _median_ms(theirs),
    }


def _checked(facts: Facts) -> Facts:
    sizes = [value for value in facts.values() if isinstance(value, dict)]
    facts["ok"] = all(size["odd_share"] <= ODD_SHARE for size in sizes)
    if not facts["ok"]:
        facts["why"] = f"images differ from the CPU by more than {LEVELS} grey levels"
    return facts


def _median_ms(make: Callable[[], Any]) -> float:
    """Return the median time of a call, which ends with an array on the host."""
    times_s = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        make()
        times_s.append(time.perf_counter() - began)
    return round(1e3 * statistics.median(times_s), 2)


def frame_request(scenario: Scenario, width: int, height: int) -> RenderRequest:
    """Return a frame of the recorded drive at another size."""
    camera = scenario.cameras[0]
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    t_us = int(scenario.ego_log.t_us[0]) + 1_000_000
    pose = interpolate(scenario.ego_log, t_us) @ camera.T_rig_camera
    larger = replace(camera, width=width, height=height, K=K)
    return RenderRequest(t_us, larger, np.stack([pose, pose]), log_actors(scenario, t_us))


def _rendered(renderer: Renderer, request: RenderRequest) -> Any:
    return renderer.render(request).rgb


def _streaming(device: str, width: int, height: int) -> Callable[[], Any]:
    """Return a call that fixes the next frame of a drawn clip."""
    session = make_fixer("onefixer", scene_id="gpu-check", device=device)
    rng = stream("gpu-check", 0, "clip")
    image = rng.integers(0, 255, (height, width, 4), dtype=np.uint8)
    opacity = rng.random((height, width)).astype(np.float32)
    times_us = iter(range(0, 10**9, 100_000))

    def step() -> Any:
        rgb = image[..., :3].copy()
        frame = Frame(next(times_us), "front", rgb, opacity, references=(image,))
        return session.step([frame], [rgb])[0].rgb

    return step


if __name__ == "__main__":
    say(json.dumps(SECTIONS[sys.argv[1]](sys.argv[2])))
