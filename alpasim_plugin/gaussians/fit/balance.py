"""Estimate each photograph's exposure and white balance from points that several photographs show.

A camera that meters for itself changes its gain by a tenth from one street corner to the next. A surface keeps its brightness, so the
logarithm of what a photograph shows of a track's point is the point's plus the photograph's: linear, solved with robust weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.types import F32, F64, I64, U8
from alpasim_plugin.gaussians.fit.tracks import Tracks
from alpasim_plugin.gaussians.fit.views import PosedView

PATCH_PX = 7
DARKEST, BRIGHTEST = 12.0, 245.0  # levels of a patch's mean that say something
ROUNDS, SPREAD = 5, 0.05  # of robust weights; of a logarithm that counts fully
PULL = 1.0  # towards a gain of 1, in observations


def balances(views: Sequence[PosedView], tracks: Tracks) -> F64:
    """Return the gain ``(V, 3)`` of each view's red, green and blue over the drive's; their geometric mean is 1.

    A view without points keeps 1.
    """
    shown = np.array([_patch(views[v].rgb, at) for v, at in zip(tracks.view.tolist(), tracks.at, strict=True)]).reshape(-1, 3)
    out = np.ones((len(views), 3))
    for channel in range(3):
        value = shown[:, channel]
        good = (value > DARKEST) & (value < BRIGHTEST)
        if good.any():
            out[:, channel] = np.exp(_solved(np.log(value[good]), tracks.view[good], tracks.point[good], len(views), tracks.count))
    return out


def gain_between(centres: F64, gains: F64, place: F64) -> F32:
    """Return the gain ``(3,)`` at a place, of the two nearest of ``centres (N, 3)``, by inverse distance; 1 where there is none."""
    if not len(centres):
        return np.ones(3, np.float32)
    distance = np.linalg.norm(centres - place, axis=1)
    near = np.argsort(distance, kind="stable")[:2]
    weight = 1 / (distance[near] + 1e-3)
    return np.asarray(weight @ gains[near] / weight.sum(), np.float32)


def _patch(rgb: U8, at: F64) -> F64:
    patch = cv2.getRectSubPix(rgb, (PATCH_PX, PATCH_PX), (float(at[0] - 0.5), float(at[1] - 0.5)))
    return np.asarray(patch.reshape(-1, 3).mean(axis=0), dtype=np.float64)


def _solved(value: F64, view: I64, point: I64, views: int, points: int) -> F64:
    """Solve value = gain[view] + surface[point] for the gains: surfaces are means of what is left, so only V unknowns remain."""
    gain, weight = np.zeros(views), np.ones(len(value))
    for _ in range(ROUNDS):
        total = np.maximum(np.bincount(point, weight, points), 1e-12)
        seen = scipy.sparse.csr_matrix((weight, (view, point)), shape=(views, points))
        shared = seen @ scipy.sparse.diags(1 / total)
        A = np.diag(np.bincount(view, weight, views) + PULL) - (shared @ seen.T).toarray()
        b = np.bincount(view, weight * value, views) - shared @ np.bincount(point, weight * value, points)
        gain = np.linalg.solve(A, b)
        gain -= gain.mean()
        surface = np.bincount(point, weight * (value - gain[view]), points) / total
        off = np.abs(value - gain[view] - surface[point])
        weight = SPREAD / np.maximum(off, SPREAD)
    return gain
