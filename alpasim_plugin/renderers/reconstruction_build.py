"""Fit the model behind the renderer ``3dgs`` to what the scenario's cameras saw along the log, or
beside it.

The fit starts from poses that drift and from the depth of a few views, wrong by patches, as
matching images gives both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np

from alpasim_plugin.cameras.lens import lens_camera
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.stage import announce
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Box, Scenario
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.loop import fit
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.start import Start, start_from_depth
from alpasim_plugin.gaussians.fit.views import PosedView, logged_views
from alpasim_plugin.gaussians.scene.log_views import SkyView
from alpasim_plugin.renderers.gaussian import scene_of
from alpasim_plugin.renderers.reconstruction_key import ReconstructionRecipe, write_model
from alpasim_plugin.renderers.recorded import believed_pose

FEWEST_GAUSSIANS = 40  # an actor with fewer was hardly seen: the scene's own is spliced in


def build(
    scenario: Scenario,
    recipe: ReconstructionRecipe,
    threads: int | None,
    device: str,
    folder: Path,
) -> None:
    """Fit a reconstruction, from misplaced poses and rough depth, and write it into an empty folder.

    Points inside the boxes of actors never start a background Gaussian. Without ``fit_actors``
    nothing explains the actors' pixels, as in the second fit of the cycle render (paper, App. A,
    stage 2), where they are smeared over the background or lost.

    Raises:
        InputError: The scenario has no camera, or its views show nothing.
    """
    if not scenario.cameras:
        raise InputError(
            f"scene {scenario.scene_id!r}: no camera",
            "give the scenario a camera",
        )
    splat = recipe.splat
    views = logged_views(
        scenario,
        scene_of(scenario),
        splat.views,
        splat.width,
        lateral_m=recipe.lateral_offset_m,
        threads=threads,
    )
    scene_id = scenario.scene_id
    believed = misplaced(views, recipe.pose_error_m, scene_id, splat.seed)
    boxes = {actor.actor_id: actor.box for actor in scenario.actors}
    start = rough_start(believed, boxes, recipe, scene_id)
    start = Start(start.background, start.actors if recipe.fit_actors else {})
    fitted = fit(
        believed,
        start,
        splat,
        scene_id=scene_id,
        threads=threads,
        device=device,
        report=lambda step, _: announce(f"fitting {scene_id}: {step} of {splat.steps} updates"),
    )
    actors = {
        name: cloud for name, cloud in fitted.actors.items() if len(cloud) >= FEWEST_GAUSSIANS
    }
    sky_views = [
        SkyView(view.pinhole, view.sky.astype(np.float32), view.camera_name)
        for view in believed
        if view.sky is not None
    ]
    facts = {"scene_id": scene_id, "recipe": asdict(recipe), "views": len(views)}
    write_model(folder, Reconstruction(fitted.background, actors, fitted.sky), sky_views, facts)


PATCH_SHARE = 0.075  # of the image's width: neighbours within a patch are wrong together
# A depth is never wrong by more than these factors
LEAST = 0.5
MOST = 2.0


def misplaced(
    views: Sequence[PosedView], spread_m: float, scene_id: str, seed: int
) -> list[PosedView]:
    """Return the views with the poses that registration believes: moved and turned by smooth errors
    of normal spread.

    Args:
        views: With camera and time.
        spread_m: Along each axis of the camera; directions turn by `TURN_RAD_PER_M` of it about
            each axis. 0 changes nothing.
        scene_id, seed: Key of the random stream.
    """
    if spread_m == 0:
        return list(views)
    moved = []
    firsts: dict[tuple[str, int], F64] = {}
    for view in views:
        T = view.camera.T_camera_world
        first = firsts.setdefault((lens_camera(view.camera_name), view.t_us), T)
        key = scene_id, seed, spread_m, view.camera_name, view.t_us
        camera = replace(view.camera, T_camera_world=believed_pose(T, first, *key))
        moved.append(replace(view, camera=camera))
    return moved


def rough_start(
    views: Sequence[PosedView],
    boxes: Mapping[str, Box],
    recipe: ReconstructionRecipe,
    scene_id: str,
) -> Start:
    """Return the Gaussians to begin with.

    Points that are wrong along the ray of the view they come from look right from there and wrong
    from a lateral offset: that, and not only blur, is what a short fit leaves of a scene beside the
    logged path.

    Args:
        views: With depth.
        boxes: Size of each actor that a view may show.
        recipe: How many points from how many views, how wrong, how large.
        scene_id: Key of the random streams, with the recipe's seed.

    Raises:
        InputError: No view has depth.
    """
    splat = recipe.splat
    instants = sorted({view.t_us for view in views})[:: recipe.depth_every]
    chosen = []
    for view in views:
        if view.depth is not None and view.t_us in instants:
            rng = stream(scene_id, splat.seed, f"reconstruction.range.{view.name}")
            # By what the depth of every pixel ``(H, W)`` is multiplied: smooth over a patch, of
            # this spread about one.
            height, width = view.rgb.shape[:2]
            cell = max(2.0, PATCH_SHARE * width)
            coarse = rng.standard_normal((int(height / cell) + 2, int(width / cell) + 2)).astype(
                np.float32
            )
            smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
            wrong = view.depth * np.asarray(
                np.clip(1 + np.float32(recipe.range_error) * smooth, LEAST, MOST), dtype=np.float32
            )
            chosen.append(replace(view, depth=wrong))
    start = start_from_depth(chosen, boxes, splat.points, scene_id, splat.seed, splat.actor_points)
    return Start(
        _sized(start.background, recipe),
        {name: _sized(cloud, recipe) for name, cloud in start.actors.items()},
    )


def _sized(cloud: GaussianCloud, recipe: ReconstructionRecipe) -> GaussianCloud:
    return replace(
        cloud,
        scales=cloud.scales * recipe.size,
        opacities=np.full_like(cloud.opacities, recipe.opacity),
    )
