"""Motion features of the Frechet video motion distance, over Lucas-Kanade tracks.

Liu et al., "Frechet Video Motion Distance: A Metric for Evaluating Motion Consistency in Videos",
2024, section 3: histograms of the velocities and accelerations of tracked points. The published
distance tracks them with PIPs++; here they are tracked by pyramidal Lucas-Kanade, so that values
are not those of the published distance: it is called ``fvmd_lk``.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from alpasim_plugin.core.types import F32, F64, U8
from alpasim_plugin.lab.video_metrics.frames import check_stack

NAME = "fvmd_lk"
WINDOW = 16  # frames
EVERY = 25  # frames from the start of a window to that of the next
SIDE_PX = 256
JPEG_QUALITY = 95
POINTS = 20  # along each side of the grid
EDGE_PX = 8.0  # the grid's distance from the border
CELL = 5  # points along each side of a cell
CELL_FRAMES = 4
ANGLES = 8  # bins of 45 degrees
FASTEST = 255.0  # pixels a frame; the logarithm of its successor is 8
TRACK_PX = 21  # window of the tracker
TRACK_LEVELS = 3  # halvings of the resolution
DIMENSIONS = 2 * ANGLES * (WINDOW // CELL_FRAMES) * (POINTS // CELL) ** 2  # 1024


def motion_features(video: U8) -> F64:
    """Return the features ``(windows, 1024)`` of a video ``(T, H, W, 3)``: one vector for every 16
    frames, every 25 frames; none for shorter videos.

    Raises:
        EvaluatorError: No stack of frames.
    """
    check_stack("made", video)
    starts = range(0, len(video) - WINDOW + 1, EVERY)
    vectors = [motion_vector(track(video[start : start + WINDOW])) for start in starts]
    return np.array(vectors).reshape(-1, DIMENSIONS)


def track(window: U8) -> F32:
    """Return the positions ``(16, 400, 2)`` (x, y), pixels at 256x256, of a grid of points of the
    first frame; a point that is lost stays where it was last.

    Frames ``(16, H, W, 3)`` are coded as JPEG of quality 95 and squeezed to a square.
    """
    greys = [_small_grey(frame) for frame in window]
    axis = np.linspace(EDGE_PX, SIDE_PX - EDGE_PX, POINTS, dtype=np.float32)
    x, y = np.meshgrid(axis, axis)
    points = np.stack([x.ravel(), y.ravel()], axis=-1)  # (400, 2), row by row
    positions = [points]
    for before, after in itertools.pairwise(greys):
        moved, followed, _ = cv2.calcOpticalFlowPyrLK(
            before,
            after,
            points[:, None],
            None,
            winSize=(TRACK_PX, TRACK_PX),
            maxLevel=TRACK_LEVELS,
        )
        points = np.where(followed == 1, moved[:, 0], points)
        positions.append(points)
    return np.stack(positions).astype(np.float32)


def motion_vector(positions: F32) -> F64:
    """Return the histograms ``(1024,)`` of the velocities and of the accelerations of tracks ``(16,
    400, 2)``.

    A difference with the frame before the first one is zero.
    """
    velocity = np.zeros(positions.shape)
    velocity[1:] = np.diff(positions.astype(np.float64), axis=0)
    acceleration = np.zeros(positions.shape)
    acceleration[2:] = np.diff(velocity[1:], axis=0)
    return np.concatenate([_histograms(velocity), _histograms(acceleration)])


def _histograms(field: F64) -> F64:
    """Return the histograms ``(512,)`` of the angles of vectors ``(16, 400, 2)``: of every 5x5
    points and 4 frames, weighted by the logarithm of their length in eighths, rounded up.
    """
    length = np.linalg.norm(field, axis=-1)
    weight = np.ceil(np.minimum(np.log2(np.minimum(length, FASTEST) + 1), ANGLES)) / ANGLES
    turn = np.arctan2(field[..., 0], field[..., 1]) + np.pi  # x first, as published
    angle = np.minimum(np.floor(turn / (2 * np.pi / ANGLES)), ANGLES - 1)
    cells = POINTS // CELL
    shape = (WINDOW // CELL_FRAMES, CELL_FRAMES, cells, CELL, cells, CELL)
    by_cell = [
        np.where(angle == k, weight, 0.0).reshape(shape).sum(axis=(1, 3, 5)) for k in range(ANGLES)
    ]  # (4, 4, 4) each
    return np.stack(by_cell, axis=-1).ravel()


def _small_grey(frame: U8) -> U8:
    bgr = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    coded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    small = cv2.resize(cv2.imdecode(coded, cv2.IMREAD_COLOR), (SIDE_PX, SIDE_PX))
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
