"""What follows from the evidence: looks, several metrics, suites driven whole, questions that are
refused.
"""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from evaluators.statistics.decision import (
    Question,
    least_scenes,
    metric_question,
    outcome_of,
    state_after,
)
from tests.examples import first_rows_of


def rng(key):
    return np.random.Generator(np.random.Philox(key))


def asked(*metrics, **fields):
    return Question(tuple(metric_question(name, margin) for name, margin in metrics), **fields)


def test_a_decision_stays_and_intervals_only_shrink_however_often_one_looks():
    question = asked(("collision_any", 0.2), ("lateral_distance_m", 0.2))
    values = {"collision_any": np.zeros(80), "lateral_distance_m": rng(8).normal(0.0, 0.2, 80)}
    states = [
        state_after(question, {name: x[:n] for name, x in values.items()}, 80)
        for n in range(5, 81, 5)
    ]
    answers = [state.answer for state in states]
    assert answers[0] == "open"
    assert answers[-1] == "good"
    assert answers == sorted(answers, key=["open", "good"].index)
    for name in values:
        ends = np.array([state.metrics[name]["interval"] for state in states], dtype=np.float64)
        ends = ends[np.isfinite(ends).all(axis=1)]
        assert np.all(np.diff(ends[:, 0]) >= -1e-9)
        assert np.all(np.diff(ends[:, 1]) <= 1e-9)


@pytest.mark.parametrize(
    ("shift", "answer", "word"), [(0.0, "good", "non-inferior"), (0.5, "bad", "worse")]
)
def test_a_metric_without_a_better_side_is_judged_by_the_size_of_the_change(shift, answer, word):
    for sign in (1.0, -1.0):
        x = sign * shift + rng(9).normal(
            0.0, 0.2, 200
        )  # fewer cannot have shown a scene that is 4 m to one side
        state = state_after(asked(("lateral_bias_m", 0.2)), {"lateral_bias_m": x}, 200)
        assert (state.answer, state.metrics["lateral_bias_m"]["verdict"]) == (answer, word)


def test_higher_is_better_turns_the_sign_of_what_is_printed_only():
    gone = state_after(
        asked(("progress", 0.1)), {"progress": np.full(60, 0.5)}, 100
    )  # positive is worse: half of the progress is lost
    assert gone.answer == "bad"
    assert gone.metrics["progress"]["diff"] == pytest.approx(-0.5)
    low, high = gone.metrics["progress"]["interval"]
    assert -1.0 <= low < -0.5 < high < -0.1


def test_one_metric_that_is_worse_decides_and_one_that_need_not_decide_does_not_hold_up():
    x = rng(10).normal(0.0, 0.05, 200)
    rare = metric_question("offroad", 0.01, binding=False)
    question = Question((metric_question("lateral_distance_m", 0.1), rare))
    open_rare = state_after(question, {"lateral_distance_m": x, "offroad": np.zeros(200)}, 200)
    assert (open_rare.answer, open_rare.metrics["offroad"]["verdict"]) == ("good", "undecided")
    both = Question(
        (
            metric_question("lateral_distance_m", 0.1),
            metric_question("offroad", 0.05),
        )
    )
    bad = state_after(
        both, {"lateral_distance_m": x[:60], "offroad": np.array([0.0, 1.0, 1.0] * 20)}, 60
    )
    assert bad.answer == "bad"
    assert outcome_of(both, bad, "").exit_code == 1
    assert outcome_of(both, bad, "").reasons == ("offroad is worse",)


def test_scenes_without_a_pair_leave_the_evidence_as_it_was():
    x = rng(11).choice([-1.0, 0.0, 1.0], 40, p=[0.05, 0.9, 0.05])
    holed = x.copy()
    holed[[3, 17, 39]] = np.nan
    question = asked(("offroad", 0.1))
    with_holes = state_after(question, {"offroad": holed}, 60)
    without = state_after(question, {"offroad": np.delete(x, [3, 17, 39])}, 60)
    assert with_holes.metrics["offroad"]["n_scenes"] == 37
    assert with_holes.metrics == without.metrics


def test_nothing_is_decided_on_nothing():
    question = asked(("lateral_distance_m", 0.1))
    nothing = state_after(question, {"lateral_distance_m": np.full(4, np.nan)}, 40)
    look = nothing.metrics["lateral_distance_m"]
    assert (nothing.answer, look["diff"], look["interval"]) == ("open", None, [None, None])


def test_the_scenes_that_a_good_answer_takes_are_counted_before_any_is_driven():
    question = asked(("offroad", 0.2), ("progress", 0.1))
    least = least_scenes(question, 100)
    for n, answer in ((least - 1, "open"), (least, "good")):
        values = {"offroad": np.zeros(n), "progress": np.zeros(n)}
        assert state_after(question, values, n).answer == answer
    assert least_scenes(question, least - 1) is None


@pytest.mark.parametrize(
    ("metric", "margin"), [("lateral_bias_m", 0.0), ("progress", -0.1), ("progress", np.inf)]
)
def test_questions_without_an_answer_are_refused(metric, margin):
    with pytest.raises(InputError):
        metric_question(metric, margin)


@pytest.mark.parametrize(
    ("metric", "tail"),
    first_rows_of(
        [
            ("lateral_distance_m", 4.0),
            ("lateral_bias_m", -4.0),  # either side counts
            ("lateral_bias_m", 4.0),
        ],
        2,
    ),
)
def test_metres_get_no_good_answer_by_scenes_that_cannot_have_shown_the_tail(metric, tail):
    """2.5 % of scenes are 4 m worse, so that the mean is at the margin: a spread of the other
    scenes says nothing of them.
    """
    question = Question((metric_question(metric, 0.1),))
    wrong = 0
    for k in range(30):
        x = rng(k).normal(0.0, 0.05, 60) + np.where(rng(1000 + k).random(60) < 0.025, tail, 0.0)
        wrong += state_after(question, {metric: x}, 60).answer == "good"
    assert wrong <= 3
    alike = rng(1).normal(0.0, 0.05, 200)
    assert state_after(question, {metric: alike}, 200).answer == "good"


def test_an_answer_about_a_distance_names_its_cut_mean_and_bounds_what_lies_beyond():
    """One scene in a hundred is 25 m worse: the mean is 0.25 m worse, the cut mean 0.04 m."""
    x = np.where(np.arange(300) % 100 == 50, 25.0, 0.0)
    question = asked(("lateral_distance_m", 0.2))
    state = state_after(question, {"lateral_distance_m": x}, 300)
    assert state.answer == "good"
    assert question.metrics[0].claim == "mean cut at 4 m"
    beyond = state.metrics["lateral_distance_m"]["beyond"]
    assert (beyond["event"], beyond["n"], beyond["n_scenes"]) == ("worse by more than 4 m", 3, 300)
    assert 0.01 < beyond["at_most"] < 0.06
    opened = state_after(question, {"lateral_distance_m": x[:20]}, 300)
    assert outcome_of(question, opened, "all driven").reasons == (
        "lateral_distance_m (mean cut at 4 m) undecided: all driven",
    )
    rate = state_after(asked(("offroad", 0.2)), {"offroad": np.zeros(40)}, 40)
    assert rate.metrics["offroad"]["beyond"] is None


def test_the_bound_of_what_lies_beyond_a_cap_holds_wherever_one_stops():
    """Three scenes in a hundred lie beyond; the bound is below that at some scene in few runs."""
    question = asked(("lateral_distance_m", 0.1))
    wrong = 0
    for number in range(20):
        x = np.where(rng(2000 + number).random(150) < 0.03, 20.0, 0.0)
        beyond = state_after(question, {"lateral_distance_m": x}, 150).metrics[
            "lateral_distance_m"
        ]["beyond"]
        wrong += beyond["at_most"] < 0.03
    assert wrong <= 3


def test_metres_get_no_bad_answer_where_few_scenes_that_are_far_better_bring_the_mean_to_the_margin():
    question = Question((metric_question("lateral_distance_m", 0.1),))
    wrong = 0
    for k in range(30):
        x = (
            0.2
            + rng(k).normal(0.0, 0.05, 60)
            - np.where(rng(1000 + k).random(60) < 0.025, 4.0, 0.0)
        )
        wrong += state_after(question, {"lateral_distance_m": x}, 60).answer == "bad"
    assert wrong <= 3
    assert (
        state_after(
            question, {"lateral_distance_m": 0.5 + rng(1).normal(0.0, 0.05, 200)}, 200
        ).answer
        == "bad"
    )
