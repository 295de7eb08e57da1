"""Find the sky in photographs: smooth, reaching to the top, without parallax, and of one colour by direction over the whole drive.

No network is needed for a layer that a fit must not fill: what is called sky here is sky almost surely; the ring around leaves and wires is
left to the fit, which may put Gaussians there or not.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F32, F64, Bool
from alpasim_plugin.gaussians.fit.views import PosedView

I32 = npt.NDArray[np.int32]

SMOOTH_LEVELS = 5.0  # largest step of brightness to a neighbouring pixel
SMALLEST_SHARE = 0.002  # of the picture, of a region
SOLID_SHARE = 0.25  # of a region's measured pixels that have a depth: then it is a wall
COLOUR_LEVELS = 40.0  # by which the sky's colour may differ from its median in all photographs
LOW_RAD = np.radians(0.0)  # no sky below the horizon


def sky_masks(views: Sequence[PosedView], up: F64 | None = None) -> list[Bool]:
    """Return where each view shows sky, ``(H, W)`` bool.

    Args:
        views: With depth where it is known: a region that has one is no sky.
        up: ``(3,)`` in the world; None is +z.
    """
    above = np.array([0.0, 0.0, 1.0]) if up is None else up
    regions = [_regions(view, above) for view in views]
    seen = [view.rgb[region > 0] for view, region in zip(views, regions, strict=True) if region.any()]
    if not seen:
        return [region > 0 for region in regions]
    # Every photograph counts alike, so that one wall that fills a picture does not decide.
    usual = np.median([np.median(colours, axis=0) for colours in seen], axis=0)
    return [_of_colour(view, region, usual) for view, region in zip(views, regions, strict=True)]


def _regions(view: PosedView, up: F64) -> I32:
    """Label smooth regions that reach the top of the picture and are not solid."""
    grey = cv2.GaussianBlur(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (3, 3), 0)
    step = np.maximum(np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)), np.abs(cv2.Sobel(grey, cv2.CV_32F, 0, 1))) / 4
    smooth = (step < SMOOTH_LEVELS) & (_elevation(view, up) > LOW_RAD)
    if view.mask is not None:
        smooth &= view.mask
    _, label = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    out = np.zeros(grey.shape, np.int32)
    measured = None if view.depth is None else view.depth > 0
    for i in set(np.unique(label[0])) - {0}:
        region = label == i
        # Flow spreads depth over the edges of trees into the sky: the inside of a region decides.
        inside = cv2.erode(region.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        solid = 0.0 if measured is None or not inside.any() else 4 * float((measured & inside).sum()) / float(inside.sum())
        if region.mean() > SMALLEST_SHARE and solid < SOLID_SHARE:
            out[region] = i
    return out


def _of_colour(view: PosedView, label: I32, usual: F32) -> Bool:
    """Keep regions whose usual colour is that of the sky; a sky grows brighter towards the horizon, so single pixels may differ more."""
    out = np.zeros(label.shape, np.uint8)
    for i in set(np.unique(label)) - {0}:
        colours = view.rgb[label == i].astype(np.float32)
        middle = np.median(colours, axis=0)
        if np.abs(middle - usual).max() < COLOUR_LEVELS:
            out |= ((label == i) & (np.abs(view.rgb - middle).max(axis=2) < 1.5 * COLOUR_LEVELS)).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(out, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0)


def _elevation(view: PosedView, up: F64) -> F32:
    camera = view.camera
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    direction = camera.T_camera_world[:3, :3] @ up
    along = x * direction[0] + y * direction[1] + direction[2]
    return np.asarray(np.arcsin(along / np.sqrt(x * x + y * y + 1)), np.float32)
