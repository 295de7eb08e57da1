"""The interval of a mean difference over scenes, and what a claim about it states.

A claim about a distance is about the mean of the scenes' differences *cut* at the metric's cap: no
sample bounds what is not cut, and nothing is assumed about what lies beyond. How often a scene goes
beyond is an event of its own with an exact rate, and with a margin of its own where a gate has one
(`left_route` of `lateral_distance_m`).
"""

from __future__ import annotations

import math

import numpy as np

from alpasim_plugin.core.types import F64, I64, Direction, MetricInfo
from evaluators.results import Beyond
from evaluators.statistics.bounded import mean_bounds
from evaluators.statistics.intervals import (
    FEW_SCENES,
    LEAST_SCENES,
    Interval,
    are_alike,
    cluster_means,
    paired_rate,
    rate_at_most,
    t_interval,
)

# margins: a scene's difference in a quantity without bounds or a cap of its own counts up to so much
REACH = 40.0
NO_CLAIM = "nothing says how much a scene that was not driven can differ"
WORSE: dict[Direction, str] = {"lower": "worse", "higher": "worse", "none": "different"}


def reach_of(metric: MetricInfo, margin: float) -> float:
    """Return at what a scene's difference is cut, in the metric's unit; 0 where nothing says so.

    Where differences have no bounds it is the metric's cap, else `REACH` times its own margin, or
    the given one where it has none.
    """
    most = max(metric.difference_range)
    if math.isfinite(most):
        return float(most)
    return REACH * (metric.accepted or margin) if metric.cap is None else metric.cap


def is_cut(metric: MetricInfo) -> bool:
    """Tell whether a claim about a metric is about its differences cut at `reach_of`: others have
    bounds and are never cut.
    """
    return not math.isfinite(max(metric.difference_range))


def claim_of(metric: MetricInfo, margin: float) -> str | None:
    """Return what a claim about a metric is about, in words; None where none can be made.

    Example:
        >>> from evaluators.metrics import METRICS
        >>> claim_of(METRICS.info("lateral_distance_m"), 0.1)
        'mean cut at 4 m'
        >>> claim_of(METRICS.info("offroad"), 0.05)
        'mean'
    """
    reach = reach_of(metric, margin)
    if reach == 0.0:
        return None
    return f"mean cut at {reach:g} {metric.unit}".rstrip() if is_cut(metric) else "mean"


def beyond_words(metric: MetricInfo, margin: float) -> str:
    """Name the event that a scene's difference is worse than the cut of a claim.

    Example:
        >>> from evaluators.metrics import METRICS
        >>> beyond_words(METRICS.info("lateral_distance_m"), 0.1)
        'worse by more than 4 m'
    """
    reach = reach_of(metric, margin)
    return f"{WORSE[metric.direction]} by more than {reach:g} {metric.unit}".rstrip()


def beyond_of(means: F64, metric: MetricInfo, margin: float) -> Beyond | None:
    """Count the scenes ``(G,)`` whose difference is worse than the cut of a claim, with the exact
    bound of their rate; None where no difference is cut.
    """
    reach = reach_of(metric, margin)
    if reach == 0.0 or not is_cut(metric):
        return None
    harms = {"none": np.abs(means), "lower": means, "higher": -means}[metric.direction]
    n = int(np.sum(harms > reach))
    event = beyond_words(metric, margin)
    return Beyond(event, n, len(means), rate_at_most(n, len(means)))


def difference_bounds(
    delta: F64, means: F64, scenes: I64, metric: MetricInfo, margin: float
) -> tuple[Interval, list[float] | None]:
    """Return the interval of a mean difference, and the bounds of the claim about other scenes; None
    where nothing says how much a scene can differ, and then the interval has no bounds either.

    The claim's bounds are those of `evaluators.statistics.bounded` for differences cut at
    `reach_of`: they allow for scenes at the worst possible value that were not drawn. Rates print
    the interval of `flag_interval`. Where differences are cut, the printed interval also holds that
    of t and the mean of these scenes, which are not cut.

    Args:
        delta: ``(N,)`` differences per cell.
        means: ``(G,)`` their means per scene, at least two.
        scenes: Scene of each cell.
        metric: What it is.
        margin: How much worse is accepted.
    """
    n = len(means)
    reach = reach_of(metric, margin)
    if metric.is_flag:
        return flag_interval(delta, scenes), list(mean_bounds(means, -reach, reach))
    plain = t_interval(means, "scenes")
    if reach == 0.0:
        return Interval(plain.centre, reason=NO_CLAIM), None
    low, high = mean_bounds(means, -reach, reach)
    guarded = [low, high]
    method = f"mean of scenes that differ by at most {reach:g} {metric.unit}".rstrip()
    if is_cut(metric):
        not_cut = [plain.centre, *(plain.bounds or [])]
        low = min(low, *not_cut)
        high = max(high, *not_cut)
        method = f"{claim_of(metric, margin)}, joined with t"
    note = ""
    if are_alike(means):
        note = f"all {n} scenes are equal, so that they have no spread to go by"
    return Interval(plain.centre, low, high, note=note, method=method), guarded


def flag_interval(delta: F64, scenes: I64) -> Interval:
    """Return the interval of a difference of rates from ``(N,)`` differences per cell, in [-1, 1],
    and their scenes; never without width.

    The rates of cells that gained and that lost the event get their own intervals (`mean_bounds`),
    which are joined by the method of variance estimates recovery (Zou and Donner, Statistics in
    Medicine 27, 2008), with the correlation of both: a cell that gained the event has not lost it,
    so that their difference varies more than if they were independent. Below `FEW_SCENES` scenes it
    is Tango's interval, with scenes as pairs.
    """
    gained, _ = cluster_means(np.maximum(delta, 0.0), scenes)
    lost, _ = cluster_means(np.maximum(-delta, 0.0), scenes)
    n = len(gained)
    up = float(np.mean(gained))
    down = float(np.mean(lost))
    changed = int(np.sum((gained > 0) | (lost > 0)))
    note = f"{changed} of {n} scenes changed" if changed < LEAST_SCENES else ""
    if n < FEW_SCENES:
        bounds = paired_rate(n * up, n * down, n)
        return Interval(up - down, *bounds, note=note, method="Tango, scenes as pairs")
    (up_low, up_high), (down_low, down_high) = (
        mean_bounds(rates, 0.0, 1.0) for rates in (gained, lost)
    )
    correlation = _correlation(gained, lost)
    low = up - down - _joined(up - up_low, down_high - down, correlation)
    high = up - down + _joined(up_high - up, down - down_low, correlation)
    method = "gained and lost rates joined"
    return Interval(up - down, max(low, -1.0), min(high, 1.0), note=note, method=method)


def _joined(gained_half: float, lost_half: float, correlation: float) -> float:
    """Return the half-width of a difference from those of its parts and their correlation."""
    product = 2.0 * correlation * gained_half * lost_half
    return math.sqrt(gained_half**2 + lost_half**2 - product)


def _correlation(gained: F64, lost: F64) -> float:
    """Return the correlation of two rates over scenes, none above 0: scenes that both gain and lose
    would narrow the interval, and a few of them show too little for that.
    """
    spread = float(np.std(gained) * np.std(lost))
    if spread == 0.0:
        return 0.0
    return min(float(np.mean((gained - gained.mean()) * (lost - lost.mean()))) / spread, 0.0)
