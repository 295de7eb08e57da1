"""Two guards. Every fixed frame is checked, and a broken one is replaced by the raw frame, with an
event that names the failure.

The harmlessness guard of the generator in pixels keeps the render where a change is not believable.
A change is believable where the render is transparent, where it is small, where the map shows
something (a lane line, a road user), or where the last output already showed nearby what the
generator draws now. Elsewhere an opaque render is better evidence than a guess.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.image_metrics import is_black
from alpasim_plugin.core.types import F32, U8

NAN = "fixer-nan"
RANGE = "fixer-range"
BLACK = "fixer-black"
FROZEN = "fixer-frozen"
LIMIT = 1.5  # a quarter of the range from black to white beyond either end
SHARE = 0.01  # of a frame's values may lie beyond the limit; decoders overshoot at a few edges
# grey levels of mean change in the raw frames above which an unchanged output counts as frozen
MOVED = 0.5
CELL = 8  # pixels of the side of a cell; changes are measured by cells
REACH = 2  # cells around, where the map or the last output may support a change
# opacity of a cell: below the first the generator is free, above the second the render is trusted
OPAQUE = (0.9, 0.98)
# mean change of a cell, of a range of 2: below the first it is kept, above the second not believed
LARGE = (0.3, 0.5)
AROUND = 2 * REACH + 1
MAPPED = 0.02  # share of a cell's range that drawn map covers


def measures(video: Tensor) -> Tensor:
    """Measure decoded frames before they are clipped.

    Args:
        video: ``(T, ...)`` in any layout, meant to lie in [-1, 1].

    Returns:
        ``(T, 3)`` float32: lowest and highest value, NaN where one is anywhere in the frame, and
        the share of values beyond `LIMIT`.
    """
    values = video.flatten(1)
    counts = [torch.count_nonzero(frame.abs() > LIMIT) for frame in values]
    beyond = torch.stack(counts) / values.shape[1]
    return torch.stack([values.amin(1).float(), values.amax(1).float(), beyond], dim=1)


def failures(measured: F32) -> list[str]:
    """Return the failure of frames as `measures` gave them, "" where a frame is fine."""
    events = []
    for low, high, beyond in measured:
        if not (np.isfinite(low) and np.isfinite(high)):
            events.append(NAN)
        else:
            events.append(RANGE if beyond > SHARE else "")
    return events


def black(fixed: U8, raw: U8) -> bool:
    """Return whether the fixed image is black and the raw one is not."""
    return is_black(fixed) and not is_black(raw)


def frozen(fixed: U8, before: U8, raw: U8, raw_before: U8) -> bool:
    """Return whether an output repeats the previous one bit for bit although the raw frame
    changed.
    """
    if not np.array_equal(fixed, before):
        return False
    return float(np.abs(raw.astype(np.int16) - raw_before).mean()) > MOVED


def check_frames(measured: F32, fixed: U8, raw: U8, before: tuple[U8, U8] | None) -> Sequence[str]:
    """Return the failure of each frame of one view.

    Args:
        measured: ``(T, 3)``, the frames as decoded; see `measures`.
        fixed: ``(T, H, W, 3)`` the same as images.
        raw: ``(T, H, W, 3)`` what the fixer received.
        before: Last fixed and raw frame of the previous block, if there was one.

    Returns:
        T events, "" where a frame is fine.
    """
    events = failures(measured)
    for t, event in enumerate(events):
        last = (fixed[t - 1], raw[t - 1]) if t else before
        if not event and black(fixed[t], raw[t]):
            events[t] = BLACK
        elif not event and last is not None and frozen(fixed[t], last[0], raw[t], last[1]):
            events[t] = FROZEN
    return events


def render_share(
    out: Tensor,
    render: Tensor,
    opacity: Tensor,
    sdmap: Tensor,
    before: Tensor,
) -> Tensor | None:
    """Return the weight ``(B, H, W, 1)`` with which the render is put back where the change is not
    believable, or None where the weight is found to be 0 everywhere; on a GPU finding that would
    wait, and the weight is returned.

    Args:
        out: ``(B, H, W, 3)`` generated frame, in the range from -1 to 1 or a little beyond.
        render: Like ``out``.
        opacity: ``(B, H, W, 1)``.
        sdmap: Like ``out``; black where it shows nothing.
        before: The last output, like ``out``.
    """
    change = _cells((out - render).abs_()).mean(1, keepdim=True)
    if not out.is_cuda and float(change.amax()) <= LARGE[0]:
        return None
    trusted = _ramp(_cells(opacity), *OPAQUE) * _ramp(change, *LARGE)
    mapped = F.max_pool2d((_cells(sdmap).mean(1, keepdim=True) + 1) / 2, AROUND, 1, REACH) > MAPPED
    now, past = _cells(out), _cells(before)
    low, high = -F.max_pool2d(-past, AROUND, 1, REACH), F.max_pool2d(past, AROUND, 1, REACH)
    above = torch.relu(now - high).amax(1, keepdim=True)
    below = torch.relu(low - now).amax(1, keepdim=True)
    unseen = _ramp(above + below, LARGE[0] / 2, LARGE[1] / 2)
    share = trusted * unseen * ~mapped
    whole = F.interpolate(share, scale_factor=CELL, mode="bilinear", align_corners=False)
    return whole.permute(0, 2, 3, 1)


def _cells(x: Tensor) -> Tensor:
    """Average ``(B, H, W, C)`` over cells: ``(B, C, H / 8, W / 8)``."""
    b, h, w, c = x.shape  # rows first, whose values lie in runs: torch pools few channels slowly
    rows = x.reshape(b, h // CELL, CELL, w * c).mean(2)
    return rows.view(b, h // CELL, w // CELL, CELL, c).mean(3).permute(0, 3, 1, 2)


def _ramp(x: Tensor, low: float, high: float) -> Tensor:
    return ((x - low) / (high - low)).clip(0, 1)
