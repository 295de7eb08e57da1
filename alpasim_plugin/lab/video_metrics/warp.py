"""Warp L1: how much a video changes beyond its own motion.

The flow from every frame to the one before is estimated on the video itself, so a blurred video
scores better: read it beside a distance to the truth. The paper takes the late frames of a clip.
"""

from __future__ import annotations

import cv2
import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import F32, F64, U8
from alpasim_plugin.lab.video_metrics.frames import check_stack

# The late window is the last third of the pairs, at least 30
LATE_SHARE = 3
LATE_LEAST = 30


def warp_l1(video: U8) -> F64:
    """Return the warp error of every pair of neighbouring frames.

    Farneback flow on grey frames (pyramid 0.5, 3 levels, window 21, 3 iterations, poly_n 5,
    poly_sigma 1.2); the previous frame is sampled where the flow points, bilinear, in float32; mean
    over the pixels that come from inside the image of the absolute difference summed over RGB,
    divided by 765.

    Args:
        video: ``(T, H, W, 3)``, at least two frames.

    Returns:
        ``(T - 1,)``, 0 to 1.

    Raises:
        EvaluatorError: Fewer than two frames, or no stack of frames.
    """
    check_stack("made", video)
    if len(video) < 2:
        raise EvaluatorError("a video: one frame", "give at least two")
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in video]
    return np.array(
        [
            _pair(video[i - 1], video[i], backward_flow(grey[i], grey[i - 1]))
            for i in range(1, len(video))
        ]
    )


def backward_flow(grey: U8, previous: U8) -> F32:
    """Return where each pixel of a grey frame ``(H, W)`` was in the previous one, as a displacement
    ``(H, W, 2)`` (x, y), pixels.
    """
    flow = cv2.calcOpticalFlowFarneback(grey, previous, None, 0.5, 3, 21, 3, 5, 1.2, 0)
    return np.asarray(flow, dtype=np.float32)


def late_window(pairs: int) -> slice:
    """Return which of ``pairs`` warp errors are late: the last third, at least 30, or all.

    Example:
        >>> late_window(197), late_window(60), late_window(10)
        (slice(131, None, None), slice(30, None, None), slice(0, None, None))
    """
    return slice(max(pairs - max(-(-pairs // LATE_SHARE), LATE_LEAST), 0), None)


def _pair(previous: U8, frame: U8, flow: F32) -> float:
    h, w = frame.shape[:2]
    rows, columns = np.indices((h, w), dtype=np.float32)
    x = columns + flow[..., 0]
    y = rows + flow[..., 1]
    valid = (x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)
    if not valid.any():
        raise EvaluatorError(
            "two neighbouring frames: flow that leaves the image everywhere",
            "look at the video",
        )
    warped = cv2.remap(
        previous.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    difference = np.abs(frame.astype(np.float32) - warped).sum(axis=2)
    return float(difference[valid].mean(dtype=np.float64)) / 765.0
