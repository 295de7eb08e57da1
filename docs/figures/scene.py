"""Measure the scenes and their surrogate degradation: PSNR by lateral offset, time a frame,
Gaussians; draw docs/img/degradation.png.

python docs/figures/scene.py [--speed] [SCENARIO ...]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np

from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import F64, RenderRequest, Scenario
from alpasim_plugin.renderers import make_renderer
from scenarios.load import load_scenario

SURROGATE = ("degradation.kind=surrogate",)
OFFSETS_M = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
SHOWN_M = (0.0, 1.0, 3.0)
SHIPPED = (
    "smoke/straight",
    "smoke/curve",
    "urban/residential_parked",
    "highway/free_flow",
    "real/us101",
)
OUT = Path(__file__).resolve().parents[1] / "img" / "degradation.png"


def main() -> None:
    """Run the requested measurements."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("scenarios", nargs="*", default=list(SHIPPED))
    parser.add_argument(
        "--speed", action="store_true", help="measure time per frame instead of drawing the figure"
    )
    arguments = parser.parse_args()
    if arguments.speed:
        print(
            "scenario | size | renderer | visible | 2 threads, ms: median, p95 | 1 thread, ms: median, p95"
        )
        for name in arguments.scenarios:
            speed(name)
    else:
        figure(arguments.scenarios)


def requests(
    scenario: Scenario, size: tuple[int, int], lateral_m: float, n: int
) -> list[RenderRequest]:
    """Return n requests along the log, moved to the left by ``lateral_m``."""
    camera = scenario.cameras[0]
    K = camera.K.copy()
    K[0] *= size[0] / camera.width
    K[1] *= size[1] / camera.height
    camera = replace(camera, width=size[0], height=size[1], K=K)
    out = []
    for t_us in np.linspace(scenario.start_us, scenario.end_us, n + 2)[1:-1].astype(np.int64):
        pose: F64 = interpolate(scenario.ego_log, t_us)
        pose[:3, 3] += lateral_m * pose[:3, 1]
        T = pose @ camera.T_rig_camera
        actors = {
            a.actor_id: interpolate(a.track, t_us)
            for a in scenario.actors
            if a.track.t_us[0] <= t_us <= a.track.t_us[-1]
        }
        out.append(RenderRequest(int(t_us), camera, np.stack([T, T]), actors))
    return out


def degradation_curve(scenario: Scenario, clean: Renderer, bad: Renderer, n: int = 8) -> F64:
    """Return the mean PSNR at each offset, both sides of the path."""
    means = []
    for offset in OFFSETS_M:
        views = [
            r for sign in (1.0, -1.0) for r in requests(scenario, (256, 144), sign * offset, n)
        ]
        means.append(np.mean([psnr_db(clean.render(r).rgb, bad.render(r).rgb) for r in views]))
    return np.array(means)


def figure(names: list[str]) -> None:
    """Draw clean and degraded views at growing offsets, and the curves of all scenarios."""
    curves = {}
    for name in names:
        scenario = load_scenario(name, overrides=SURROGATE)
        clean, bad = make_renderer("clean", scenario), make_renderer("3dgs", scenario)
        curves[Path(name).stem if "/" not in name or Path(name).exists() else name] = (
            degradation_curve(scenario, clean, bad)
        )
        print(
            name,
            " ".join(
                f"{m:g} m: {v:.1f} dB"
                for m, v in zip(OFFSETS_M, curves[next(reversed(curves))], strict=True)
            ),
        )
    scenario = load_scenario(names[0], overrides=SURROGATE)
    clean, bad = make_renderer("clean", scenario), make_renderer("3dgs", scenario)
    views = [requests(scenario, (480, 272), m, 6)[1] for m in SHOWN_M]
    columns = [
        np.concatenate([renderer.render(r).rgb for r in views], axis=1) for renderer in (clean, bad)
    ]
    fig = plt.figure(figsize=(11, 7.2))
    grid = fig.add_gridspec(2, 1, height_ratios=(1.18, 1.0), hspace=0.16)
    top = fig.add_subplot(grid[0])
    top.imshow(np.concatenate(columns, axis=0))
    top.set_xticks(
        [480 * (i + 0.5) for i in range(len(SHOWN_M))],
        [f"{m:g} m beside the logged path" for m in SHOWN_M],
    )
    top.set_yticks([136, 408], ["clean", "3dgs"])
    top.tick_params(length=0)
    top.xaxis.tick_top()
    axes = fig.add_subplot(grid[1])
    for name, curve in curves.items():
        axes.plot(OFFSETS_M, curve, "o-", label=name)
    axes.set_xlabel("lateral distance from the logged path, m")
    axes.set_ylabel("PSNR of 3dgs against clean, dB")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    OUT.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(OUT, dpi=110, bbox_inches="tight")
    print("wrote", OUT)


def speed(name: str, n: int = 24) -> None:
    """Print time per frame of both renderers, warm caches, frames along the whole log."""
    scenario = load_scenario(name, overrides=SURROGATE)
    for size in ((256, 144), (480, 272)):
        views = requests(scenario, size, 0.0, n)
        for kind in ("clean", "3dgs"):
            cells, visible = [], []
            for threads in (2, 1):
                renderer = make_renderer(kind, scenario, threads=threads)
                for r in views:
                    renderer.render(r)
                times = []
                for r in views:
                    start = time.perf_counter()
                    renderer.render(r)
                    times.append((time.perf_counter() - start) * 1e3)
                    visible.append(getattr(renderer, "stats", {}).get("visible", 0))
                cells.append(f"{np.median(times):.1f}, {np.percentile(times, 95):.1f}")
            print(
                f"{name} | {size[0]}x{size[1]} | {kind} | {min(visible)}..{max(visible)} | {' | '.join(cells)}",
                flush=True,
            )


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
