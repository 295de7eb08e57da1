"""Scene differences in the order in which they were drawn, and what their conditional mean is under a hypothesis."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from alpasim_plugin.core.types import F64, I64, Bool


@dataclass(frozen=True)
class Draws:
    """Values of scenes in the order drawn, with the line on which their conditional mean lies.

    If the mean that is asked for is m, the expected value of scene i given all scenes before it is ``offset[i] + slope[i] * m``. For scenes
    that are independent draws from a population this is m; `without_replacement` gives it for a finite suite.

    Scenes are drawn in batches: what is known before a scene is drawn is known before its batch. A batch is one scene, but where its
    scenes depend on each other (`strata.py`); then something can be said at the ends of batches only, and n is one.

    Attributes:
        x: ``(..., n)`` differences, positive is worse.
        low: ``(..., n)`` least possible value of each, known before it is drawn; -inf where there is no bound.
        high: ``(..., n)`` greatest possible value.
        offset: ``(..., n)`` known before the scene is drawn.
        slope: ``(..., n)`` above 0, known before the scene is drawn.
        begin: ``(n,)`` index of the first scene of each scene's batch.
        spread: ``(..., n)`` standard deviation of a scene, such that its square times n is the variance of the sum of the first n, as
            estimated from them.
        freedom: ``(n,)`` degrees of freedom of ``spread``.
    """

    x: F64
    low: F64
    high: F64
    offset: F64
    slope: F64
    begin: I64
    spread: F64
    freedom: F64

    @property
    def n(self) -> int:
        """Give the number of scenes."""
        return int(self.x.shape[-1])

    @property
    def is_end(self) -> Bool:
        """Tell which scenes are the last of their batch ``(n,)``."""
        return np.append(self.begin[1:], self.n) > np.arange(self.n)

    def mirrored(self) -> Draws:
        """Return the draws of the negated difference."""
        return replace(self, x=-self.x, low=-self.high, high=-self.low, offset=-self.offset)

    def first(self, n: int) -> Draws:
        """Return the first n scenes, which end with a batch."""
        return Draws(**{field.name: getattr(self, field.name)[..., :n] for field in fields(self)})


def independent(x: F64, low: float, high: float) -> Draws:
    """Return draws from a population of scenes: each has the mean that is asked for, whatever came before.

    Args:
        x: ``(..., n)`` differences.
        low: Least possible difference.
        high: Greatest possible difference.
    """
    x = np.asarray(x, dtype=np.float64)
    n = np.arange(x.shape[-1])
    return Draws(
        x, np.full_like(x, low), np.full_like(x, high), np.zeros_like(x), np.ones_like(x), n, sample_spread(x), n.astype(np.float64)
    )


def without_replacement(
    x: F64, low: float, high: float, size: int, removed: F64 | None = None, reach: F64 | None = None, begin: I64 | None = None
) -> Draws:
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
        begin: ``(n,)`` as in `Draws`; None: every scene is a batch.
    """
    x = np.asarray(x, dtype=np.float64)
    off = np.zeros_like(x) if removed is None else removed
    wide = np.zeros_like(x) if reach is None else reach
    n = np.arange(x.shape[-1])
    batch = n if begin is None else begin
    left = (size - batch).astype(np.float64)
    before = (np.cumsum(x, axis=-1) - x)[..., batch]
    slope = np.broadcast_to(size / left, x.shape)
    rest = x - off
    return Draws(rest, low - wide, high + wide, -before / left, np.asarray(slope), batch, sample_spread(rest), n.astype(np.float64))


def sample_spread(x: F64) -> F64:
    """Return the sample standard deviation ``(..., n)`` of the first 1, 2, ... n values."""
    n = np.arange(1, x.shape[-1] + 1)
    # About the first value: sums of squares of large values that hardly differ would lose all digits.
    x = x - x[..., :1]
    square = np.cumsum(x * x, axis=-1) - np.cumsum(x, axis=-1) ** 2 / n
    return np.asarray(np.sqrt(np.maximum(square, 0.0) / np.maximum(n - 1, 1)))
