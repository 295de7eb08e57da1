"""Monte-Carlo study of the intervals: coverage and power on synthetic rollouts.

The model: a rollout has the event if scene effect + run noise, both normal, falls below the
threshold that gives the wanted rate. The scene's share of the variance is the within-scene
correlation. Two renderers share 90 % of the scene effect, and the run noise with correlation 0.8
where they meet the same random numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64
from evaluators.statistics.intervals import TAIL, Z95, logit_t_bounds, resampled_means, t_bounds
from evaluators.statistics.paired import flag_bounds

CORRELATIONS = (0.0, 0.3, 0.6, 0.8)  # within a scene, latent
PAPER_SCENES, PAPER_SEEDS = 60, 5
RATES = (0.106, 0.069)
SHARED_SCENE, SHARED_NOISE = 0.9, 0.8

Bounds = tuple[F64, F64]


@dataclass(frozen=True)
class Design:
    """One cell of the grid."""

    n_scenes: int = PAPER_SCENES
    n_seeds: int = PAPER_SEEDS
    rate: float = RATES[0]
    correlation: float = 0.0


def flags(design: Design, repeats: int, generator: np.random.Generator) -> F64:
    """Return outcomes ``(repeats, scenes, seeds)``, 0 or 1, under the probit model."""
    shape = (repeats, design.n_scenes, design.n_seeds)
    latent = _latent(
        generator.standard_normal((*shape[:2], 1)),
        generator.standard_normal(shape),
        design.correlation,
    )
    return np.asarray(latent < stats.norm.ppf(design.rate), dtype=np.float64)


def pairs(
    design: Design,
    other_rate: float,
    shared_noise: float,
    repeats: int,
    generator: np.random.Generator,
) -> tuple[F64, F64]:
    """Return outcomes ``(repeats, scenes, seeds)`` of two renderers with rates ``design.rate`` and
    ``other_rate``.
    """
    shape = (repeats, design.n_scenes, design.n_seeds)
    scenes = _correlated(generator, (*shape[:2], 1), SHARED_SCENE)
    noises = _correlated(generator, shape, shared_noise)
    latents = [
        _latent(scene, noise, design.correlation)
        for scene, noise in zip(scenes, noises, strict=True)
    ]
    first, second = (
        x < stats.norm.ppf(rate) for x, rate in zip(latents, (design.rate, other_rate), strict=True)
    )
    return first.astype(np.float64), second.astype(np.float64)


def naive(values: F64) -> Bounds:
    """Return the paper's bounds ``(repeats,)`` from ``(repeats, scenes, seeds)``."""
    flat = values.reshape(len(values), -1)
    half = Z95 * flat.std(axis=1, ddof=1) / np.sqrt(flat.shape[1])
    centre = flat.mean(axis=1)
    return centre - half, centre + half


def by_scene_t(values: F64) -> Bounds:
    """Return plain t bounds on the scene means."""
    return t_bounds(values.mean(axis=2))


def by_scene(values: F64) -> Bounds:
    """Return the bounds that summary.json gives for a rate."""
    return logit_t_bounds(values.mean(axis=2))


def wilson(values: F64) -> Bounds:
    """Return Wilson bounds as if rollouts were independent."""
    n = values.shape[1] * values.shape[2]
    p = values.mean(axis=(1, 2))
    centre, half = p + Z95**2 / (2 * n), Z95 * np.sqrt(p * (1 - p) / n + Z95**2 / (4 * n * n))
    return (centre - half) / (1 + Z95**2 / n), (centre + half) / (1 + Z95**2 / n)


def bootstrap(values: F64, generator: np.random.Generator, draws: int = 400) -> Bounds:
    """Return percentile bounds of the cluster bootstrap."""
    means = values.mean(axis=2)
    ends = np.array(
        [np.quantile(resampled_means(row, generator, draws), [TAIL, 1 - TAIL]) for row in means]
    )
    return ends[:, 0], ends[:, 1]


def coverage(bounds: Bounds, truth: float) -> float:
    """Return the share of intervals that hold the truth."""
    return float(np.mean((bounds[0] <= truth) & (truth <= bounds[1])))


def power(first: F64, second: F64, is_paired: bool) -> float:
    """Return how often a 95 % interval on the difference leaves out 0, scenes as unit, paired by
    scene or not.
    """
    here, there = first.mean(axis=2), second.mean(axis=2)
    if is_paired:
        low, high = t_bounds(here - there)
    else:
        n = here.shape[1]
        error = np.sqrt((here.var(axis=1, ddof=1) + there.var(axis=1, ddof=1)) / n)
        half = stats.t.ppf(1 - TAIL, 2 * n - 2) * error
        centre = here.mean(axis=1) - there.mean(axis=1)
        low, high = centre - half, centre + half
    return float(np.mean((low > 0) | (high < 0)))


def in_blocks(
    measure: Callable[[int, np.random.Generator], Sequence[float]],
    repeats: int,
    key: str,
    block: int = 2000,
) -> list[float]:
    """Average a measurement over blocks of repeats, each from its own stream, so that memory stays
    small.
    """
    sizes = [min(block, repeats - start) for start in range(0, repeats, block)]
    parts = [measure(size, stream(key, 0, "aggregate/study", i)) for i, size in enumerate(sizes)]
    return [float(v) for v in np.average(np.array(parts), axis=0, weights=sizes)]


def coverage_of(design: Design, repeats: int) -> list[float]:
    """Return the coverage of `naive`, `wilson`, `by_scene_t` and `by_scene` in one cell of the
    grid.
    """

    def measure(n: int, generator: np.random.Generator) -> list[float]:
        values = flags(design, n, generator)
        return [
            coverage(method(values), design.rate)
            for method in (naive, wilson, by_scene_t, by_scene)
        ]

    return in_blocks(measure, repeats, repr(design))


def bootstrap_coverage(design: Design, repeats: int) -> float:
    """Return the coverage of the cluster bootstrap in one cell of the grid."""

    def measure(n: int, generator: np.random.Generator) -> list[float]:
        return [coverage(bootstrap(flags(design, n, generator), generator), design.rate)]

    return in_blocks(measure, repeats, f"bootstrap {design!r}")[0]


def paired_coverage(design: Design, other_rate: float, repeats: int) -> float:
    """Return the coverage of the interval that summary.json gives for a difference of rates."""

    def measure(n: int, generator: np.random.Generator) -> list[float]:
        first, second = pairs(design, other_rate, SHARED_NOISE, n, generator)
        gained, lost = (first > second).mean(axis=2), (second > first).mean(axis=2)
        return [coverage(flag_bounds(gained, lost), design.rate - other_rate)]

    return in_blocks(measure, repeats, f"paired {design!r}")[0]


def power_of(design: Design, other_rate: float, repeats: int) -> list[float]:
    """Return the power unpaired, paired by scene, and paired by scene with shared random
    numbers.
    """

    def measure(n: int, generator: np.random.Generator) -> list[float]:
        alone = pairs(design, other_rate, 0.0, n, generator)
        shared = pairs(design, other_rate, SHARED_NOISE, n, generator)
        return [
            power(*alone, is_paired=False),
            power(*alone, is_paired=True),
            power(*shared, is_paired=True),
        ]

    return in_blocks(measure, repeats, f"power {design!r}")


def _latent(scene: F64, noise: F64, correlation: float) -> F64:
    return np.asarray(np.sqrt(correlation) * scene + np.sqrt(1 - correlation) * noise)


def _correlated(
    generator: np.random.Generator, shape: tuple[int, ...], correlation: float
) -> list[F64]:
    """Return two standard normal arrays with the wanted correlation."""
    common = generator.standard_normal(shape)
    return [
        np.sqrt(correlation) * common + np.sqrt(1 - correlation) * generator.standard_normal(shape)
        for _ in range(2)
    ]
