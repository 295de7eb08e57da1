"""The permutation test by swapping clips: its fast distances against the plain ones, its p-values
against the plain test.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.learned_metrics.frechet import frechet_distance
from alpasim_plugin.lab.learned_metrics.swapping import AS_EXTREME, SubsetDistances, swap_test


def draw(seed: int, n: int, d: int, scale: float = 1.0) -> np.ndarray:
    return scale * np.random.default_rng(seed).normal(size=(n, d))


def plain_test(
    first: list[np.ndarray],
    second: list[np.ndarray],
    truth: list[np.ndarray],
    swaps: int,
    seed: int,
) -> float:
    """The share of all the same draws, with the distance of the joined vectors each time and no
    early end.
    """
    reference = np.concatenate(truth)

    def difference(a: list[np.ndarray], b: list[np.ndarray]) -> float:
        return frechet_distance(np.concatenate(a), reference) - frechet_distance(
            np.concatenate(b), reference
        )

    measured = abs(difference(first, second))
    rng = stream("judges", seed, "frechet.swap")
    extreme = 0
    for _ in range(swaps):
        swapped = rng.random(len(first)) < 0.5
        a = [y if s else x for x, y, s in zip(first, second, swapped, strict=True)]
        b = [x if s else y for x, y, s in zip(first, second, swapped, strict=True)]
        extreme += abs(difference(a, b)) >= measured - 1e-9
    return (extreme + 1) / (swaps + 1)


def hard_clips(kind: str) -> tuple[list[np.ndarray], np.ndarray]:
    """Eight clips of one kind and a reference."""
    if kind == "fewer vectors than dimensions":
        return [draw(i, 3, 40) for i in range(8)], draw(9, 12, 40)
    if kind == "more vectors than dimensions":
        return [draw(i, 9, 5) for i in range(8)], draw(9, 36, 5)
    if kind == "clips of several lengths":
        return [draw(i, 2 + i, 6, 1 + i / 4) for i in range(8)], draw(9, 30, 6)
    if kind == "far from the origin":
        return [draw(i, 6, 8) + 1e4 for i in range(8)], draw(9, 24, 8) + 1e4
    if kind == "singular covariances":
        flat = draw(20, 2, 12)
        return [draw(i, 6, 2) @ flat for i in range(8)], draw(9, 24, 2) @ flat
    if kind == "a constant clip":
        return [np.ones((6, 4)), *(draw(i, 6, 4) for i in range(7))], draw(9, 24, 4)
    if kind == "one vector a clip":
        return [draw(i, 1, 4) for i in range(8)], draw(9, 4, 4)
    assert kind == "scales apart by a thousand million"
    return [draw(i, 6, 5) * 10.0 ** -np.arange(0, 10, 2) for i in range(8)], draw(
        9, 24, 5
    ) * 10.0 ** -np.arange(0, 10, 2)


KINDS = (
    "fewer vectors than dimensions",
    "more vectors than dimensions",
    "clips of several lengths",
    "far from the origin",
    "singular covariances",
    "a constant clip",
    "one vector a clip",
    "scales apart by a thousand million",
)


@pytest.mark.parametrize("kind", KINDS)
def test_distances_of_selections_are_those_of_the_joined_vectors(kind: str) -> None:
    clips, reference = hard_clips(kind)
    distances = SubsetDistances(clips, reference)
    for chosen in ([0, 1, 2, 3], [4, 5, 6, 7], [0, 5, 2, 7]):
        plain = frechet_distance(np.concatenate([clips[c] for c in chosen]), reference)
        assert distances(np.array(chosen)) == pytest.approx(plain, abs=distances.rounding)


def test_a_selection_equal_to_the_reference_is_at_zero() -> None:
    clips = [draw(i, 5, 30) for i in range(4)]
    distances = SubsetDistances([*clips, *(x + 1 for x in clips)], np.concatenate(clips))
    assert distances(np.arange(4)) == pytest.approx(0.0, abs=distances.rounding)
    assert distances(np.arange(4) + 4) == pytest.approx(30.0, abs=distances.rounding)


@pytest.mark.parametrize("d", [3, 40])
@pytest.mark.parametrize("shift", [0.15, 0.4, 0.8])
def test_p_values_are_those_of_the_plain_test(d: int, shift: float) -> None:
    truth = [draw(i, 4, d) for i in range(10)]
    first = [x + 0.1 * draw(100 + i, 4, d) for i, x in enumerate(truth)]
    second = [x + 0.2 * draw(200 + i, 4, d) + shift * (i % 3 == 0) for i, x in enumerate(truth)]
    found = swap_test(first, second, truth, swaps=200, seed=3)
    if found.swaps == 200:
        assert found.p_value == pytest.approx(plain_test(first, second, truth, 200, 3))
    else:
        plain = plain_test(first, second, truth, found.swaps, 3)
        assert found.p_value == pytest.approx(AS_EXTREME / found.swaps)
        assert plain == pytest.approx((AS_EXTREME + 1) / (found.swaps + 1))


@pytest.mark.parametrize("d", [2, 30])
@pytest.mark.parametrize("shift", [0.0, 0.3, 1.0])
def test_few_clips_are_swapped_in_every_way(d: int, shift: float) -> None:
    truth = [draw(i, 3, d) for i in range(5)]
    first = [x + 0.1 * draw(100 + i, 3, d) for i, x in enumerate(truth)]
    second = [x + 0.1 * draw(200 + i, 3, d) + shift for i, x in enumerate(truth)]
    reference, differences = np.concatenate(truth), []
    for swapped in product((False, True), repeat=5):
        sides = [
            [
                pair[side ^ s]
                for pair, s in zip(zip(first, second, strict=True), swapped, strict=True)
            ]
            for side in (0, 1)
        ]
        differences.append(
            abs(
                frechet_distance(np.concatenate(sides[0]), reference)
                - frechet_distance(np.concatenate(sides[1]), reference)
            )
        )
    found = swap_test(first, second, truth, swaps=16)
    assert found.swaps == 16
    assert found.p_value == pytest.approx(np.mean(np.array(differences) >= differences[0] - 1e-9))
    assert found == swap_test(first, second, truth, swaps=500, seed=9), "nothing is drawn"
    assert swap_test(second, first, truth).p_value == found.p_value


def test_swapping_clips_finds_a_difference_that_is_there_and_none_that_is_not() -> None:
    truth = [draw(i, 6, 3) for i in range(12)]
    close = [x + 0.02 * draw(100 + i, 6, 3) for i, x in enumerate(truth)]
    far = [x + 0.8 for x in truth]
    found = swap_test(close, far, truth, swaps=49)
    assert found.difference < 0
    assert found.p_value == pytest.approx(0.02)
    alike = [x + 0.02 * draw(300 + i, 6, 3) for i, x in enumerate(truth)]
    assert swap_test(close, alike, truth, swaps=49).p_value > 0.05


def test_a_variant_is_never_told_from_itself() -> None:
    truth = [draw(i, 4, 20) for i in range(6)]
    same = [x + 0.3 * draw(50 + i, 4, 20) for i, x in enumerate(truth)]
    found = swap_test(same, list(same), truth, swaps=500)
    assert (found.difference, found.p_value, found.swaps) == (0.0, 1.0, 2**5)


def test_the_share_of_false_alarms_is_the_level() -> None:
    alarms = 0
    for trial in range(200):
        truth = [draw(1000 * trial + i, 2, 2) for i in range(7)]
        sides = [
            [x + 0.5 * draw(1000 * trial + 100 * side + i, 2, 2) for i, x in enumerate(truth)]
            for side in (1, 2)
        ]
        alarms += swap_test(sides[0], sides[1], truth, swaps=99, seed=trial).p_value <= 0.05
    assert alarms <= 19  # binomial(200, .05): 20 or more in 0.3 % of repetitions


def test_other_numbers_of_clips_are_refused() -> None:
    truth = [draw(i, 6, 3) for i in range(4)]
    with pytest.raises(EvaluatorError, match="the same clips"):
        swap_test(truth[:3], truth, truth)
