"""Fit scenarios with several recipes and print docs/experiments/reconstruction.md's table; draw its
picture.

python docs/scripts/reconstruction.py [--recipes NAME...] [--picture FILE] SCENARIO...
python docs/scripts/reconstruction.py            without a scenario: time of the similarity and its gradient, and their error
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.gaussians.fit import (
    SplatRecipe,
    Start,
    held_out,
    logged_views,
    start_from_depth,
)
from alpasim_plugin.gaussians.fit.loop import fit
from alpasim_plugin.gaussians.fit.quality import Comparison, SsimTarget, compare, summary
from alpasim_plugin.renderers.gaussian import scene_of
from scenarios.load import load_scenario

FULL = SplatRecipe.full()
PUBLISHED_RATES = {
    "lr_means": 1.6e-4,
    "lr_means_end": 1.6e-6,
    "lr_scales": 5e-3,
    "lr_quaternions": 1e-3,
    "lr_colour": 2.5e-3,
}
RECIPES = {
    "500": replace(FULL, steps=500),
    "500-published": replace(FULL, steps=500, start_size=1.0, **PUBLISHED_RATES),
    "500-reset": replace(FULL, steps=500, reset_every=0.3),
    "full": FULL,
    "under-trained": replace(SplatRecipe.under_trained(), hold_out_every=8),
}
PUBLISHED_OPACITY = 0.1
ASIDE_M = (0.0, 0.5, 1.0, 2.0)


def begin(scenario: Scenario, recipe: SplatRecipe, views: list, name: str) -> Start:
    """Return the start of a recipe; the published one is fainter too."""
    boxes = {actor.actor_id: actor.box for actor in scenario.actors}
    start = start_from_depth(
        views,
        boxes,
        recipe.points,
        scenario.scene_id,
        recipe.seed,
        recipe.actor_points,
        recipe.start_size,
    )
    if not name.endswith("published"):
        return start
    faint = [
        replace(c, opacities=np.full(len(c), PUBLISHED_OPACITY))
        for c in (start.background, *start.actors.values())
    ]
    return Start(faint[0], dict(zip(start.actors, faint[1:], strict=True)))


def strip(rows: list[Comparison]) -> np.ndarray:
    """Return truth above, model below, of three moments."""
    chosen = [rows[i] for i in (1, len(rows) // 2, len(rows) - 2)]
    return np.concatenate([np.concatenate([row.truth, row.shown]) for row in chosen], axis=1)


def similarity() -> None:
    """Print milliseconds, median of 20, of SSIM and its gradient at 256x144 on one thread."""
    rng = stream("docs", 0, "similarity")
    truth = torch.as_tensor(
        cv2.GaussianBlur(rng.random((144, 256, 3), dtype=np.float32), (0, 0), 1.5)
    )
    image = (
        truth + 0.05 * torch.as_tensor(rng.standard_normal((144, 256, 3), dtype=np.float32))
    ).requires_grad_()
    target, spent = SsimTarget(truth), []
    for _ in range(20):
        image.grad, began = None, time.process_time()
        target.ssim(image).backward()
        spent.append(time.process_time() - began)
    print(f"{1e3 * np.median(spent):.1f} ms")


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("scenarios", nargs="*")
    parser.add_argument("--recipes", nargs="+", default=["500"], choices=sorted(RECIPES))
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if not options.scenarios:
        similarity()
        return
    print(
        f"| scenario | recipe | Gaussians | processor s | held out, dB | SSIM | {' | '.join(f'{a:g} m' for a in ASIDE_M[1:])} |"
    )
    for name in options.scenarios:
        scenario = load_scenario(name)
        scene = scene_of(scenario)
        beside = {a: logged_views(scenario, scene, 9, 256, aside_m=a, threads=1) for a in ASIDE_M}
        for label in options.recipes:
            recipe = RECIPES[label]
            train, kept = held_out(
                logged_views(scenario, scene, recipe.views, recipe.width, threads=1),
                recipe.hold_out_every,
            )
            began = time.process_time()
            model = fit(
                train,
                begin(scenario, recipe, train, label),
                recipe,
                scene_id=scenario.scene_id,
                threads=1,
            )
            spent, graph = time.process_time() - began, model.graph()
            on = summary(compare(graph, kept, 1))
            rows = {a: compare(graph, views, 1) for a, views in beside.items()}
            off = " | ".join(f"{summary(rows[a])['psnr_db']:.1f}" for a in ASIDE_M[1:])
            print(
                f"| {name} | {label} | {len(model)} | {spent:.0f} | {on['psnr_db']:.1f} | {on['ssim']:.3f} | {off} |",
                flush=True,
            )
            if options.picture is not None:
                image = np.concatenate([strip(rows[0.0]), strip(rows[2.0])])[..., ::-1]
                cv2.imwrite(
                    str(options.picture.with_stem(f"{options.picture.stem}-{label}")),
                    image,
                    [cv2.IMWRITE_JPEG_QUALITY, 85],
                )


if __name__ == "__main__":
    main()
