"""Reconstruct a scenario from views of its own scene along its log."""

from __future__ import annotations

from pathlib import Path

from alpasim_plugin.gaussians.fit.loop import Report, fit
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.start import start_from_depth
from alpasim_plugin.gaussians.fit.views import held_out, logged_views
from alpasim_plugin.gaussians.scene_graph import SceneGraph
from alpasim_plugin.types import Scenario


def reconstruct(
    scenario: Scenario,
    scene: SceneGraph,
    recipe: SplatRecipe,
    *,
    aside_m: float = 0.0,
    folder: Path | None = None,
    report: Report | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> Reconstruction:
    """Render a scene along the scenario's log and fit Gaussians to what was seen: actors as rigid nodes on their tracks.

    Args:
        scenario: Log, cameras, tracks.
        scene: What is seen; of the cycle render's second model (paper, App. A) this is the first one, with ``aside_m=1``.
        recipe: See `SplatRecipe`; `SplatRecipe.under_trained` gives the paper's under-trained reconstruction in some ten seconds.
        aside_m: The views' distance to the left of the log.
        folder, report, device, threads: See `fit`.
    """
    views, _ = held_out(logged_views(scenario, scene, recipe.views, recipe.width, aside_m=aside_m, threads=threads), recipe.hold_out_every)
    boxes = {actor.actor_id: actor.box for actor in scenario.actors}
    start = start_from_depth(views, boxes, recipe.points, scenario.scene_id, recipe.seed, recipe.actor_points)
    return fit(views, start, recipe, scene_id=scenario.scene_id, folder=folder, report=report, device=device, threads=threads)
