"""How many scenes decide a verdict: planning from the spread of the scenes' differences."""

from __future__ import annotations

import math

import scipy  # its submodules load on first use; scipy.stats would take a second

from evaluators.aggregate.intervals import TAIL

POWER = 0.8
MOST_SCENES = 100_000  # beyond, this suite cannot decide it
LEAST_DECIDED_FLAGS = 6  # fewer changed scenes cannot reach p < 0.05 in the two-sided sign test


def scenes_needed(distance: float, spread: float, power: float = POWER, tail: float = TAIL) -> int | None:
    """Return the number of scenes at which a 95 % t interval leaves out the margin with probability ``power``.

    N is the least with N >= ((t(0.975, N-1) + t(power, N-1)) spread / distance)^2, the usual sample size of a one-sample t test.

    Args:
        distance: Of the true difference from the margin, in the metric's unit.
        spread: Standard deviation of the difference between scenes (seeds averaged), same unit.
        power: Wanted probability.
        tail: Probability of the interval's one end, 2.5 % for one of 95 %.

    Returns:
        At least 2; None where more than `MOST_SCENES` would be needed, or the difference lies on the margin.

    Example:
        >>> scenes_needed(distance=0.5, spread=1.0)
        34
    """
    if spread == 0.0 and distance != 0.0:
        return 2
    if distance == 0.0 or not math.isfinite(spread / distance):
        return None
    low, high = 2, MOST_SCENES
    if not _decides(high, distance, spread, power, tail):
        return None
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if _decides(middle, distance, spread, power, tail) else (middle + 1, high)
    return low


def scenes_without_event(margin: float) -> int | None:
    """Return how many scenes without a single changed outcome show a rate difference below the margin (exact bound).

    Example:
        >>> scenes_without_event(0.05)
        72
    """
    if margin <= 0.0:
        return None
    if margin >= 1.0:
        return 2
    n = math.log(TAIL) / math.log1p(-margin)
    return max(2, math.ceil(n)) if n <= MOST_SCENES else None


def more_scenes(harm: float, spread: float, n_scenes: int, margin: float, is_flag: bool) -> int | None:
    """Return about how many more scenes would decide an undecided verdict with 80 % probability, if what was seen is true.

    Args:
        harm: The difference seen, positive is worse.
        spread: Standard deviation of the difference between scenes.
        n_scenes: Scenes so far.
        margin: As for the verdict.
        is_flag: The metric is a rate.

    Returns:
        At least 1; None where the difference lies on the margin or more than `MOST_SCENES` would be needed.
    """
    needed = scenes_without_event(margin) if is_flag and spread == 0.0 and harm == 0.0 else scenes_needed(abs(harm - margin), spread)
    if needed is None:
        return None
    if spread == 0.0 and harm > margin:
        needed = max(needed, LEAST_DECIDED_FLAGS)
    return max(1, needed - n_scenes)


def _decides(n: int, distance: float, spread: float, power: float, tail: float) -> bool:
    quantiles = float(scipy.special.stdtrit(n - 1, 1 - tail) + scipy.special.stdtrit(n - 1, power))
    return math.sqrt(n) * abs(distance) >= quantiles * spread
