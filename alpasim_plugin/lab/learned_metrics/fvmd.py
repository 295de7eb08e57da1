"""Frechet distance of motion histograms (FVMD, Liu et al. 2024), with Lucas-Kanade tracks:
`fvmd_lk`. With PIPs++ tracks it would be FVMD.

Windows of 16 frames every 25, JPEG quality 95, 256x256. 400 points on a 20x20 grid are tracked;
their velocities and accelerations are counted in cubes of 5x5 points and 4 frames by angle (8 bins)
with a logarithmic weight of their length: 512 numbers each.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import F32, F64, U8
from alpasim_plugin.lab.learned_metrics.frechet import frechet_distance
from alpasim_plugin.lab.video_metrics.frames import check_stack

FVMD = "fvmd"  # with tracks of PIPs++, which the user supplies
FRAMES = 16
EVERY = 25
SIDE_PX = 256
JPEG = 95
GRID = 20
FIRST_PX = 8.0
LAST_PX = 248.0
CELL, SPAN, ANGLES = 5, 4, 8  # points, frames, bins
RIDGE = 1e-5
LK_WINDOW = (21, 21)
LK_LEVEL = 3
LK_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)


def motion_features(video: U8) -> F64:
    """Return the histograms ``(N, 1024)`` of a clip's windows ``(T, H, W, 3)``; no row where it has
    fewer than 16 frames.

    Raises:
        EvaluatorError: Not a stack of frames.
    """
    check_stack("made", video)
    rows = [
        histograms(lk_tracks(video[s : s + FRAMES]))
        for s in range(0, len(video) - FRAMES + 1, EVERY)
    ]
    return np.array(rows, dtype=np.float64).reshape(
        len(rows), 2 * ANGLES * (GRID // CELL) ** 2 * (FRAMES // SPAN)
    )


def lk_tracks(frames: U8) -> F64:
    """Track the grid through 16 frames ``(16, H, W, 3)`` by pyramidal Lucas-Kanade, 21x21, 3 levels
    above the first.

    A point that is lost stays where it was last seen.

    Returns:
        ``(16, 400, 2)`` x and y, pixels of the 256x256 image.
    """
    grey = [_prepared(frame) for frame in frames]
    line = np.linspace(FIRST_PX, LAST_PX, GRID)
    y, x = np.meshgrid(line, line, indexing="ij")
    at: F32 = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32)
    out = [at.astype(np.float64)]
    for before, after in pairwise(grey):
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            before, after, at[:, None], None, winSize=LK_WINDOW, maxLevel=LK_LEVEL, criteria=LK_STOP
        )
        at = np.where(found.reshape(-1, 1) == 1, moved[:, 0], at).astype(np.float32)
        out.append(at.astype(np.float64))
    return np.stack(out)


def _prepared(frame: U8) -> U8:
    done, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(frame[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG]
    )
    if not done:
        raise EvaluatorError(
            f"a frame of shape {frame.shape}: it cannot be coded as JPEG",
            "give images",
        )
    small = cv2.resize(
        cv2.imdecode(data, cv2.IMREAD_COLOR), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_LINEAR
    )
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def histograms(tracks: F64) -> F64:
    """Return the histograms ``(1024,)`` of velocities, then accelerations, of tracks ``(16, 400,
    2)``.

    ``v_t = p_t - p_{t-1}`` (the first is 0), ``a_t = v_t - v_{t-1}`` (the first two are 0).
    """
    velocity = np.concatenate([np.zeros_like(tracks[:1]), np.diff(tracks, axis=0)])
    acceleration = np.concatenate([np.zeros_like(tracks[:2]), np.diff(velocity[1:], axis=0)])
    return np.concatenate([_histogram(velocity), _histogram(acceleration)])


def _histogram(vectors: F64) -> F64:
    """Count vectors ``(16, 400, 2)`` by angle in cubes of 4 frames and 5x5 points: ``(512,)``,
    time, rows, columns, angle.
    """
    x, y = vectors[..., 0], vectors[..., 1]
    length = np.minimum(np.hypot(x, y), 255.0)
    weight = np.ceil(np.minimum(np.log2(length + 1), 8.0)) / 8
    angle = np.clip(np.floor((np.arctan2(x, y) + np.pi) / (np.pi / 4)), 0, ANGLES - 1).astype(
        int
    )  # x first, as in FVMD's code
    counted = np.where(
        angle[..., None] == np.arange(ANGLES), weight[..., None], 0.0
    )  # (16, 400, 8)
    n = GRID // CELL
    cubes = counted.reshape(FRAMES // SPAN, SPAN, n, CELL, n, CELL, ANGLES).sum(axis=(1, 3, 5))
    return np.asarray(cubes.ravel())


def fvmd_lk(made: Sequence[F64], truth: Sequence[F64]) -> float:
    """Return the distance of two sets of clips by their `motion_features`, one number for all
    windows.

    Raises:
        EvaluatorError: Fewer than two windows on a side.
    """
    return frechet_distance(np.concatenate(list(made)), np.concatenate(list(truth)), ridge=RIDGE)
