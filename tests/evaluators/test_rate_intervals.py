"""Intervals of rates and means where they are easy to get wrong: nobody, everybody, one scene,
equal scenes, unequal seeds.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.errors import EvaluatorError
from evaluators.statistics.bounded import rate_interval
from evaluators.statistics.differences import flag_interval
from evaluators.statistics.intervals import cluster_means, exact_rate, paired_rate
from tests.examples import examples

shares = st.lists(st.sampled_from([0.0, 0.2, 1 / 3, 0.5, 0.8, 1.0]), min_size=2, max_size=40)


@given(shares)
@settings(max_examples=examples(200), deadline=None)
def test_bounds_of_a_rate_hold_its_centre_and_never_leave_zero_to_one(means):
    one = rate_interval(np.array(means))
    assert 0.0 <= one.low <= one.centre + 1e-12
    assert one.centre - 1e-12 <= one.high <= 1.0
    assert one.low < one.high


@given(shares)
@settings(max_examples=examples(100), deadline=None)
def test_counting_non_events_instead_of_events_mirrors_the_bounds(means):
    one = rate_interval(np.array(means))
    other = rate_interval(1.0 - np.array(means))
    assert (one.low, one.high) == pytest.approx((1 - other.high, 1 - other.low), abs=1e-7)


@pytest.mark.parametrize("n", [10, 42])
def test_a_rate_and_its_difference_are_covered_where_a_tenth_of_scenes_always_has_the_event(n):
    """10 seeds; 5 % in the other scenes, so that the truth is 14.5 %; the baseline has none."""
    rng = np.random.Generator(np.random.Philox(n))
    scenes = np.repeat(np.arange(n), 10)
    found = []
    for _ in range(200):
        chance = np.where(rng.random(n) < 0.1, 1.0, 0.05)[scenes]
        hits = (rng.random(len(scenes)) < chance).astype(float)
        of_rate = rate_interval(cluster_means(hits, scenes)[0])
        found.append(
            [one.low <= 0.145 <= one.high for one in (of_rate, flag_interval(hits, scenes))]
        )
    assert np.mean(found, axis=0).min() >= 0.94


@pytest.mark.parametrize("n", [2, 5, 60])
def test_nobody_and_everybody_take_the_exact_bounds_over_scenes(n):
    nobody = rate_interval(np.zeros(n))
    everybody = rate_interval(np.ones(n))
    assert (nobody.low, nobody.high) == pytest.approx((0.0, 1 - 0.025 ** (1 / n)))
    assert (everybody.low, everybody.high) == pytest.approx((0.025 ** (1 / n), 1.0))


def test_scenes_that_all_have_the_same_share_allow_for_others_that_were_not_drawn():
    one = rate_interval(np.full(10, 0.2))
    unseen = 1 - 0.025 ** (1 / 10)
    assert (one.low, one.high) == pytest.approx((0.2 - 0.2 * unseen, 0.2 + 0.8 * unseen))


def test_with_one_seed_a_rate_has_the_bounds_of_clopper_and_pearson_and_a_pair_those_of_tango():
    one = rate_interval(np.array([1.0, 0.0, 0.0]))
    assert (one.low, one.high) == pytest.approx((0.00840, 0.90570), abs=1e-5)
    for gained, lost, n in ((1, 0, 3), (2, 1, 7), (0, 0, 5), (9, 0, 9), (0.4, 1.2, 6)):
        low, high = paired_rate(gained, lost, n)
        shares = np.linspace(0, 1, 200_001)
        for bound, side in ((low, 1), (high, -1)):
            if abs(bound) == 1.0:
                continue
            # The share of pairs that lose the event where the likelihood is greatest, given the
            # difference: searched, not solved for.
            lose = shares[(shares + bound >= 0) & (2 * shares + bound <= 1)]
            with np.errstate(divide="ignore", invalid="ignore"):
                likelihood = (
                    np.where(gained > 0, gained * np.log(lose + bound), 0.0)
                    + np.where(lost > 0, lost * np.log(lose), 0.0)
                    + (n - gained - lost) * np.log(1 - 2 * lose - bound)
                )
            share = lose[np.nanargmax(likelihood)]
            variance = n * (2 * share + bound * (1 - bound))
            assert (gained - lost - n * bound) / variance**0.5 == pytest.approx(
                side * 1.96, abs=0.02
            )
    assert paired_rate(2, 1, 7) == pytest.approx([-b for b in paired_rate(1, 2, 7)[::-1]])


def test_one_scene_has_no_interval_over_scenes_however_many_seeds():
    one = rate_interval(np.array([2 / 3]))
    assert (one.bounds, one.reason) == (None, "needs at least two scenes, found 1")


def test_unequal_seeds_do_not_let_one_scene_outweigh_the_others():
    values = [1.0] * 50 + [0.0] * 4
    scenes = ["busy"] * 50 + ["a", "b", "c", "d"]
    one = rate_interval(cluster_means(values, scenes)[0])
    assert one.centre == pytest.approx(0.2)
    assert one.high > 0.5


def test_values_that_are_no_fractions_are_refused_as_rates():
    with pytest.raises(EvaluatorError, match="give rates as fractions"):
        rate_interval(np.array([0.0, 12.5]))


def test_exact_bounds_stay_at_the_edges():
    for n in (1, 7, 300):
        assert exact_rate(0, n)[0] == 0.0
        assert exact_rate(n, n)[1] == 1.0
