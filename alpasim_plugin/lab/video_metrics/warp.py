"""Warp L1: how much a video changes beyond its own motion.

The flow from every frame to the one before is estimated on the video itself, so a blurred video
scores better: read it beside a distance to the truth. The paper takes the late frames of a clip and,
where there is one, the mask of the road.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import F32, F64, U8, Bool
from alpasim_plugin.lab.video_metrics.frames import check_stack

# The late window is the last third of the pairs, at least 30
LATE_SHARE = 3
LATE_LEAST = 30


@dataclass(frozen=True)
class WarpErrors:
    """Warp errors of the ``T - 1`` pairs of neighbouring frames, 0 to 1."""

    whole: F64  # (T - 1,) over all valid pixels
    road: F64 | None  # (T - 1,) over those of the road; NaN where a pair shows none


def warp_l1(video: U8) -> F64:
    """Return the warp error of every pair of neighbouring frames over the whole image, ``(T - 1,)``
    (`warp_errors`).
    """
    return warp_errors(video).whole


def warp_errors(video: U8, road: Bool | None = None) -> WarpErrors:
    """Return the warp errors of every pair of neighbouring frames.

    Farneback flow on grey frames (pyramid 0.5, 3 levels, window 21, 3 iterations, poly_n 5,
    poly_sigma 1.2); the previous frame is sampled where the flow points, bilinear, in float32; mean
    over the pixels that come from inside the image of the absolute difference summed over RGB,
    divided by 765.

    Args:
        video: ``(T, H, W, 3)``, at least two frames.
        road: ``(T, H, W)``, the pixels of every frame to which the second error is restricted.

    Raises:
        EvaluatorError: Fewer than two frames, no stack of frames, or a mask of another size.
    """
    check_stack("made", video)
    if len(video) < 2:
        raise EvaluatorError("a video: one frame", "give at least two")
    if road is not None and road.shape != video.shape[:3]:
        raise EvaluatorError(
            f"a road mask {road.shape} of a video {video.shape}", "give a mask for every frame"
        )
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in video]
    whole = []
    on_road = []
    for i in range(1, len(video)):
        flow = backward_flow(grey[i], grey[i - 1])
        difference, valid = _warped_difference(video[i - 1], video[i], flow)
        whole.append(_mean_error(difference, valid))
        if road is not None:
            chosen = valid & road[i]
            on_road.append(_mean_error(difference, chosen) if chosen.any() else np.nan)
    return WarpErrors(np.array(whole), None if road is None else np.array(on_road))


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


def _warped_difference(previous: U8, frame: U8, flow: F32) -> tuple[F32, Bool]:
    """Return the absolute difference of a frame from the warped previous one, summed over RGB, and
    which pixels come from inside the image, ``(H, W)`` each.
    """
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
    return np.abs(frame.astype(np.float32) - warped).sum(axis=2), valid


def _mean_error(difference: F32, pixels: Bool) -> float:
    return float(difference[pixels].mean(dtype=np.float64)) / 765.0
