"""Two guards. Every fixed frame is checked, and a broken one is replaced by the raw frame, with an
event that names the failure.

The harmlessness guard of the generator in pixels keeps the render where a change is not believable.
A change is believable where the render is transparent, where it is small, where the map shows
something (a lane line, a road user), or where the last output already showed nearby what the
generator draws now. Elsewhere an opaque render is better evidence than a guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.image_metrics import is_black
from alpasim_plugin.core.types import F32, U8

Ramped = TypeVar("Ramped", Tensor, F32)
NAN = "fixer-nan"
RANGE = "fixer-range"
BLACK = "fixer-black"
FROZEN = "fixer-frozen"
LIMIT = 1.5  # a quarter of the range from black to white beyond either end
SHARE = 0.01  # of a frame's values may lie beyond the limit; decoders overshoot at a few edges
# grey levels of mean change in the raw frames above which an unchanged output counts as frozen
MOVED = 0.5
CELL = 8  # pixels of the side of a cell; changes are judged by cells
REACH = 2  # cells around, where the map or the last output may support a change
OPAQUE = (
    0.9,
    0.98,
)  # opacity of a cell: below the first the generator is free, above the second the render is fully trusted
LARGE = (
    0.3,
    0.5,
)  # mean change of a cell, of a range of 2: below the first it is never touched, above the second not believed
AROUND = 2 * REACH + 1
MAPPED = 0.02  # share of a cell's range that drawn map covers


def failures(video: Tensor) -> list[str]:
    """Check a view's decoded frames before they are clipped.

    Args:
        video: ``(3, T, H, W)``, meant to lie in [-1, 1].

    Returns:
        T events, "" where a frame is fine.
    """
    low, high = (
        x.float() for x in (video.amin((0, 2, 3)), video.amax((0, 2, 3)))
    )  # NaN anywhere in a frame is the result
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
    """Return whether an output repeats the previous one bit for bit although the raw frame
    changed.
    """
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


def keep_render(
    out: Tensor, render: Tensor, opacity: Tensor, sdmap: Tensor, before: Tensor, recorded: Tensor
) -> Tensor | None:
    """Put the render back where the change is not believable; None where nothing is put back.

    Args:
        out: ``(B, H, W, 3)`` generated frame, in the range from -1 to 1 or a little beyond.
        render: Like ``out``.
        opacity: ``(B, H, W, 1)``.
        sdmap: Like ``out``; black where it shows nothing.
        before: The last output, like ``out``.
        recorded: ``(B, H, W, 1)`` share of the references, which are evidence of their own: what
            they show stays.
    """
    if out.device.type == "cpu":
        kept = [
            _keep_one(*images)
            for images in zip(
                *(x.numpy() for x in (out, render, opacity, sdmap, before, recorded)), strict=True
            )
        ]
        return (
            None
            if all(one is None for one in kept)
            else torch.stack([o if k is None else k for o, k in zip(out, kept, strict=True)])
        )
    share = render_share(out, render, opacity, sdmap, before)
    return None if share is None else torch.lerp(out, render, share * (1 - recorded))


def render_share(
    out: Tensor, render: Tensor, opacity: Tensor, sdmap: Tensor, before: Tensor
) -> Tensor | None:
    """Return the weight of the render in the picture ``(B, H, W, 1)``, 0 nearly everywhere; None
    where it is 0 everywhere.

    It is what `keep_render` does on other devices than processors, and the reference of what it
    does there; arguments as there.
    """
    change = _cells((out - render).abs_()).mean(1, keepdim=True)
    if float(change.amax()) <= LARGE[0]:
        return None
    trusted = _ramp(_cells(opacity), *OPAQUE) * _ramp(change, *LARGE)
    if not trusted.any():
        return None
    mapped = F.max_pool2d((_cells(sdmap).mean(1, keepdim=True) + 1) / 2, AROUND, 1, REACH) > MAPPED
    now, past = _cells(out), _cells(before)
    low, high = -F.max_pool2d(-past, AROUND, 1, REACH), F.max_pool2d(past, AROUND, 1, REACH)
    beyond = torch.relu(now - high).amax(1, keepdim=True) + torch.relu(low - now).amax(
        1, keepdim=True
    )
    unseen = _ramp(beyond, *(limit / 2 for limit in LARGE))
    share = trusted * unseen * ~mapped
    return F.interpolate(share, scale_factor=CELL, mode="bilinear", align_corners=False).permute(
        0, 2, 3, 1
    )


def _cells(x: Tensor) -> Tensor:
    """Average ``(B, H, W, C)`` over cells: ``(B, C, H / 8, W / 8)``."""
    b, h, w, c = x.shape  # rows first, whose values lie in runs: torch pools few channels slowly
    rows = x.reshape(b, h // CELL, CELL, w * c).mean(2)
    return rows.view(b, h // CELL, w // CELL, CELL, c).mean(3).permute(0, 3, 1, 2)


def _keep_one(
    out: F32, render: F32, opacity: F32, sdmap: F32, before: F32, recorded: F32
) -> Tensor | None:
    """Do what `keep_render` does for one image, `render_share` by OpenCV, which pools images whose
    channels come last six times as fast.
    """
    height, width, _ = out.shape
    around = np.ones((AROUND, AROUND), np.uint8)

    def means(image: F32) -> F32:
        size = (width // CELL, len(image) // CELL)
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)

    change = means(cv2.absdiff(out, render)).mean(axis=-1)
    if float(change.max()) <= LARGE[0]:
        return None
    share = _ramp(means(opacity), *OPAQUE) * _ramp(change, *LARGE)
    rows = np.flatnonzero(share.any(axis=1))
    if not len(rows):
        return None
    # Only these rows of cells can change, and nothing beyond those in reach of them is looked at.
    first, last = max(rows[0] - REACH, 0), rows[-1] + REACH + 1
    near, pixels = share[first:last], slice(CELL * first, CELL * last)
    near[cv2.dilate((means(sdmap[pixels]).mean(axis=-1) + 1) / 2, around) > MAPPED] = 0
    if not near.any():
        return None
    now, past = means(out[pixels]), means(before[pixels])
    above, below = now - cv2.dilate(past, around), cv2.erode(past, around) - now
    near *= _ramp(
        np.maximum(above.max(axis=-1), 0) + np.maximum(below.max(axis=-1), 0),
        *(limit / 2 for limit in LARGE),
    )
    if not near.any():
        return None
    weight = np.asarray(cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR))[
        pixels, :, None
    ] * (1 - recorded[pixels])
    kept = out.copy()
    kept[pixels] += weight * (render[pixels] - out[pixels])
    return torch.from_numpy(kept)


def _ramp(x: Ramped, low: float, high: float) -> Ramped:
    return ((x - low) / (high - low)).clip(0, 1)
