"""Recipes of the degradations that are fitted."""

from __future__ import annotations

from dataclasses import dataclass

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Degradation, Scenario
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe

# By second of the log and camera, so that a longer drive is fitted no worse.
POINTS_PER_S, FULL_STEPS_PER_S = 2_400, 50.0
FEWEST_VIEWS, MOST_VIEWS, MOST_POINTS, MOST_STEPS = 12, 180, 72_000, 1500


@dataclass(frozen=True)
class ReconstructionRecipe:
    """How a reconstruction is made.

    Attributes:
        splat: How Gaussians are fitted.
        aside_m: Where the views lie that they are fitted to: to the left of the logged path.
        fit_actors: Fit actors as rigid nodes; otherwise all are spliced in from the scene as built.
        depth_every: Every such view gives points to start from.
        range_error: Spread of these points' distance from their view, as a share of it.
        size: Of the Gaussians at the start, in distances to their neighbours: below one, the ground shows through until they have grown.
        opacity: Of the Gaussians at the start.
        pose_error_m: Spread of the views' believed places, metres; their directions err in proportion.
    """

    splat: SplatRecipe
    aside_m: float
    fit_actors: bool
    depth_every: int = 6
    range_error: float = 0.1
    size: float = 0.6
    opacity: float = 0.2
    pose_error_m: float = 0.0


def recipe_of(scenario: Scenario) -> ReconstructionRecipe:
    """Return the recipe of a scenario's degradation, which is fitted to what its cameras saw along the log.

    Raises:
        InputError: The degradation is not one that fits a model.
    """
    t_us = scenario.ego_log.t_us
    return recipe_for(scenario.degradation, (t_us[-1] - t_us[0]) * 1e-6 * max(1, len(scenario.cameras)))


def recipe_for(amount: Degradation, watched_s: float) -> ReconstructionRecipe:
    """Return the recipe of a degradation of what a camera watched for so many seconds.

    Few points, small views, no densification: a model that some seconds of one core can fit. Rates are higher than those of a whole fit,
    as a schedule of hundreds of steps needs.

    Raises:
        InputError: The degradation is not one that fits a model.
    """
    if amount.kind not in ("reconstruction", "cycle"):
        raise InputError("fitting a reconstruction", f"degradation kind {amount.kind!r}", "nothing to fit", "say reconstruction or cycle")
    points = min(MOST_POINTS, max(POINTS_PER_S, round(POINTS_PER_S * watched_s)))
    splat = SplatRecipe(
        steps=max(1, round(amount.share * min(MOST_STEPS, FULL_STEPS_PER_S * watched_s))),
        views=min(MOST_VIEWS, max(FEWEST_VIEWS, round(amount.views_per_s * watched_s))),
        width=160, points=points, cap=points, hold_out_every=0, sh_degree=1, lr_means=4e-4, lr_means_end=4e-5, lr_scales=1e-2,
        lr_quaternions=2e-3, lr_opacities=0.05, lr_colour=5e-3, densify_every=0,
    )  # fmt: skip
    on_path = amount.kind == "reconstruction"
    aside_m = 0.0 if on_path else amount.shift_m
    return ReconstructionRecipe(splat, aside_m, on_path, range_error=amount.depth_error, pose_error_m=amount.pose_error_m)
