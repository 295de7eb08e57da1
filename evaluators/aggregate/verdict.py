"""The three-way verdict on a paired difference: non-inferior, worse or undecided, with a stated margin."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy  # its submodules load on first use; scipy.stats would take a second

from alpasim_plugin.core.types import F64, Direction

Verdict = Literal["non-inferior", "worse", "undecided"]
Difference = Literal["better", "worse", "none shown"]

ALPHA = 0.05
ROUNDING = 1e-12  # differences that vary by no more than this, relative, are equal


def harm(bounds: list[float], direction: Direction) -> tuple[float, float]:
    """Turn the bounds of a difference so that positive means worse."""
    return (bounds[0], bounds[1]) if direction == "lower" else (-bounds[1], -bounds[0])


def verdict(bounds: list[float] | None, p: float | None, margin: float, direction: Direction) -> Verdict:
    """Judge a difference by its 95 % interval.

    Non-inferior: the whole interval is better than ``margin`` worse. Worse: the whole interval is more than ``margin`` worse, and the test
    of no difference rejects too (p < 0.05). Undecided: neither. So each of the two claims is wrong in at most 2.5 % of runs, and more data
    decides. A metric without a better side needs a margin, and a change to either side counts as worse (wrong in at most 5 %).

    Args:
        bounds: [low, high] of renderer minus baseline, or None.
        p: Of the test of no difference; None where there is none.
        margin: How much worse is accepted, in the metric's unit, at least 0.
        direction: The better side of the metric.
    """
    if bounds is None or (direction == "none" and margin == 0.0):
        return "undecided"
    low, high = harm(bounds, direction)
    if direction == "none":
        low, high = _distance_from_zero(low, high)
    if high < margin or (margin == 0.0 and high == low == 0.0):
        return "non-inferior"
    return "worse" if low > margin and p is not None and p < ALPHA else "undecided"


def _distance_from_zero(low: float, high: float) -> tuple[float, float]:
    """Return the least and greatest absolute value within bounds."""
    return (0.0 if low <= 0.0 <= high else min(abs(low), abs(high))), max(abs(low), abs(high))


def difference(bounds: list[float] | None, p: float | None, direction: Direction) -> Difference:
    """Return whether a difference is shown, independent of the margin: the interval excludes 0 and the test rejects."""
    if bounds is None or direction == "none" or p is None or p >= ALPHA or bounds[0] <= 0.0 <= bounds[1]:
        return "none shown"
    return "worse" if harm(bounds, direction)[0] > 0.0 else "better"


def sign_test(up: int, down: int) -> float:
    """Return the exact two-sided p of ``up`` against ``down`` under a fair coin; 1 where both are 0.

    On scenes that changed it is the sign test; on discordant cells of a flag it is the exact McNemar test.

    Example:
        >>> round(sign_test(6, 0), 5)
        0.03125
    """
    return min(1.0, 2.0 * float(scipy.special.bdtr(min(up, down), up + down, 0.5)))


def p_value(means: F64, is_flag: bool) -> tuple[float, str]:
    """Test that scene differences ``(G,)`` centre on zero.

    Flags, and differences that are all alike (where t has no spread to go by), take the exact two-sided sign test on the scenes that
    changed; other metrics the paired t test.
    """
    alike = float(np.ptp(means)) <= ROUNDING * float(np.max(np.abs(means)))
    if is_flag or alike:
        return sign_test(int(np.sum(means > 0)), int(np.sum(means < 0))), "exact sign test on scenes"
    t = float(np.mean(means) / (np.std(means, ddof=1) / np.sqrt(len(means))))
    return 2.0 * float(scipy.special.stdtr(len(means) - 1, -abs(t))), "paired t test on scene means"
