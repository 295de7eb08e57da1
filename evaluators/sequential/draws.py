"""Scene differences in the order in which they were drawn, and what their conditional mean is under a hypothesis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.types import F64


@dataclass(frozen=True)
class Draws:
    """Values of scenes in the order drawn, with the line on which their conditional mean lies.

    If the mean that is asked for is m, the expected value of scene i given all scenes before it is ``offset[i] + slope[i] * m``. For scenes
    that are independent draws from a population this is m; `without_replacement` gives it for a finite suite.

    Attributes:
        x: ``(..., n)`` differences, positive is worse.
        low: ``(..., n)`` least possible value of each, known before it is drawn; -inf where there is no bound.
        high: ``(..., n)`` greatest possible value.
        offset: ``(..., n)`` known before the scene is drawn.
        slope: ``(..., n)`` above 0, known before the scene is drawn.
    """

    x: F64
    low: F64
    high: F64
    offset: F64
    slope: F64

    @property
    def n(self) -> int:
        """Give the number of scenes."""
        return int(self.x.shape[-1])

    def mirrored(self) -> Draws:
        """Return the draws of the negated difference."""
        return Draws(-self.x, -self.high, -self.low, -self.offset, self.slope)

    def first(self, n: int) -> Draws:
        """Return the first n scenes."""
        return Draws(*(part[..., :n] for part in (self.x, self.low, self.high, self.offset, self.slope)))


def independent(x: F64, low: float, high: float) -> Draws:
    """Return draws from a population of scenes: each has the mean that is asked for, whatever came before.

    Args:
        x: ``(..., n)`` differences.
        low: Least possible difference.
        high: Greatest possible difference.
    """
    x = np.asarray(x, dtype=np.float64)
    return Draws(x, np.full_like(x, low), np.full_like(x, high), np.zeros_like(x), np.ones_like(x))


def without_replacement(x: F64, low: float, high: float, size: int, removed: F64 | None = None, reach: F64 | None = None) -> Draws:
    """Return draws without replacement from a suite, whose own mean is asked for.

    If that mean is m, the scenes that are left before draw i (from 0) have the mean (size m - sum of the drawn) / (size - i)
    (Waudby-Smith and Ramdas, Estimating means of bounded random variables by betting, JRSS B 86, 2024, section 5).

    Args:
        x: ``(..., n)`` differences as driven.
        low: Least possible difference.
        high: Greatest possible difference.
        size: Scenes of the suite.
        removed: ``(..., n)`` what a control predicts of each difference, less its mean over the scenes left; taken off the difference.
        reach: ``(..., n)`` greatest size that ``removed`` could have had for any scene left.
    """
    x = np.asarray(x, dtype=np.float64)
    off = np.zeros_like(x) if removed is None else removed
    wide = np.zeros_like(x) if reach is None else reach
    left = size - np.arange(x.shape[-1], dtype=np.float64)
    before = np.cumsum(x, axis=-1) - x
    slope = np.broadcast_to(size / left, x.shape)
    return Draws(x - off, low - wide, high + wide, -before / left, np.asarray(slope))
