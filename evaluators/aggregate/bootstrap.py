"""Cluster bootstrap: scenes are drawn with replacement, each with all its seeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from alpasim_plugin.types import F64, I64
from evaluators.aggregate.intervals import TAIL, Interval, cluster_means

DRAWS = 2000
BLOCK = 4_000_000  # drawn scenes held in memory at once


def cluster_bootstrap(values: npt.ArrayLike, clusters: Sequence[str] | I64, generator: np.random.Generator, draws: int = DRAWS) -> Interval:
    """Return the percentile interval of the mean over scenes.

    Too short where scenes are few (docs/experiments/interval-coverage.md); it is a second opinion that assumes no shape, not the default.

    Args:
        values: ``(N,)``.
        clusters: Scene of each value.
        generator: Where the draws come from.
        draws: How many.

    Example:
        >>> g = np.random.Generator(np.random.Philox(1))
        >>> one = cluster_bootstrap([0.0, 1.0, 2.0, 3.0], ["a", "b", "c", "d"], g)
        >>> 0.0 <= one.low < 1.5 < one.high <= 3.0
        True
    """
    means, _ = cluster_means(values, clusters)
    centre = float(np.mean(means))
    if len(means) < 2:
        return Interval(centre, reason=f"needs at least two scenes, found {len(means)}")
    low, high = np.quantile(resampled_means(means, generator, draws), [TAIL, 1 - TAIL])
    note = f"all {len(means)} scenes are equal: the interval has no width" if low == high else ""
    return Interval(centre, float(low), float(high), note=note, method=f"cluster bootstrap, {draws} draws")


def resampled_means(means: F64, generator: np.random.Generator, draws: int = DRAWS) -> F64:
    """Return the mean ``(draws,)`` of each draw of G scenes out of ``(G,)``."""
    rows = max(1, BLOCK // len(means))
    parts = [
        means[generator.integers(0, len(means), size=(min(rows, draws - start), len(means)))].mean(axis=1)
        for start in range(0, draws, rows)
    ]
    return np.concatenate(parts)
