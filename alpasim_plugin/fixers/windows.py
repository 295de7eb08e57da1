"""Windows over a clip, and the cross-fade that joins what was made in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.types import F32


def windows(frames: int, length: int, stride: int) -> list[range]:
    """Return windows of ``length`` frames that begin ``stride`` apart; the last one ends where the clip ends.

    A clip that is shorter than a window has one, of the clip's length.

    Example:
        >>> [(w.start, w.stop) for w in windows(60, 25, 17)]
        [(0, 25), (17, 42), (34, 59), (35, 60)]
        >>> len(windows(198, 25, 17)), len(windows(900, 25, 17)), windows(9, 25, 17)
        (12, 53, [range(0, 9)])
    """
    last = max(frames - length, 0)
    starts = [*range(0, last, stride), last]
    return [range(start, min(start + length, frames)) for start in starts]


def fade_in(window: range, previous: range | None, overlap: int) -> F32:
    """Return the weight of a window's frames over what the windows before it made, ``(len(window),)``.

    It rises linearly over the first ``overlap`` frames and is 1 from there on, and everywhere in a clip's first window.

    Example:
        >>> fade_in(range(17, 42), range(25), 8)[:9].round(3).tolist()
        [0.111, 0.222, 0.333, 0.444, 0.556, 0.667, 0.778, 0.889, 1.0]
    """
    weights = np.ones(len(window), np.float32)
    if previous is not None:
        n = min(overlap, len(range(window.start, previous.stop)))
        weights[:n] = np.arange(1, n + 1) / (n + 1)
    return weights


def fade_weights(parts: Sequence[range], overlap: int) -> F32:
    """Return the weight of every window at every frame of the clip, ``(windows, frames)``; the columns sum to 1.

    The same as fading in one window after another (`fade_in`), written as a matrix.
    """
    weights = np.zeros((len(parts), parts[-1].stop), np.float32)
    for i, window in enumerate(parts):
        share = fade_in(window, parts[i - 1] if i else None, overlap)
        weights[:i, window.start : window.stop] *= 1 - share
        weights[i, window.start : window.stop] = share
    return weights
