"""Gates: what they ask for, against what, and the one outcome that follows."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from evaluators import METRICS
from evaluators.statistics.gate import GateSpec, MetricRule, judge, load_gate, shipped_gates
from evaluators.statistics.verdicts import EXIT_CODES, SEVERITY, Outcome, outcome_of_failures, worst

SCENES = 200  # enough to exclude that a few scenes go wrong by metres


def rows(shift=0.0, renderer="3dgs", events=0, n_scenes=SCENES, policy="p", black=0.0, spread=0.02):
    """Rows of one renderer: a distance that is ``shift`` more than that of the others on the same
    cells, some off-road events.
    """
    rng = np.random.Generator(np.random.Philox(9))
    shared = rng.normal(0.3, 0.2, n_scenes)
    own = (
        np.random.Generator(np.random.Philox(len(renderer))).normal(shift, spread, n_scenes)
        if shift
        else np.zeros(n_scenes)
    )
    return [
        {
            "renderer": renderer,
            "policy": policy,
            "scene": f"s{i:03d}",
            "seed": 0,
            "status": "ok",
            "route_distance_m": float(shared[i] + own[i]),
            "route_distance_m_valid": True,
            "offroad": float(i < events),
            "offroad_valid": True,
            "img_is_black": black,
            "img_is_black_valid": True,
        }
        for i in range(n_scenes)
    ]


def gate(**fields):
    rules = {
        "route_distance_m": MetricRule(margin=0.1),
        "offroad": MetricRule(margin=0.05),
        "img_is_black": MetricRule(max=0.0),
    }
    return GateSpec(**{"version": 1, "min_scenes": 10, "metrics": rules, **fields})


def cause(candidate, spec=None, base=None):
    return judge([*(base or rows(renderer="clean")), *candidate], spec or gate()).outcome.cause


def test_no_change_passes_and_a_clear_one_fails():
    assert cause(rows()) == "pass"
    assert cause(rows(shift=0.01)) == "pass"
    assert cause(rows(shift=0.5)) == "regression"
    assert cause(rows(shift=0.11, spread=1.0)) == "undecided"


def test_a_limit_needs_no_statistics():
    verdict = judge([*rows(renderer="clean"), *rows(black=1.0)], gate())
    assert verdict.outcome.cause == "regression"
    assert [c.metric for c in verdict.checks if c.cause == "regression"] == ["img_is_black"]
    assert verdict.outcome.reasons == ("3dgs: img_is_black 1, limit max 0",)


def test_too_few_scenes_leave_it_undecided_whatever_they_show():
    few = {"n_scenes": 6}
    found = judge([*rows(renderer="clean", **few), *rows(shift=0.5, **few)], gate())
    assert (found.outcome.cause, found.exit_code) == ("undecided", 3)
    assert "6 scenes, the gate asks for 10" in found.outcome.reasons[0]


def test_missing_pairs_leave_it_undecided_beyond_what_the_gate_allows():
    candidate = rows()[:-8]
    assert cause(candidate) == "undecided"
    assert cause(candidate, gate(max_missing=0.1)) == "pass"


def test_failed_rollouts_are_infrastructure_and_unscored_ones_the_evaluators():
    broken = rows()
    broken[0] |= {"status": "failed", "failure_class": "renderer"}
    assert judge([*rows(renderer="clean"), *broken], gate()).exit_code == 4
    allowed = gate(max_failed=0.05, max_missing=0.05)
    assert judge([*rows(renderer="clean"), *broken], allowed).exit_code == 0
    broken[0]["failure_class"] = "evaluator"
    assert judge([*rows(renderer="clean"), *broken], gate()).exit_code == 5


def test_a_rule_that_need_not_decide_only_vetoes():
    spec = gate(
        metrics={
            "offroad": MetricRule(margin=0.05, must_decide=False),
            "img_is_black": MetricRule(max=0.0),
        }
    )
    verdict = judge([*rows(renderer="clean"), *rows(events=4)], spec)
    assert {c.metric: c.cause for c in verdict.checks} == {
        "offroad": "undecided",
        "img_is_black": "pass",
    }
    assert verdict.exit_code == 0
    assert cause(rows(events=40), spec) == "regression"


def test_a_distance_decides_only_together_with_its_event():
    rules = {
        "route_distance_m": MetricRule(margin=0.1),
        "offroad": MetricRule(margin=0.05, must_decide=False),
    }
    both = judge([*rows(renderer="clean"), *rows(events=4)], gate(metrics=rules))
    assert {c.metric: c.cause for c in both.checks} == {
        "offroad": "undecided",
        "route_distance_m": "undecided",
    }
    assert "decides only together with its event: offroad is undecided" in both.outcome.reasons[0]
    alone = judge(
        [*rows(renderer="clean"), *rows()],
        gate(metrics={"route_distance_m": rules["route_distance_m"]}),
    )
    assert "the gate has no margin for offroad" in alone.outcome.reasons[0]
    assert cause(rows(shift=0.5), gate(metrics=rules)) == "regression", (
        "worse is shown by the distance alone"
    )


def test_a_suite_that_is_all_that_is_asked_about_needs_no_unseen_scenes():
    few = {"n_scenes": 20}
    both = [*rows(renderer="clean", **few), *rows(shift=0.3, **few)]
    drawn = judge(both, gate())
    assert drawn.outcome.cause == "undecided"
    assert "fewer than 146 scenes cannot exclude harm in others" in drawn.outcome.reasons[0]
    assert judge(both, gate(population="suite")).outcome.cause == "regression"


def test_renderers_and_policies_are_judged_one_by_one():
    both = [*rows(renderer="clean"), *rows(renderer="good"), *rows(shift=0.5, renderer="worse one")]
    verdict = judge(both, gate())
    distances = [c for c in verdict.checks if c.metric == "route_distance_m"]
    assert {(c.renderer, c.cause) for c in distances} == {
        ("good", "pass"),
        ("worse one", "regression"),
    }
    assert judge(both, gate(renderers=("good",))).exit_code == 0
    other = [*rows(renderer="clean", policy="q"), *rows(shift=0.5, renderer="good", policy="q")]
    arms = judge([*both, *other], gate(renderers=("good",))).checks
    assert {(c.policy, c.cause) for c in arms if c.metric == "route_distance_m"} == {
        ("p", "pass"),
        ("q", "regression"),
    }


def test_a_stored_baseline_meets_the_renderer_of_the_same_name():
    stored = [*rows(renderer="clean"), *rows()]
    verdict = judge([*rows(renderer="clean"), *rows(shift=0.5)], gate(), stored, "main.json")
    assert {(c.renderer, c.cause) for c in verdict.checks if c.metric == "route_distance_m"} == {
        ("clean", "pass"),
        ("3dgs", "regression"),
    }
    assert verdict.baseline == "main.json"


def test_names_that_are_not_there_are_refused():
    one = rows(renderer="clean")
    with pytest.raises(InputError, match="the run has nothing else to compare with it"):
        judge(one, gate())
    with pytest.raises(InputError, match="the run has none of these"):
        judge([*one, *rows()], gate(renderers=("onefixer",)))
    with pytest.raises(InputError, match="choose one of clean, 3dgs"):
        judge([*one, *rows()], gate(baseline="onefixer"))
    limits = gate(metrics={"img_is_black": MetricRule(max=0.0)})
    assert judge(one, limits).exit_code == 0  # limits need no second renderer


def test_text_and_exit_code_come_from_one_object_and_the_worst_cause_decides():
    assert EXIT_CODES == {
        "pass": 0,
        "regression": 1,
        "policy": 2,
        "undecided": 3,
        "infrastructure": 4,
        "evaluator": 5,
    }
    for one, other in itertools.product(SEVERITY, SEVERITY):
        assert worst([Outcome(one), Outcome(other)]).cause == min(one, other, key=SEVERITY.index)
    failures = {"n_failed": 2, "n_rollouts": 9, "by_class": {"evaluator": 1, "policy": 1}}
    assert outcome_of_failures(failures).exit_code == 4
    assert outcome_of_failures(failures | {"by_class": {"policy": 2}}).exit_code == 2
    assert outcome_of_failures(failures | {"n_failed": 0, "by_class": {}}).exit_code == 0


# --- files


@pytest.mark.parametrize("name", shipped_gates())
def test_shipped_gates_load_by_name(name):
    assert load_gate(name)[0].metrics


@pytest.mark.parametrize(
    ("text", "place", "mention"),
    [
        ("version: 1\nmetrics:\n  offroad: {margn: 0.1}\n", ":3:", "did you mean 'margin'?"),
        (
            "version: 1\nmin_scene: 3\nmetrics: {offroad: {margin: 0.1}}\n",
            ":2:",
            "did you mean 'min_scenes'?",
        ),
        ("version: 1\nmetrics:\n  offraod: {margin: 0.1}\n", ":3:", "no metric 'offraod'"),
        ("version: 1\nmetrics:\n  offroad: {margin: -0.1}\n", ":3:", "greater than or equal to 0"),
        (
            "version: 1\nmetrics:\n  offroad: {must_decide: false}\n",
            ":3:",
            "a rule without margin, max or min",
        ),
        ("version: 1\nmetrics:\n  dist_traveled_m: {margin: 0}\n", ":3:", "no better side"),
        ("version: 1\npreset: papr\nmetrics: {offroad: {margin: 0.1}}\n", ":2:", "known: paper"),
        ("version: 2\nmetrics: {offroad: {margin: 0.1}}\n", ":1:", "version"),
        ("version: 1\nmetrics: {}\n", ":2:", "metrics"),
        ("version: 1\nmetrics: {offroad: {margin: 0.1}\n", ":2:", "not valid YAML"),
    ],
)
def test_a_bad_gate_file_is_refused_with_its_line_and_a_hint(tmp_path: Path, text, place, mention):
    path = tmp_path / "gate.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_gate(path)
    assert f"gate.yaml{place}" in caught.value.message or "not valid YAML" in caught.value.message
    assert mention in f"{caught.value.message} {caught.value.hint}"


def test_an_unknown_gate_lists_the_shipped_ones():
    with pytest.raises(InputError, match="default"):
        load_gate("nightly")


@pytest.mark.parametrize("name", ["default", "policy"])
def test_a_shipped_gate_lets_a_distance_decide_only_together_with_its_events(name):
    spec = load_gate(name)[0]
    assert [metric for metric, rule in spec.metrics.items() if not rule.must_decide] == [
        "braked_without_cause"
    ]
    driven = rows(renderer="clean", n_scenes=300) + rows(renderer="3dgs", events=10, n_scenes=300)
    more = {
        "lateral_distance_m": 0.1,
        "lateral_bias_m": 0.0,
        "progress": 1.0,
        "collision_at_fault": 0.0,
        "braked_without_cause": 0.0,
    }
    run = [row | more for row in driven]
    plain = spec.model_copy(
        update={"metrics": {key: rule for key, rule in spec.metrics.items() if rule.margin}}
    )
    causes = {check.metric: check.cause for check in judge(run, plain).checks}
    undecided = {metric for metric, cause in causes.items() if cause == "undecided"}
    assert (
        undecided
        == {"offroad", *(metric for metric in spec.metrics if METRICS[metric].event == "offroad")}
        != {"offroad"}
    )
    assert set(causes.values()) == {"pass", "undecided"}
    assert judge(run, plain).exit_code == 3
