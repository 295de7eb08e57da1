"""The harmlessness guard of the generator in pixels: where its change is not believable, the render is kept.

A change is believable where the render is transparent, where it is small, where the map shows something (a lane line, a road user), or
where the last output already showed nearby what the generator draws now. Elsewhere an opaque render is better evidence than a guess.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

CELL = 8  # pixels of the side of a cell; changes are judged by cells
REACH = 2  # cells around, where the map or the last output may support a change
OPAQUE = (0.9, 0.98)  # opacity of a cell: below the first the generator is free, above the second the render is fully trusted
LARGE = (0.3, 0.5)  # mean change of a cell, of a range of 2: below the first it is never touched, above the second not believed
MAPPED = 0.02  # share of a cell's range that drawn map covers


def render_share(out: Tensor, render: Tensor, opacity: Tensor, sdmap: Tensor, before: Tensor) -> Tensor | None:
    """Return the weight of the render in the picture; None where it is 0 everywhere.

    Args:
        out: ``(B, H, W, 3)`` generated frame.
        render: Like ``out``.
        opacity: ``(B, H, W, 1)``.
        sdmap: Like ``out``; black where it shows nothing.
        before: The last output, like ``out``.

    Returns:
        ``(B, H, W, 1)``, 0 nearly everywhere.
    """
    change = _cells((out - render).abs_()).mean(1, keepdim=True)
    if float(change.amax()) <= LARGE[0]:
        return None
    trusted = _ramp(_cells(opacity), *OPAQUE) * _ramp(change, *LARGE)
    if not trusted.any():
        return None
    mapped = F.max_pool2d((_cells(sdmap).mean(1, keepdim=True) + 1) / 2, 2 * REACH + 1, 1, REACH) > MAPPED
    now, past = _cells(out), _cells(before)
    low, high = (-F.max_pool2d(-past, 2 * REACH + 1, 1, REACH), F.max_pool2d(past, 2 * REACH + 1, 1, REACH))
    beyond = torch.relu(now - high).amax(1, keepdim=True) + torch.relu(low - now).amax(1, keepdim=True)
    unseen = _ramp(beyond, *(limit / 2 for limit in LARGE))
    share = trusted * unseen * ~mapped
    return F.interpolate(share, scale_factor=CELL, mode="bilinear", align_corners=False).permute(0, 2, 3, 1)


def _cells(x: Tensor) -> Tensor:
    """Average ``(B, H, W, C)`` over cells: ``(B, C, H / 8, W / 8)``."""
    b, h, w, c = x.shape  # rows first, whose values lie in runs: torch pools few channels slowly
    rows = x.reshape(b, h // CELL, CELL, w * c).mean(2)
    return rows.view(b, h // CELL, w // CELL, CELL, c).mean(3).permute(0, 3, 1, 2)


def _ramp(x: Tensor, low: float, high: float) -> Tensor:
    return ((x - low) / (high - low)).clamp(0, 1)
