from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.special import expit

from evaluators.statistics.ability import Ability, ability_of, calibrate, chances, count_chances


def plain_count_chances(chance: np.ndarray) -> np.ndarray:
    """Every pattern of passes and failures, one by one."""
    out = np.zeros(len(chance) + 1)
    for passed in itertools.product((0, 1), repeat=len(chance)):
        out[sum(passed)] += np.prod(
            [p if x else 1 - p for p, x in zip(chance, passed, strict=True)]
        )
    return out


def plain_ability(passes: int, difficulty: np.ndarray) -> tuple[float, float]:
    """The abilities of a grid under which the number of passes is not too unlikely."""
    kept = []
    for ability in np.arange(-12, 12, 0.01):
        of = plain_count_chances(expit(ability - difficulty))
        if of[passes:].sum() > 0.025 and of[: passes + 1].sum() > 0.025:
            kept.append(ability)
    return kept[0], kept[-1]


def test_counts_are_those_of_all_patterns() -> None:
    for chance in (np.array([0.1, 0.5, 0.9, 0.999]), np.array([0.0, 1.0, 0.3]), np.array([0.2])):
        np.testing.assert_allclose(count_chances(chance), plain_count_chances(chance), atol=1e-15)


@pytest.mark.parametrize("passes", [1, 3, 5])
def test_the_interval_is_that_of_every_ability_tried(passes: int) -> None:
    difficulty = np.array([-3.0, -1.0, 0.0, 0.5, 2.0, 4.0])
    found = ability_of(passes, difficulty, np.zeros(6))
    assert (found.low, found.high) == pytest.approx(plain_ability(passes, difficulty), abs=0.011)
    assert expit(found.estimate - difficulty).sum() == pytest.approx(passes, abs=1e-5)


@pytest.mark.parametrize(("passes", "word"), [(0, "fails all 5"), (5, "passes all 5")])
def test_where_all_outcomes_are_equal_there_is_one_bound_and_no_score(
    passes: int, word: str
) -> None:
    found = ability_of(passes, np.zeros(5), np.zeros(5))
    assert found.estimate is None
    assert word in found.reason
    bound = np.log(0.05**0.2 / (1 - 0.05**0.2))  # 0.05 = p^5
    assert (found.low, found.high) == (
        (None, pytest.approx(-bound, abs=1e-5))
        if passes == 0
        else (pytest.approx(bound, abs=1e-5), None)
    )


def test_what_is_not_known_of_scenes_widens_the_interval_and_pulls_chances_to_one_half() -> None:
    difficulty = np.linspace(-2, 2, 9)
    sure, unsure = (ability_of(6, difficulty, np.full(9, spread)) for spread in (0.0, 1.5))
    assert unsure.high - unsure.low > sure.high - sure.low
    assert chances(2.0, np.zeros(1), np.ones(1))[0] < expit(2.0)


def test_no_scene_or_too_many_passes_is_refused() -> None:
    for passes, n in ((0, 0), (3, 2), (-1, 2)):
        with pytest.raises(ValueError, match=f"{passes} passes in {n} scenes"):
            ability_of(passes, np.zeros(n), np.zeros(n))


def test_the_mode_is_where_no_small_step_is_likelier() -> None:
    rng = np.random.Generator(np.random.Philox(3))
    passed = (rng.random((4, 7)) < 0.6).astype(float)
    passed[0, 2] = passed[3, 5] = np.nan
    found = calibrate(passed)
    assert found.difficulty.mean() == pytest.approx(0.0, abs=1e-12)

    def log_posterior(ability: np.ndarray, difficulty: np.ndarray) -> float:
        p = expit(ability[:, None] - difficulty)
        return float(
            np.nansum(np.log(np.where(passed == 1, p, 1 - p)) * np.where(np.isnan(passed), 0, 1))
            - (ability**2).sum() / 18
            - (difficulty**2).sum() / 8
        )

    shift = max(
        np.linspace(-3, 3, 6001),
        key=lambda s: log_posterior(found.ability + s, found.difficulty + s),
    )
    best = log_posterior(found.ability + shift, found.difficulty + shift)
    for k in range(7):
        for step in (-0.05, 0.05):
            assert (
                log_posterior(
                    found.ability + shift, found.difficulty + shift + step * (np.arange(7) == k)
                )
                < best
            )


def coverage(drivers: int, scenes: int, repeats: int, known: bool) -> tuple[float, float]:
    """How often the interval holds a true ability, and how often there is a score. Known:
    difficulties are given, not calibrated.
    """
    rng = np.random.Generator(np.random.Philox(39))
    inside, scored = [], 0
    for _ in range(repeats):
        difficulty = rng.normal(0, 2, scenes)
        difficulty -= difficulty.mean()
        able, known_drivers = rng.normal(0, 1.5), rng.normal(0, 2, drivers)
        passes = int((rng.random(scenes) < expit(able - difficulty)).sum())
        if known:
            found: Ability = ability_of(passes, difficulty, np.zeros(scenes))
        else:
            fit = calibrate(
                (rng.random((drivers, scenes)) < expit(known_drivers[:, None] - difficulty)).astype(
                    float
                )
            )
            found = ability_of(passes, fit.difficulty, fit.spread)
        scored += found.estimate is not None
        inside.append(
            (found.low is None or found.low <= able) and (found.high is None or able <= found.high)
        )
    return float(np.mean(inside)), scored / repeats


@pytest.mark.parametrize(
    ("drivers", "scenes", "known"), [(0, 8, True), (0, 20, True), (4, 12, False), (14, 20, False)]
)
def test_intervals_cover_the_true_ability(drivers: int, scenes: int, known: bool) -> None:
    covered, scored = coverage(drivers, scenes, 200, known)
    assert covered >= 0.95 - 2 * np.sqrt(0.95 * 0.05 / 200)
    assert scored > 0.5
