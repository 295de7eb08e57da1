"""Group-sequential designs: published bounds, the error of the whole, and when they may speak."""

from __future__ import annotations

import numpy as np
import pytest

from evaluators.statistics.sequential.decision import state_after
from evaluators.statistics.sequential.group import boundaries, spent
from evaluators.statistics.sequential.question import Question, metric_question

TIMES = (0.2, 0.4, 0.6, 0.8, 1.0)


@pytest.mark.parametrize(
    ("spending", "published"),
    [
        ("obrien-fleming", [4.8769, 3.3569, 2.6803, 2.2898, 2.0310]),
        ("pocock", [2.4380, 2.4268, 2.4101, 2.3966, 2.3859]),
    ],
)
def test_bounds_are_the_published_ones_of_five_looks_at_one_sided_025(spending, published):
    assert boundaries(0.025, TIMES, spending) == pytest.approx(published, abs=2e-3)
    assert spent(0.025, 1.0, spending) == pytest.approx(0.025)


@pytest.mark.parametrize("spending", ["obrien-fleming", "pocock"])
def test_all_looks_together_refute_in_a_share_alpha_of_motions(spending):
    steps = np.random.default_rng(2).normal(size=(20_000, 5)) * np.sqrt(0.2)
    z = np.cumsum(steps, axis=1) / np.sqrt(TIMES)
    assert np.mean((z >= boundaries(0.05, TIMES, spending)).any(axis=1)) == pytest.approx(
        0.05, abs=0.006
    )


@pytest.mark.parametrize("method", ["obrien-fleming", "pocock"])
def test_a_decision_speaks_at_its_looks_only_and_in_both_directions(method):
    question = Question((metric_question("offroad", 0.1, "non-inferior", method=method),))
    rng = np.random.default_rng(4)
    same = rng.choice([-1.0, 0.0, 1.0], 200, p=[0.05, 0.9, 0.05])
    answers = [state_after(question, {"offroad": same[:n]}, 200).answer for n in (39, 160, 200)]
    assert answers == ["open", "good", "good"]
    state = state_after(question, {"offroad": np.where(np.arange(80) % 3, 1.0, 0.0)}, 200)
    assert (state.answer, state.metrics[0].answer) == ("bad", "worse")
    low, high = state.metrics[0].interval
    assert 0.1 < low < state.metrics[0].diff < high
