"""Two guards. Every fixed frame is checked, and a broken one is replaced by the raw frame, with an
event that names the failure.

The harmlessness guard of the generator in pixels keeps the render where a change is not believable.
A change is believable where the render is transparent, where it is small, where the map shows
something (a lane line, a road user), or where the last output already showed nearby what the
generator draws now. Elsewhere an opaque render is better evidence than a guess.
"""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import known_false, upload
from alpasim_plugin.core.image_metrics import BLACK_MAX
from alpasim_plugin.core.types import F32, U8

NAN = "fixer-nan"
RANGE = "fixer-range"
BLACK = "fixer-black"
FROZEN = "fixer-frozen"
RENDER_BLACK = "black"
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


def check_frames(video: Tensor, fixed: U8, raw: U8, before: tuple[U8, U8] | None) -> Sequence[str]:
    """Return the failure of each frame of one view.

    Args:
        video: ``(T, ...)`` the frames as decoded, meant to lie in [-1, 1].
        fixed: ``(T, H, W, 3)`` the same as images.
        raw: ``(T, H, W, 3)`` what the fixer received.
        before: Last fixed and raw frame of the previous block, if there was one.

    Returns:
        T events, "" where a frame is fine.
    """
    first = (fixed[0], raw[0]) if before is None else before
    images, pasts = (
        [upload(part, video.device) for part in parts]
        for parts in (
            (fixed, raw),
            (
                np.concatenate([start[None], part[:-1]])
                for start, part in zip(first, (fixed, raw), strict=True)
            ),
        )
    )
    return failures(measures(video, *images, *pasts).cpu().numpy())


def measures(
    video: Tensor, fixed: Tensor, raw: Tensor, fixed_before: Tensor, raw_before: Tensor
) -> Tensor:
    """Measure decoded frames before they are clipped.

    Args:
        video: ``(T, ...)`` in any layout, meant to lie in [-1, 1].
        fixed: ``(T, H, W, 3)`` uint8, the same as images.
        raw: Like ``fixed``, what the fixer received.
        fixed_before, raw_before: Those of the frame before each.

    Returns:
        ``(T, 6)`` float32: lowest and highest value, NaN where one is anywhere in the frame, the
        share of values beyond `LIMIT`, the brightest value of the image and of the render, and 1
        where the image is that of the frame before although the render moved.
    """
    values = video.flatten(1)
    counts = [torch.count_nonzero(frame.abs() > LIMIT) for frame in values]
    columns = [
        values.amin(1),
        values.amax(1),
        torch.stack(counts) / values.shape[1],
        fixed.flatten(1).amax(1),
        raw.flatten(1).amax(1),
        _frozen(fixed, raw, fixed_before, raw_before),
    ]
    return torch.stack([column.float() for column in columns], dim=1)


def _frozen(fixed: Tensor, raw: Tensor, fixed_before: Tensor, raw_before: Tensor) -> Tensor:
    """Return whether each output repeats the one before bit for bit although the raw frame
    changed.
    """
    repeated = (fixed == fixed_before).flatten(1).all(1)
    if known_false(repeated):
        return repeated
    moved = (raw.float() - raw_before.float()).abs_().flatten(1).mean(1)
    return repeated & (moved > MOVED)


def failures(measured: F32) -> list[str]:
    """Return the failure of frames as `measures` gave them, "" where a frame is fine."""
    events = []
    for low, high, beyond, brightest, brightest_raw, frozen in measured:
        if not (np.isfinite(low) and np.isfinite(high)):
            events.append(NAN)
        elif beyond > SHARE:
            events.append(RANGE)
        elif brightest <= BLACK_MAX < brightest_raw:
            events.append(BLACK)
        else:
            events.append(FROZEN if frozen else "")
    return events


def render_events(measured: F32) -> tuple[str, ...]:
    """Return what is wrong with a render, as `measures` gave its frame."""
    return (RENDER_BLACK,) if measured[4] <= BLACK_MAX else ()


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
    if known_false(change > LARGE[0]):
        return None
    trusted = _ramp(_cells(opacity), *OPAQUE) * _ramp(change, *LARGE)
    mapped = F.max_pool2d((_cells(sdmap).mean(1, keepdim=True) + 1) / 2, AROUND, 1, REACH) > MAPPED
    now = _cells(out)
    past = _cells(before)
    low = -F.max_pool2d(-past, AROUND, 1, REACH)
    high = F.max_pool2d(past, AROUND, 1, REACH)
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
