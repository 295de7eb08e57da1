"""The entry point: bad logs are refused, evaluators are checked, every metric states its facts."""

import json
from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.types import Box, LoggedPlan, Trajectory
from alpasim_plugin.log.run_folder.records import json_of
from evaluators import METRICS, MetricInfo, resolve_evaluators, rollout_values, score
from evaluators.metrics import MetricTable
from evaluators.metrics.score import run_evaluator, series
from tests.evaluators.eval_build import TWO_LANES, car, rollout, scene, track
from tests.run_records import MINIMAL, run_info


def bad(**changes):
    log = rollout(track(np.arange(4.0), 0.0), [car("a", track(np.arange(4.0) + 20, 0.0))])
    broken = replace(log, **changes)
    return broken, scene(TWO_LANES, log)


def broken_track(index, **values):
    poses = track(np.arange(4.0), 0.0)
    arrays = {"t_us": poses.t_us.copy(), "xyz": poses.xyz.copy(), "quat": poses.quat.copy()}
    for name, value in values.items():
        arrays[name][index] = value
    return Trajectory(**arrays)


@pytest.mark.parametrize(
    ("poses", "text"),
    [
        (broken_track(2, t_us=100_000), "time 100000 us is repeated"),
        (broken_track(3, t_us=50_000), "time 200000 us is followed by the earlier 50000 us"),
        (broken_track(1, xyz=np.nan), "a pose that is not finite at 100000 us"),
        (broken_track(1, quat=np.inf), "a pose that is not finite at 100000 us"),
        (broken_track(2, quat=[2.0, 0, 0, 0]), "a quaternion of length 2 at 200000 us"),
        (
            Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 4))),
            "no pose at all",
        ),
        (
            Trajectory(np.arange(3), np.zeros((2, 3)), np.zeros((3, 4))),
            "3 times, positions of shape (2, 3)",
        ),
    ],
)
@pytest.mark.parametrize("who", ["ego", "ego_log", "actor"])
def test_a_log_with_a_broken_track_is_refused(who, poses, text):
    changes = {"actors": {"a": car("a", poses)}} if who == "actor" else {who: poses}
    with pytest.raises(EvaluatorError) as caught:
        score(*bad(**changes))
    assert text in str(caught.value)
    assert {"ego": "the ego ", "ego_log": "the recorded drive", "actor": "actor 'a'"}[
        who
    ] in caught.value.message
    assert "session 'uuid'" in caught.value.message


def test_a_broken_plan_is_refused_and_named():
    good = track(np.arange(3.0), 0.0, t_us=[0, 100, 200])
    late = track(np.arange(3.0), 0.0, t_us=[300_000, 300_100, 300_100])
    plans = (
        LoggedPlan(0, 100, good, (good, good)),
        LoggedPlan(300_000, 300_100, good, (good, late)),
    )
    with pytest.raises(EvaluatorError) as caught:
        score(*bad(plans=plans))
    assert "the plan at 300000 us" in caught.value.message
    assert "time 300100 us is repeated" in caught.value.message


@pytest.mark.parametrize("box", [Box(0.0, 1.0, 1.0), Box(4.0, -1.0, 1.0), Box(np.nan, 1.0, 1.0)])
def test_a_box_without_size_is_refused(box):
    log, where = bad()
    with pytest.raises(EvaluatorError, match="positive length and width"):
        score(replace(log, actors={"a": car("a", track(0.0, 0.0, n=4), box)}), where)


def test_every_series_states_unit_direction_and_reduction_as_declared():
    log, where = bad()
    found = score(log, where)
    assert len({one.name for one in found}) == len(found)
    for one in found:
        assert one.metric == METRICS.info(one.name)
        assert one.t_us.shape == one.value.shape == one.valid.shape
        assert np.isfinite(one.value[one.valid]).all()
        assert np.isnan(one.value[~one.valid]).all()


def test_an_evaluator_that_raises_is_named_and_its_cause_kept():
    log, where = bad()

    def broken(rollout, scene):
        raise ZeroDivisionError("by zero")

    with pytest.raises(EvaluatorError, match="evaluator 'mine', scene 'scene'") as caught:
        run_evaluator("mine", broken, log, where)
    assert "ZeroDivisionError: by zero" in caught.value.message
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_an_invalid_value_without_a_reason_is_refused():
    log, where = bad()

    def silent(rollout, scene):
        return [series("offroad", rollout.ego.t_us, 0.0, False)]

    with pytest.raises(EvaluatorError, match="4 invalid steps, reason ''"):
        run_evaluator("silent", silent, log, where)


class Again:
    def __call__(self, rollout, scene):
        return [series("offroad", rollout.ego.t_us, 0.0)]


def test_a_metric_given_twice_is_refused():
    log, where = bad()
    with pytest.raises(EvaluatorError, match="metric 'offroad' was given twice"):
        score(log, where, evaluators=resolve_evaluators([f"{__name__}:Again"]))


JERK = MetricInfo(
    "m/s^3", "lower", "max", "largest jerk", label="jerk", margin=0.5, limits=(0.0, None)
)


class Jerky:
    metrics = {"jerk_max": JERK}  # noqa: RUF012 - as a plug-in writes it

    def __call__(self, rollout, scene):
        return [series("jerk_max", rollout.ego.t_us, 2.0)]


class Undeclared:
    def __call__(self, rollout, scene):
        return [series("jerk_max", rollout.ego.t_us, 2.0)]


def test_a_plugins_series_carries_what_its_evaluator_says():
    log, where = bad()
    found = {
        one.name: one
        for one in score(log, where, evaluators=resolve_evaluators([f"{__name__}:Jerky"]))
    }
    assert found["jerk_max"].metric == replace(JERK, name="jerk_max")
    assert rollout_values(list(found.values()))["jerk_max"].unit == "m/s^3"
    assert "jerk_max" not in METRICS


def test_a_metric_nobody_declared_is_refused():
    log, where = bad()
    with pytest.raises(EvaluatorError, match="no evaluator declares it"):
        METRICS.info("jerk_max")
    with pytest.raises(EvaluatorError, match="no evaluator declares it"):
        score(log, where, evaluators=resolve_evaluators([f"{__name__}:Undeclared"]))


def test_a_table_refuses_another_metric_under_a_name_that_it_holds():
    with pytest.raises(EvaluatorError, match="declared already with other facts"):
        METRICS.adding({"offroad": JERK})
    assert METRICS.adding({"jerk": JERK}).adding({"jerk": JERK})["jerk"].accepted == 0.5


def test_a_table_comes_back_from_a_run_folder_as_it_was():
    table = METRICS.adding({"jerk": JERK})
    info = run_info({**MINIMAL, "metrics": {}})
    stored = json.loads(json.dumps(json_of(replace(info, metrics=dict(table))), allow_nan=False))
    assert set(stored["metrics"]["offroad"]) >= {"unit", "direction", "aggregation", "help"}
    assert "name" not in stored["metrics"]["offroad"]
    stored["metrics"]["jerk"]["of a later version"] = 1
    assert dict(MetricTable.of_run(run_info(stored).metrics)) == dict(table)
    assert dict(MetricTable.of_run({})) == dict(METRICS)


def test_two_runs_agree_on_unit_side_and_reduction_and_may_differ_in_words():
    other = METRICS.adding({"jerk": replace(JERK, help="the greatest jerk", label="", margin=1.0)})
    table = METRICS.adding({"jerk": JERK})
    assert table.joined(other, ["jerk"], "a and b")["jerk"].help == "largest jerk"
    assert METRICS.joined(other, ["jerk"], "a and b")["jerk"].help == "the greatest jerk"
    for change in ({"unit": "g"}, {"direction": "higher"}, {"aggregation": "mean"}):
        other = METRICS.adding({"jerk": replace(JERK, **change)})
        assert table.joined(other, ["offroad"], "a and b")
        with pytest.raises(InputError, match="a and b, metric 'jerk'"):
            table.joined(other, ["jerk"], "a and b")


@pytest.mark.parametrize(
    ("name", "values", "differences"),
    [
        ("progress", (0.0, 1.0), (-1.0, 1.0)),
        ("offroad", (0.0, 1.0), (-1.0, 1.0)),
        ("lateral_distance_m", (0.0, np.inf), (-np.inf, np.inf)),
        ("min_ade@3.0s(self)", (0.0, np.inf), (-np.inf, np.inf)),
        ("lateral_bias_m", (-np.inf, np.inf), (-np.inf, np.inf)),
    ],
)
def test_a_metric_knows_the_range_of_its_values_and_of_their_differences(name, values, differences):
    assert (METRICS.info(name).value_range, METRICS.info(name).difference_range) == (
        values,
        differences,
    )
