"""Put the sky of posed views together as a panorama.

The sky is so far away that where a camera stands does not matter: every sky pixel is one direction. Reconstructions of recorded drives
learn such an environment map beside the Gaussians (Street Gaussians, OmniRe); its optimum under fixed opacity is the mean of what the views
saw in each direction, which is computed here at once. Directions that no view saw take their colour from near ones that were seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from alpasim_plugin.core.types import F32, F64
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.scene.sky import HEIGHT, HIGH_RAD, LOW_RAD, WIDTH, Sky


def sky_of(views: Sequence[PosedView]) -> Sky | None:
    """Return the sky that the views saw; None where no view has a sky pixel."""
    total, weight = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH))
    for view in views:
        if view.sky is not None:
            _add(view, total, weight)
    if not weight.any():
        return None
    return Sky(_spread((total / np.maximum(weight, 1e-9)[..., None]).astype(np.float32), (weight > 0).astype(np.float32)))


def _add(view: PosedView, total: F64, weight: F64) -> None:
    """Add a view's sky pixels to their directions; pixels at the sky's edge, which mix it with what is in front, are left out."""
    assert view.sky is not None
    rows, columns = np.nonzero(cv2.erode(view.sky.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1))
    camera = view.camera
    local = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, np.ones(len(rows))], axis=1)
    x, y, z = (local @ camera.T_camera_world[:3, :3]).T
    column = np.floor(np.arctan2(y, x) * (WIDTH / (2 * np.pi))).astype(np.int64) % WIDTH
    row = np.rint((HIGH_RAD - np.arctan2(z, np.hypot(x, y))) * ((HEIGHT - 1) / (HIGH_RAD - LOW_RAD))).astype(np.int64).clip(0, HEIGHT - 1)
    np.add.at(total, (row, column), view.rgb[rows, columns] / 255.0)
    np.add.at(weight, (row, column), 1.0)


def _spread(image: F32, known: F32) -> F32:
    """Fill unknown pixels from known ones near by: means over ever coarser cells, the finest that holds a known pixel (pull and push)."""
    if min(image.shape[:2]) <= 1 or known.all():
        return image
    half = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
    area = cv2.resize(known, half, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(image * known[..., None], half, interpolation=cv2.INTER_AREA) / np.maximum(area, 1e-9)[..., None]
    coarse = _spread(np.where(area[..., None] > 0, mean, 0).astype(np.float32), (area > 0).astype(np.float32))
    filled = cv2.resize(coarse, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.where(known[..., None] > 0, image, filled), dtype=np.float32)
