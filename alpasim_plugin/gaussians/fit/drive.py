"""Fit the street of a recorded drive: what the photographs say before the fit (depth, sky,
exposure), then the fit. See `fit_drive`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, Box
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.dense import STRIDE, between_points, depth_maps, sky_masks
from alpasim_plugin.gaussians.fit.lens import (
    balances,
    distances_through_lens,
    gain_near,
    through_lens,
    without_distortion,
)
from alpasim_plugin.gaussians.fit.loop import Look, fit
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.start import Start, start_from_maps, start_in_boxes
from alpasim_plugin.gaussians.fit.tracks import Tracks, follow, place
from alpasim_plugin.gaussians.fit.trial import Trial, trial_of
from alpasim_plugin.gaussians.fit.views import PosedView, camera_of
from alpasim_plugin.gaussians.lens_camera import LensCamera

FITTING = "fitting"  # the stage
PREVIEW_SHARE = 0.25  # of the updates, after which a street can be looked at
LEAST_WAY_M = 10.0  # a camera that moves less is not driven along a street under a sky
LEAST_MEASURED = 0.02  # share of the measured pixels that must have a depth for a start from them
# Stage, done, all, numbers of the fit
Report = Callable[[str, int, int, Mapping[str, float]], None]


@dataclass(frozen=True, eq=False)
class FittedDrive:
    """A street as its photographs show it.

    Attributes:
        model: Background, road users and sky, in the drive's own mean exposure.
        exposures: Name of each photograph, fitted or kept, to the gains of red, green and blue over
            the model's; a kept one's are those of its camera's nearest fitted ones, because its own
            pixels are there to judge.
    """

    model: Reconstruction
    exposures: Mapping[str, tuple[float, float, float]]


def fit_drive(
    views: Sequence[PosedView],
    points: GaussianCloud | None,
    *,
    kept: Mapping[str, PinholeCamera | LensCamera] | None = None,
    boxes: Mapping[str, Box] | None = None,
    scene_id: str = "drive",
    folder: Path | None = None,
    seed: int = 0,
    report: Report | None = None,
    preview: Callable[[FittedDrive], None] | None = None,
    trial: Callable[[Trial], None] | None = None,
    threads: int | None = None,
    recipe: SplatRecipe | None = None,
    device: str = "cpu",
) -> FittedDrive:
    """Fit a street to the photographs of a drive.

    Args:
        views: To fit to, +z of the world up; names sort them along the way, and up to the last
            ``-`` they name the camera. Those through a lens are fitted so, on the CPU alone; depth,
            sky and exposure are measured in their pinhole images.
        points: Measured or triangulated points; None starts from what the views' own depth gives.
        kept: Names and cameras of the photographs that are held out. Their pixels are not passed;
            their gains are those of their camera's nearest fitted photographs.
        boxes: Sizes of the road users that views show, which are fitted as nodes.
        scene_id: Key of the random streams.
        folder: Keeps the fit's state; the same call goes on from it.
        seed: Of the start, the order of views and the splits.
        report: Called with stage, done and all; while fitting also with loss, psnr_db and
            gaussians.
        preview: Given the street as it is after `PREVIEW_SHARE` of the updates.
        trial: Given what some updates take before the fit begins. None makes no trial.
        threads: Of the rasteriser.
        recipe: How to fit; None is `SplatRecipe.street`.
        device: Where to fit; what comes before is measured on the CPU.

    Raises:
        InputError: No view, or neither points nor depth to start from.
        InfrastructureError: The loss or a gradient is not finite.
    """
    tell = report or (lambda stage, done, all, numbers: None)
    if not views:
        do_this = "give at least some ten photographs along the way"
        raise InputError(f"{scene_id}: no photograph", do_this)
    recipe = replace(recipe or SplatRecipe.street(), seed=seed)
    train, guesses = prepared_views(views, tell)
    start = Start(
        _start(train, guesses, points, recipe, scene_id),
        start_in_boxes(_boxes_in_view(train, boxes or {}), recipe.actor_points, scene_id, seed),
    )

    if trial is not None:
        trial(trial_of(train, start, recipe, threads=threads, device=device))

    model = fit(
        train,
        start,
        recipe,
        look=_look_of(preview, train, kept or {}, recipe),
        scene_id=scene_id,
        folder=folder,
        threads=threads,
        device=device,
        report=lambda step, numbers: tell(FITTING, step, recipe.steps, numbers),
    )
    return FittedDrive(model, _exposures(train, model, kept or {}))


def _look_of(
    preview: Callable[[FittedDrive], None] | None,
    train: Sequence[PosedView],
    kept: Mapping[str, PinholeCamera | LensCamera],
    recipe: SplatRecipe,
) -> Look | None:
    """Return when a fit shows the street to ``preview``; None where there is none, since a look
    copies the model from its device.
    """
    if preview is None:
        return None

    def show(model: Reconstruction) -> None:
        preview(FittedDrive(model, _exposures(train, model, kept)))

    return Look(max(1, round(PREVIEW_SHARE * recipe.steps)), show)


def _boxes_in_view(views: Sequence[PosedView], boxes: Mapping[str, Box]) -> dict[str, Box]:
    """Return the boxes of the road users that at least one view shows."""
    names = {name for view in views for name in view.actors}
    return {name: box for name, box in boxes.items() if name in names}


def _exposures(
    views: Sequence[PosedView],
    model: Reconstruction,
    kept: Mapping[str, PinholeCamera | LensCamera],
) -> dict[str, tuple[float, float, float]]:
    """Return the gains of the fitted photographs, and of those that were kept from the fit the
    gains of their neighbours.
    """
    fitted = [replace(view, gain=model.gains[i]) for i, view in enumerate(views)]
    exposures = {view.name: view.gain for view in fitted}
    return exposures | {name: _gain_near(fitted, name, camera) for name, camera in kept.items()}


def prepared_views(
    views: Sequence[PosedView], tell: Report
) -> tuple[list[PosedView], list[F32 | None]]:
    """Measure depth, sky and exposure of photographs, camera by camera, in the order of their
    names.

    Returns:
        Views with depth, sky and gain; and for each of them depth ``(H, W)`` interpolated between
        the points that tracks place, None where there are too few.
    """
    ordered = []
    guesses = []
    cameras = {view.camera_name for view in views}
    for number, camera in enumerate(sorted(cameras)):
        tell("measuring depth, sky and exposure", number, len(cameras), {})
        camera_views = sorted(
            (view for view in views if view.camera_name == camera), key=lambda view: view.name
        )
        images = [without_distortion(view) for view in camera_views]
        for view, image, guess in zip(camera_views, *_of_one_camera(images), strict=True):
            ordered.append(_as_taken(view, image))
            guesses.append(_guess_as_taken(view, image, guess))
    tell("measuring depth, sky and exposure", len(cameras), len(cameras), {})
    return ordered, guesses


def _as_taken(view: PosedView, image: PosedView) -> PosedView:
    """Return a view with what was measured in its image without distortion."""
    camera = view.camera
    if not isinstance(camera, LensCamera):
        return image
    assert image.depth is not None
    sky = view.sky
    if sky is None and image.sky is not None:
        sky = through_lens(camera, image.pinhole, image.sky.astype(np.float32)) > 0
    depth = view.depth
    if depth is None:
        depth = distances_through_lens(camera, image.pinhole, image.depth)
    return replace(view, sky=sky, depth=depth, gain=image.gain)


def _guess_as_taken(view: PosedView, image: PosedView, guess: F32 | None) -> F32 | None:
    if guess is None or not isinstance(view.camera, LensCamera):
        return guess
    return distances_through_lens(view.camera, image.pinhole, guess)


def _of_one_camera(views: Sequence[PosedView]) -> tuple[list[PosedView], list[F32 | None]]:
    tracks = (
        follow(views)
        if len({view.rgb.shape for view in views}) == 1
        else Tracks(*(np.zeros(0, dtype=np.int64),) * 2, np.zeros((0, 2)), 0)
    )
    placed = place(tracks, [view.pinhole for view in views])
    maps = depth_maps(views, tracks, placed)
    measured = [
        view if view.depth is not None else replace(view, depth=depth)
        for view, depth in zip(views, maps, strict=True)
    ]
    way = (
        np.linalg.norm(np.diff([view.camera.centre_world for view in views], axis=0), axis=1).sum()
        if len(views) > 1
        else 0.0
    )
    masks = sky_masks(measured) if way > LEAST_WAY_M else [None] * len(views)
    done = []
    guesses = []
    for i, (view, mask, gain) in enumerate(
        zip(measured, masks, balances(views, tracks), strict=True)
    ):
        assert view.depth is not None
        sky = mask if view.sky is None else view.sky
        depth = view.depth if sky is None else np.where(sky, np.float32(0), view.depth)
        red, green, blue = gain.tolist()
        done.append(replace(view, sky=sky, depth=depth, gain=(red, green, blue)))
        q = between_points(view.pinhole, tracks, placed, i)
        guesses.append(None if q is None else np.asarray(1 / np.maximum(q, 1e-3), dtype=np.float32))
    return done, guesses


def _start(
    views: Sequence[PosedView],
    guesses: Sequence[F32 | None],
    points: GaussianCloud | None,
    recipe: SplatRecipe,
    scene_id: str,
) -> GaussianCloud:
    """Return Gaussians at measured depth, at guessed depth where nothing was measured, and at the
    points that were given.
    """
    share = float(
        np.mean(
            [0.0 if view.depth is None else (view.depth > 0).mean() * STRIDE**2 for view in views]
        )
    )
    point_sets = [] if points is None else [points]
    if share < LEAST_MEASURED:
        if points is None or not len(points):
            raise InputError(
                f"{len(views)} photographs: nothing whose distance they measure",
                "give points (structure from motion or LiDAR), or photographs that overlap, in order along the way, with their own poses",
            )
        return points
    more = []
    for view, guess in zip(views, guesses, strict=True):
        assert view.depth is not None
        near = (
            cv2.dilate(
                (view.depth > 0).astype(np.uint8), np.ones((2 * STRIDE + 1,) * 2, dtype=np.uint8)
            )
            > 0
        )
        free = ~near & (True if view.sky is None else ~view.sky)
        depth = np.zeros_like(view.depth)
        if guess is not None:
            depth = np.where(free, guess, 0).astype(np.float32)
        more.append(replace(view, depth=depth))
    return GaussianCloud.concatenate(
        [
            start_from_maps(views, more, recipe.points, scene_id, recipe.seed, recipe.start_size),
            *point_sets,
        ]
    )


def _gain_near(
    views: Sequence[PosedView], name: str, camera: PinholeCamera | LensCamera
) -> tuple[float, float, float]:
    """Return the gain of a photograph that was not fitted."""
    red, green, blue = gain_near(
        camera_of(name),
        camera.centre_world,
        [view.camera_name for view in views],
        np.array([view.camera.centre_world for view in views]),
        np.array([view.gain for view in views]),
    ).tolist()
    return red, green, blue
