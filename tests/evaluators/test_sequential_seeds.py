"""Seeds of the next scenes by cost against variance, and paired differences scene by scene."""

from __future__ import annotations

import math

import numpy as np
import pytest

from alpasim_plugin.log.run_folder.sides import by_renderer
from evaluators.statistics.sequential.differences import (
    SceneDifferences,
    best_seeds,
    next_seeds,
    scarce_seeds,
    scene_differences,
    variances,
)


@pytest.mark.parametrize("ratio", [0.1, 1.0, 4.0, 30.0])
@pytest.mark.parametrize("cost", [0.5, 2.0, 8.0])
def test_the_best_seeds_cost_least_for_the_same_variance(ratio, cost):
    def price(m: int) -> float:
        return (1.0 + ratio / m) * (cost + m)  # scenes needed times cost of each

    chosen = best_seeds(1.0, ratio, cost, 40)
    least = min(price(m) for m in range(1, 41))
    assert price(chosen) <= 1.03 * least  # the root is rounded


def test_seeds_that_do_not_differ_or_scenes_that_cost_nothing_take_one_seed():
    assert best_seeds(1.0, 0.0, 5.0, 9) == best_seeds(1.0, 3.0, 0.0, 9) == 1
    assert best_seeds(0.0, 3.0, 5.0, 9) == 9


def test_where_scenes_are_scarce_more_seeds_are_driven():
    bar = -math.log(0.05)
    assert scarce_seeds(0.1, 1.0, 0.5, bar, 1000, 5) == 1
    assert scarce_seeds(0.1, 1.0, 0.5, bar, 10, 5) == 4
    assert scarce_seeds(1.0, 1.0, 0.1, bar, 10, 5) == 5


def test_variances_are_recovered_from_nested_draws():
    generator = np.random.Generator(np.random.Philox(1))
    values = generator.normal(0.0, 1.0, (4000, 1)) + generator.normal(0.0, 2.0, (4000, 3))
    found = variances(
        SceneDifferences(values.mean(axis=1), values.var(axis=1, ddof=1), np.full(4000, 3.0), 0)
    )
    assert found == pytest.approx((1.0, 4.0), rel=0.15)


def test_the_first_scenes_are_a_pilot_with_two_seeds():
    nothing = SceneDifferences(np.empty(0), np.empty(0), np.empty(0), 0)
    assert next_seeds(nothing, 0.1, 3.0, 2.0, 50, 5) == 2
    assert next_seeds(nothing, 0.1, 3.0, 2.0, 50, 1) == 1


def row(renderer: str, scene: str, seed: int, value: float | None) -> dict:
    return {
        "renderer": renderer,
        "policy": "p",
        "scene": scene,
        "seed": seed,
        "status": "ok",
        "progress": value,
        "progress_valid": value is not None,
    }


def test_scenes_come_in_their_order_and_one_that_lacks_a_pair_has_no_difference():
    rows = [
        row("a", "x", 0, 0.5),
        row("a", "x", 1, 0.7),
        row("b", "x", 0, 0.4),
        row("b", "x", 1, 0.2),
    ]
    rows += [
        row("a", "y", 0, 0.5),
        row("b", "y", 0, 0.6),
        row("a", "z", 0, None),
        row("b", "z", 0, 0.1),
    ]
    sides = by_renderer(rows)
    found = scene_differences(sides["b"], sides["a"], "progress", ["z", "y", "x"])
    assert found.diff == pytest.approx([np.nan, 0.1, -0.3], nan_ok=True)
    assert found.harm("higher") == pytest.approx([np.nan, -0.1, 0.3], nan_ok=True)
    assert found.pairs.tolist() == [1, 1, 2]
    assert found.missing == 1
    assert found.within[2] == pytest.approx(0.08)
