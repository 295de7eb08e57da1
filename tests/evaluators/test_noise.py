"""Gates of policies that are not repeatable: each answer is wrong in 2.5 % of runs at most, about
what it states, in laws where plain rules are wrong in half of them.
"""

import numpy as np
import pytest

from alpasim_plugin.core.seeding import stream
from evaluators.statistics.decision import Question, metric_question, state_after
from evaluators.statistics.intervals import TAIL, exact_rate, paired_rate, rate_at_most
from evaluators.statistics.noise import (
    beyond,
    chance_at_margin,
    chance_at_rate,
    chance_of_more,
    chance_within,
    rejected_together,
    seeds_for_mean,
    seeds_for_rate,
)
from evaluators.statistics.suite import LEVEL
from tests.calibration import (
    DISTANCES,
    QUICK,
    Effort,
    TwoValues,
    decided,
    differences_of_rates,
    gates_of_distances,
    outcomes,
)
from tests.examples import first_of

DRAWS = 300
SLACK = 0.02  # two and a half standard errors of a share of 2.5 % in so many draws


@pytest.mark.parametrize("law", DISTANCES, ids=lambda law: law.name)
@pytest.mark.parametrize("n", [9, 42])
def test_no_answer_about_a_cut_mean_is_wrong_more_often_than_promised(law, n):
    green, red = 0, 0
    for number in range(DRAWS):
        harms = law.draw(stream("noise", number, f"{law.name}/{n}"), n)
        green += chance_at_margin(harms, law.margin) <= TAIL
        red += chance_within(harms, law.margin) <= TAIL
    truth = law.cut_mean
    if truth >= law.margin - 1e-3:
        assert green / DRAWS <= TAIL + SLACK
    if truth <= law.margin + 1e-3:
        assert red / DRAWS <= TAIL + SLACK


def test_a_rare_far_drive_is_red_where_it_was_driven_and_its_rate_is_open_where_not():
    quiet = np.full(14, 0.01)
    far = np.append(quiet[:-1], 4.0)
    assert not beyond(quiet, 0.1).is_red(LEVEL)
    assert beyond(far, 0.1).is_red(LEVEL)
    assert round(100 * beyond(quiet, 0.1).at_most) == 19
    assert round(100 * rate_at_most(1, 14)) == 30


def test_a_far_drive_amid_noise_of_its_size_is_not_red_and_not_green():
    noisy = np.array([0.2, -0.15, 0.05, 0.0, 0.12, -0.2, 0.31])
    drives = beyond(noisy, 0.1)
    assert not drives.is_red(LEVEL)
    assert not drives.is_answered
    answered = beyond(np.append(noisy, -0.4), 0.1)
    assert answered.is_answered
    assert not answered.is_red(LEVEL)
    assert beyond(np.append(np.full(9, 0.5), -0.4), 0.1).is_red(0.011)  # nine to one


def test_variants_that_are_alike_are_rarely_red_whatever_their_noise():
    red = 0
    for number in range(DRAWS):
        harms = 0.1 * stream("noise", number, "alike").standard_t(3, 9)
        red += beyond(harms, 0.1).is_red(LEVEL) or chance_within(harms, 0.1) <= LEVEL
    assert red / DRAWS <= TAIL


@pytest.mark.parametrize("rate", [0.02, 0.05, 0.1, 0.3])
@pytest.mark.parametrize("n", first_of([36, 60]))
def test_the_test_of_events_keeps_its_error_and_nine_tenths_of_tangos_power_by_enumeration(n, rate):
    margin = 0.1
    changed = rate * (1.0 - rate)
    wrong = sum(
        chance
        for new, gone, chance in outcomes(n, changed + margin, changed)
        if chance_at_rate(new, gone, n, margin) <= TAIL
    )
    assert wrong <= TAIL
    exact, tango, two_bounds = 0.0, 0.0, 0.0
    for new, gone, chance in outcomes(n, changed, changed):
        exact += chance * (chance_at_rate(new, gone, n, margin) <= TAIL)
        tango += chance * (paired_rate(new, gone, n)[1] < margin)
        two_bounds += chance * (exact_rate(new, n)[1] - exact_rate(gone, n)[0] < margin)
    assert exact >= 0.89 * tango
    assert exact > two_bounds


def test_chances_of_single_outcomes():
    assert chance_at_rate(0, 0, 36, 0.1) == pytest.approx(0.9**36, abs=2e-3)
    assert chance_at_rate(0, 0, 10, 1.0) == 0.0
    assert chance_at_rate(0, 0, 0, 0.1) == 1.0
    assert chance_at_rate(40, 0, 100, 0.1) > 0.99
    assert chance_of_more(0, 0) == 1.0
    assert rejected_together([0.001, 0.2, 0.004], 0.01) == [True, False, True]
    assert rejected_together([0.004, 0.006, 0.2], 0.01) == [False, False, False]


def test_the_seeds_that_decide_are_those_at_which_the_tests_reject():
    assert seeds_for_mean(np.zeros(3), 0.1, 3) == 4
    assert chance_at_margin(np.zeros(9), 0.1) > TAIL >= chance_at_margin(np.zeros(12), 0.1)
    assert seeds_for_rate(0, 0, 14, 0.1, 14) == 3
    assert chance_at_rate(0, 0, 28, 0.1) > TAIL >= chance_at_rate(0, 0, 42, 0.1)
    assert seeds_for_mean(np.full(6, 0.2), 0.1, 6) is None  # more of the same are never within
    assert seeds_for_rate(0, 0, 0, 0.1, 0) is None


def test_the_calibration_prints_a_row_for_each_law_and_size():
    rows = list(gates_of_distances(Effort(draws=3, most_cells=6)))
    assert {row[0] for row in rows} == {law.name for law in DISTANCES}
    assert QUICK.draws < 100


def test_many_decisions_at_once_are_those_of_one_after_another():
    question = Question((metric_question("lateral_distance_m", 0.1),))
    law = TwoValues(0.3, 1.0, -0.1)
    rows = [law(stream("noise", number, "decided"), 60) for number in range(3)]
    rows += [np.zeros(60), np.full(60, 1.0), np.full(60, 5.0)]
    expected = [
        state_after(question, {"lateral_distance_m": harms}, 60).metrics["lateral_distance_m"]
        for harms in rows
    ]
    assert decided(np.array(rows), 0.1, 4.0) == [look["verdict"] for look in expected]
    assert expected[-1]["verdict"] == "worse"


def test_the_outcomes_of_two_values_have_all_chances():
    law = TwoValues(0.1, 2.0, -1.0)
    chances = [chance for _, chance in law.outcomes(7)]
    assert sum(chances) == pytest.approx(1.0)
    mean = sum(chance * values.mean() for values, chance in law.outcomes(7))
    assert mean == pytest.approx(law.mean)
    assert law.cut(-0.5, 1.0).mean == pytest.approx(0.1 * 1.0 - 0.9 * 0.5)


def test_a_difference_of_rates_is_covered_where_many_scenes_change_either_way():
    for row in differences_of_rates(Effort(draws=0, most_cells=40)):
        for cell in row[1:]:
            assert float(cell.split(" / ")[1]) >= 95.0
