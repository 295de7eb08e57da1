"""Check every fixed frame. A broken one is replaced by the raw frame, with an event that names the failure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from alpasim_plugin.core.pixels import is_black
from alpasim_plugin.core.types import U8

NAN, RANGE, BLACK, FROZEN = "fixer-nan", "fixer-range", "fixer-black", "fixer-frozen"
LIMIT = 1.5  # a quarter of the range from black to white beyond either end
SHARE = 0.01  # of a frame's values may lie beyond the limit; decoders overshoot at a few edges
MOVED = 0.5  # grey levels of mean change in the raw frames above which an unchanged output counts as frozen


def failures(video: Tensor) -> list[str]:
    """Check a view's decoded frames before they are clipped.

    Args:
        video: ``(3, T, H, W)``, meant to lie in [-1, 1].

    Returns:
        T events, "" where a frame is fine.
    """
    low, high = (x.float() for x in (video.amin((0, 2, 3)), video.amax((0, 2, 3))))  # NaN anywhere in a frame is the result
    finite = (low.isfinite() & high.isfinite()).tolist()
    beyond = ((low < -LIMIT) | (high > LIMIT)).tolist()
    events = ["" if fine else NAN for fine in finite]
    for t, far in enumerate(beyond):
        if finite[t] and far and float((video[:, t].abs() > LIMIT).float().mean()) > SHARE:
            events[t] = RANGE
    return events


def black(fixed: U8, raw: U8) -> bool:
    """Return whether the fixed image is black and the raw one is not."""
    return is_black(fixed) and not is_black(raw)


def frozen(fixed: U8, before: U8, raw: U8, raw_before: U8) -> bool:
    """Return whether an output repeats the previous one bit for bit although the raw frame changed."""
    if not np.array_equal(fixed, before):
        return False
    return float(np.abs(raw.astype(np.int16) - raw_before).mean()) > MOVED


def check_frames(video: Tensor, fixed: U8, raw: U8, before: tuple[U8, U8] | None) -> Sequence[str]:
    """Return the failure of each frame of one view.

    Args:
        video: ``(3, T, H, W)`` as decoded.
        fixed: ``(T, H, W, 3)`` the same as images.
        raw: ``(T, H, W, 3)`` what the fixer was given.
        before: Last fixed and raw frame of the previous block, if there was one.

    Returns:
        T events, "" where a frame is fine.
    """
    events = failures(video)
    for t, event in enumerate(events):
        last = (fixed[t - 1], raw[t - 1]) if t else before
        if not event and black(fixed[t], raw[t]):
            events[t] = BLACK
        elif not event and last is not None and frozen(fixed[t], last[0], raw[t], last[1]):
            events[t] = FROZEN
    return events
