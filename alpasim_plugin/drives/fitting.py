"""Fit the reconstruction of a drive to its photographs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from alpasim_plugin.core.types import Box
from alpasim_plugin.drives.source import Points
from alpasim_plugin.gaussians.fit.drive import fit_drive
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.start import cloud_from_points
from alpasim_plugin.gaussians.fit.views import PosedView

Report = Callable[[str, int, int], None]
SEED = 0


def fitted(
    views: Sequence[PosedView],
    kept: Sequence[PosedView],
    points: Points,
    boxes: Mapping[str, Box],
    scene_id: str,
    folder: Path,
    tell: Report,
) -> tuple[Reconstruction, dict[str, tuple[float, float, float]]]:
    """Fit a model to views.

    Args:
        views: To fit to.
        kept: Held out, to measure with on the way.
        points: To start from.
        boxes: Sizes of the road users that views may show.
        scene_id: Key of the random streams.
        folder: Keeps the fit's state; the same call goes on from it.
        tell: Called as the fit goes on.

    Returns:
        The model, and the exposure of each view by its name.
    """
    torch.set_num_threads(1)
    near = points.chosen(np.asarray(points.spread < np.percentile(points.spread, 90)))
    start = cloud_from_points(near.xyz, near.rgb)
    done = fit_drive(
        views, start, kept=kept, boxes=boxes, scene_id=scene_id, folder=folder, seed=SEED,
        report=lambda stage, at, all, numbers: tell(_words(stage, numbers), at, all),
    )  # fmt: skip
    return done.model, dict(done.exposures)


def _words(stage: str, numbers: Mapping[str, float]) -> str:
    """Return a stage with how well held-out photographs are shown, where that was just measured."""
    return f"{stage}, held-out photographs {numbers['held_out_db']:.1f} dB" if "held_out_db" in numbers else stage
