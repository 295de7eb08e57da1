"""Cluster bootstrap: scenes are drawn with replacement, each with all its seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64, I64
from evaluators.aggregate.intervals import TAIL, Interval, cluster_means

DRAWS = 2000
BLOCK = 4_000_000  # drawn scenes held in memory at once


def redraws(scenes: int, generator: np.random.Generator, draws: int = DRAWS) -> I64:
    """Return draws ``(draws, scenes)`` of as many scenes as there are, with replacement, by number."""
    return generator.integers(0, scenes, size=(draws, scenes))


def cluster_bootstrap(values: npt.ArrayLike, clusters: Sequence[str] | I64, drawn: Callable[[int], I64]) -> Interval:
    """Return the percentile interval of the mean over scenes.

    Too short where scenes are few (docs/experiments/interval-coverage.md); it is a second opinion that assumes no shape, not the default.

    Args:
        values: ``(N,)``.
        clusters: Scene of each value.
        drawn: Gives the draws of a number of scenes, as `redraws` does; of at least two.

    Example:
        >>> g = np.random.Generator(np.random.Philox(1))
        >>> one = cluster_bootstrap([0.0, 1.0, 2.0, 3.0], ["a", "b", "c", "d"], lambda scenes: redraws(scenes, g))
        >>> 0.0 <= one.low < 1.5 < one.high <= 3.0
        True
    """
    means, _ = cluster_means(values, clusters)
    centre = float(np.mean(means))
    if len(means) < 2:
        return Interval(centre, reason=f"needs at least two scenes, found {len(means)}")
    places = drawn(len(means))
    low, high = np.quantile(means.take(places).mean(axis=1), [TAIL, 1 - TAIL])
    note = f"all {len(means)} scenes are equal: the interval has no width" if low == high else ""
    return Interval(centre, float(low), float(high), note=note, method=f"cluster bootstrap, {len(places)} draws")


def resampled_means(means: F64, generator: np.random.Generator, draws: int = DRAWS) -> F64:
    """Return the mean ``(draws,)`` of each draw of G scenes out of ``(G,)``."""
    rows = max(1, BLOCK // len(means))
    parts = [means.take(redraws(len(means), generator, min(rows, draws - start))).mean(axis=1) for start in range(0, draws, rows)]
    return np.concatenate(parts)
