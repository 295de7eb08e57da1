"""Stratified order: the sample by exact enumeration of its coins, and e-processes on it over all
courses.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from evaluators.statistics.sequential import asymptotic, betting
from evaluators.statistics.sequential.control import Control, adjusted_draws, predictions
from evaluators.statistics.sequential.draws import (
    Draws,
    Strata,
    families_of,
    pivotal_sample,
    stratified,
)
from evaluators.statistics.sequential.line import Plan
from evaluators.statistics.sequential.question import metric_question

PLAN = Plan(0.1, 50, 0.05)


class Coins:
    """Gives `pivotal_sample` one course of its coins, and the chance of that course."""

    def __init__(self, course: tuple[bool, ...]) -> None:
        self.course, self.at, self.chance, self.asked = course, 0, Fraction(1), list[int]()

    def integers(self, bound: int) -> Coins:
        """Begin a coin whose number is below ``bound``."""
        self.bound = bound
        return self

    def __lt__(self, limit: int) -> bool:
        heads = self.course[self.at]
        self.at += 1
        self.chance *= Fraction(limit if heads else self.bound - limit, self.bound)
        return heads


def samples(left: int, wanted: int) -> Iterator[tuple[list[int], Fraction]]:
    """Yield every sample with its chance."""
    for course in itertools.product((True, False), repeat=left - 1 if wanted < left else 0):
        coins = Coins(course)
        found = pivotal_sample(left, wanted, coins)  # type: ignore[arg-type]
        if coins.chance:
            yield found, coins.chance


@pytest.mark.parametrize(
    ("left", "wanted"), [(6, 3), (7, 3), (9, 2), (8, 5), (5, 1), (4, 4), (3, 5)]
)
def test_every_scene_has_the_same_chance_and_every_stretch_of_the_list_its_share(left, wanted):
    chances, total = [Fraction(0)] * left, Fraction(0)
    for found, chance in samples(left, wanted):
        assert len(set(found)) == min(left, wanted)
        total += chance
        for i in found:
            chances[i] += chance
        for stop in range(left + 1):  # rounded up or down
            assert abs(sum(i < stop for i in found) - Fraction(min(wanted, left) * stop, left)) < 1
    assert total == 1
    assert chances == [Fraction(min(wanted, left), left)] * left


def test_families_of_equal_size_give_one_scene_each_to_every_batch():
    strata = Strata({f"{family}{i}": family for family in "abcd" for i in range(5)}, (4,) * 5)
    order = strata.order(np.random.Generator(np.random.Philox(1)))
    assert [sorted(scene[0] for scene in order[at : at + 4]) for at in range(0, 20, 4)] == [
        list("abcd")
    ] * 5
    assert strata.begins(10).tolist() == [0, 0, 0, 0, 4, 4, 4, 4, 8, 8]
    assert order != strata.order(np.random.Generator(np.random.Philox(2)))


def test_families_of_unequal_size_are_drawn_in_proportion():
    sizes = {"a": 24, "b": 12, "c": 9, "d": 3}
    strata = Strata(
        {f"{family}{i}": family for family, size in sizes.items() for i in range(size)}, (8,) * 6
    )
    order = strata.order(np.random.Generator(np.random.Philox(3)))
    first = Counter(scene[0] for scene in order[:8])
    assert sorted(order) == sorted(strata.family_of)
    assert all(abs(first[family] - size / 6) < 1 for family, size in sizes.items())


SUITE = np.array(
    [-1.0, -0.9, 0.9, 1.0, 0.3, -0.2, 0.8]
)  # families that differ as much as they can, of 2, 2, 2 and 1
FAMILY = np.array([0, 0, 1, 1, 2, 2, 3])
SIZES = (3, 2, 2)


def courses(left: tuple[int, ...], sizes: tuple[int, ...]) -> Iterator[tuple[list[int], Fraction]]:
    """Yield every order of a suite that is listed in this order, with its chance."""
    if not sizes:
        yield [], Fraction(1)
        return
    for found, chance in samples(len(left), sizes[0]):
        rest = tuple(scene for i, scene in enumerate(left) if i not in found)
        for later, then in courses(rest, sizes[1:]):
            yield [left[i] for i in found] + later, chance * then


def all_draws(
    control: np.ndarray | None = None, less_means: bool = False
) -> list[tuple[list[int], float, Draws]]:
    """Return every course with its chance and draws, given the order within families."""
    begin = Strata({}, SIZES).begins(7)
    found = []
    for order, chance in courses(tuple(range(7)), SIZES):
        off = (None, None) if control is None else predictions(SUITE[order], control[order], begin)
        found.append(
            (
                order,
                float(chance),
                stratified(
                    SUITE[order], -1.0, 1.0, FAMILY[order], begin, *off, less_means=less_means
                ),
            )
        )
    return found


KNOWN = np.array([[0.3], [-1.0], [0.2], [0.9], [0.0], [0.4], [1.0]])


@pytest.mark.parametrize(("control", "less_means"), [(None, False), (KNOWN, True)])
def test_the_capital_at_the_ends_of_batches_is_a_supermartingale_over_all_courses(
    control, less_means
):
    for side in (1.0, -1.0):
        mean = side * float(SUITE.mean())
        now: dict[tuple[int, ...], float] = {(): 1.0}
        at, everything = 0, all_draws(control, less_means)
        for size in SIZES[:2]:
            at += size
            expected = Counter[tuple[int, ...]]()
            chance_of = Counter[tuple[int, ...]]()
            capital_at = dict[tuple[int, ...], float]()
            for order, chance, draws in everything:
                one = draws if side > 0 else draws.mirrored()
                path = betting.log_capital(one, mean, betting.bet_sizes(one, mean, PLAN))
                assert np.isneginf(path[[0, 1, 3]]).all()  # nothing is said within a batch
                before, after = tuple(order[: at - size]), tuple(order[:at])
                expected[before] += chance * np.exp(path[at - 1])
                chance_of[before] += chance
                capital_at[after] = float(np.exp(path[at - 1]))
            for before, value in now.items():
                assert expected[before] / chance_of[before] <= value * (1 + 1e-12)
            assert (
                min(expected[before] / chance_of[before] / value for before, value in now.items())
                < 1.0
            )
            now = capital_at


@pytest.mark.parametrize("less_means", [False, True])
def test_sums_are_martingales_and_their_spread_is_that_within_families(less_means):
    ends = [2, 4]
    total, chance_of = np.zeros(2), 0.0
    for _, chance, draws in all_draws(less_means=less_means):
        total += chance * np.cumsum(draws.x - draws.offset - draws.slope * SUITE.mean())[ends]
        chance_of += chance
    assert (total / chance_of).tolist() == pytest.approx([0.0, 0.0], abs=1e-12)
    generator = np.random.Generator(np.random.Philox(4))
    strata = Strata({f"{family}{i:02}": family for family in "abcde" for i in range(40)}, (5,) * 40)
    order = strata.order(generator)
    number = strata.numbers(order)
    x = 10.0 * number + generator.normal(0.0, 0.5, 200)
    draws = stratified(x[:100], -np.inf, np.inf, number, strata.begins(100), less_means=less_means)
    pooled = np.concatenate(
        [x[:100][number[:100] == one] - x[:100][number[:100] == one].mean() for one in range(5)]
    )
    assert draws.spread[99] == pytest.approx(np.sqrt(np.sum(pooled**2) / 95))
    assert draws.freedom[[4, 9, 99]].tolist() == [0.0, 5.0, 95.0]
    assert np.isneginf(
        asymptotic.log_evidence(draws, float(x.mean()), PLAN, 20)[[4, 14, 20, 23]]
    ).all()
    assert np.isfinite(asymptotic.lower_bound(draws, PLAN))


def test_what_stretches_of_several_families_leave_between_them_is_in_the_spread():
    """Batches of one scene are random draws: all of the variance between families is left."""
    generator = np.random.Generator(np.random.Philox(5))
    family = generator.permutation(np.repeat([0, 1], 200))
    x = 4.0 * family + generator.normal(0.0, 1.0, 400)
    draws = stratified(x[:200], -np.inf, np.inf, family, np.arange(200))
    assert draws.spread[-1] == pytest.approx(np.std(x[:200]), rel=0.01)


def test_scenes_without_a_value_are_left_out_of_their_batches():
    strata = Strata({name: name[0] for name in ("a1", "a2", "a3", "b1", "b2", "b3")}, (2, 2, 2))
    order = ["a1", "b1", "a2", "b2", "b3", "a3"]
    one = metric_question("lateral_distance_m", 0.1, "non-inferior")
    draws = adjusted_draws(np.array([0.1, np.nan, 0.2, 0.3]), one, order, None, strata)
    assert (draws.n, draws.begin.tolist(), draws.is_end.tolist()) == (
        3,
        [0, 1, 1],
        [True, False, True],
    )
    known = Control({scene: (float(i),) for i, scene in enumerate(order)}, ("difficulty",))
    assert adjusted_draws(np.array([0.1, np.nan, 0.2, 0.3]), one, order, known, strata).n == 3


def test_families_are_files_or_folders_and_one_alone_is_refused():
    assert families_of(
        {"a-1": "x/a.yaml", "a-2": "x/a.yaml", "b": "x/b.yaml", "c": "y/c.yaml"}, ""
    ) == {"a-1": "x", "a-2": "x", "b": "x", "c": "y"}
    with pytest.raises(InputError, match="one family, x"):
        families_of({"a": "x/a.yaml", "b": "x/b.yaml"}, "--order stratified")
