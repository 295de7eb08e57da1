"""Fit the model behind the renderer ``3dgs`` to what the scenario's cameras saw along the log, or beside it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Box, Scenario
from alpasim_plugin.gaussians.fit.loop import fit
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.start import Start
from alpasim_plugin.gaussians.fit.views import PosedView, logged_views
from alpasim_plugin.gaussians.scene.sky_mask import SkyView
from alpasim_plugin.renderers.gaussian import scene_of
from alpasim_plugin.renderers.reconstruction_files import write_model
from alpasim_plugin.renderers.reconstruction_recipe import ReconstructionRecipe
from alpasim_plugin.renderers.reconstruction_start import misplaced, rough_start

FEWEST_GAUSSIANS = 40  # an actor with fewer was hardly seen: the scene's own is spliced in


def build(scenario: Scenario, recipe: ReconstructionRecipe, threads: int | None, folder: Path) -> None:
    """Fit a reconstruction and write it into an empty folder.

    Points inside the boxes of actors never start a background Gaussian. Without ``fit_actors`` nothing explains the actors' pixels, as in
    the second fit of the cycle render (paper, App. A, stage 2), where they are smeared over the background or lost.

    Raises:
        InputError: The scenario has no camera, or its views show nothing.
    """
    if not scenario.cameras:
        raise InputError("fitting a reconstruction", f"scene {scenario.scene_id!r}", "no camera", "give the scenario a camera")
    splat = recipe.splat
    views = logged_views(scenario, scene_of(scenario), splat.views, splat.width, aside_m=recipe.aside_m, threads=threads)
    model, sky_views = reconstruct(views, {a.actor_id: a.box for a in scenario.actors}, recipe, scenario.scene_id, threads)
    facts = {"scene_id": scenario.scene_id, "recipe": asdict(recipe), "views": len(views)}
    write_model(folder, model, sky_views, facts)


def reconstruct(
    views: Sequence[PosedView], boxes: Mapping[str, Box], recipe: ReconstructionRecipe, scene_id: str, threads: int | None
) -> tuple[Reconstruction, list[SkyView]]:
    """Fit a model to views as a recipe says: from misplaced poses and rough depth.

    Args:
        views: In order of time, with depth.
        boxes: Size of each actor that a view may show.
        recipe: Amounts and schedule.
        scene_id: Key of the random streams, with the recipe's seed.
        threads: Of the rasteriser.

    Returns:
        The model, and where its views showed sky.

    Raises:
        InputError: The views show nothing.
    """
    splat = recipe.splat
    believed = misplaced(views, recipe.pose_error_m, scene_id, splat.seed)
    start = rough_start(believed, boxes, recipe, scene_id)
    start = Start(start.background, start.actors if recipe.fit_actors else {})
    with _one_torch_thread():
        fitted = fit(believed, start, splat, scene_id=scene_id, threads=threads)
    actors = {name: cloud for name, cloud in fitted.actors.items() if len(cloud) >= FEWEST_GAUSSIANS}
    sky_views = [SkyView(v.camera, v.sky.astype(np.float32)) for v in believed if v.sky is not None]
    return Reconstruction(fitted.background, actors, fitted.sky), sky_views


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Let torch sum in one order, so that the model is the same on any number of cores; its share of a fit is too small to divide."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
