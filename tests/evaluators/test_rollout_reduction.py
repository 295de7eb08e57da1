"""Which steps count, and what a rollout comes to."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import EvaluatorError
from evaluators import PRESETS, reduce_rollout, rollout_values
from evaluators.metrics.score import series

T = np.arange(6, dtype=np.int64) * 100_000
PAPER = PRESETS["paper"]


def table(**values):
    """Series on six steps; the policy drives from step 2 on unless said otherwise."""
    columns = {
        "eval_relevant": [0, 0, 1, 1, 1, 1],
        "collision_any": 0.0,
        "collision_at_fault": 0.0,
        "offroad": 0.0,
    } | values
    return [one if hasattr(one, "valid") else series(name, T, one) for name, one in columns.items()]


def value(name, **columns):
    return rollout_values(table(**columns))[name]


def test_warm_up_steps_are_dropped():
    assert value("collision_any", collision_any=[1, 1, 0, 0, 0, 0]).value == 0.0
    assert value("route_distance_m", route_distance_m=[9, 9, 1, 2, 3, 4]).value == pytest.approx(
        2.5
    )


def test_steps_after_the_first_event_are_dropped_and_its_own_step_stays():
    columns = {
        "offroad": [0, 0, 0, 1, 0, 0],
        "collision_any": [0, 0, 0, 0, 1, 1],
        "route_distance_m": [0, 0, 1, 3, 100, 100],
    }
    assert value("offroad", **columns).value == 1.0
    assert value("collision_any", **columns).value == 0.0
    assert value("route_distance_m", **columns).value == pytest.approx(2.0)
    ledger = reduce_rollout(table(**columns)).ledger
    assert (
        ledger.steps_total,
        ledger.steps_warmup,
        ledger.steps_after_event,
        ledger.steps_scored,
    ) == (6, 2, 2, 2)


def test_any_contact_ends_the_rollout_a_rear_hit_too():
    columns = {
        "collision_any": [0, 0, 1, 1, 1, 1],
        "collision_rear": [0, 0, 1, 0, 0, 0],
        "collision_at_fault": [0, 0, 0, 1, 1, 1],
    }
    assert value("collision_at_fault", **columns).value == 0.0
    assert value("collision_rear", **columns).value == 1.0


def test_an_event_in_the_warm_up_ends_nothing():
    ledger = reduce_rollout(table(offroad=[1, 1, 0, 0, 0, 0])).ledger
    assert ledger.steps_scored == 4


def test_both_events_in_one_step_count():
    columns = {"offroad": [0, 0, 0, 1, 0, 0], "collision_any": [0, 0, 0, 1, 0, 0]}
    assert value("offroad", **columns).value == value("collision_any", **columns).value == 1.0
    assert value("offroad_or_collision", **columns).value == 1.0


def test_reductions_follow_the_metric():
    columns = {
        "dist_to_gt_trajectory": [9, 9, 1, 2, 4, 3],
        "min_distance_to_obstacle_m": [0, 0, 5, 3, 4, 6],
        "progress": [0, 0, 0.1, 0.2, 0.3, 0.4],
    }
    values = rollout_values(table(**columns))
    assert values["dist_to_gt_trajectory"].value == 4.0
    assert values["min_distance_to_obstacle_m"].value == 3.0
    assert values["progress"].value == pytest.approx(0.4)
    assert values["duration_frac_20s"].value == pytest.approx(0.3 / 20)


def test_a_flag_that_may_have_fired_where_it_is_unknown_is_unknown_and_never_zero():
    unknown = series("offroad", T, 0.0, np.array([True, True, True, False, True, True]), "no edges")
    one = value("offroad", offroad=unknown)
    assert (one.value, one.valid, one.reason) == (None, False, "no edges")
    combined = value("offroad_or_collision", offroad=unknown)
    assert (combined.value, combined.reason) == (None, "no edges")


def test_a_flag_that_fired_is_one_whatever_else_is_unknown():
    fired = series(
        "offroad",
        T,
        [0, 0, 1, 0, 0, 0],
        np.array([True, True, True, False, True, True]),
        "no edges",
    )
    assert value("offroad", offroad=fired).value == 1.0
    either = value(
        "offroad_or_collision",
        offroad=series("offroad", T, 0.0, False, "no map"),
        collision_any=[0, 0, 0, 1, 0, 0],
    )
    assert either.value == 1.0


def test_gaps_of_steps_without_actors_are_skipped():
    gap = series(
        "min_distance_to_obstacle_m",
        T,
        [0, 0, 7, 8, np.inf, np.inf],
        np.array([1, 1, 1, 1, 0, 0], dtype=bool),
        "nobody",
    )
    assert value("min_distance_to_obstacle_m", min_distance_to_obstacle_m=gap).value == 7.0


def test_a_last_value_that_is_invalid_is_not_replaced_by_an_earlier_one():
    one = series("progress", T, 0.5, np.array([1, 1, 1, 1, 1, 0], dtype=bool), "gone")
    assert (value("progress", progress=one).value, value("progress", progress=one).reason) == (
        None,
        "gone",
    )


def test_metrics_on_their_own_time_line_are_cut_by_time():
    t = np.array([150_000, 200_000, 400_000], dtype=np.int64)
    own = series("plan_deviation", t, [9.0, 1.0, 5.0])
    assert value("plan_deviation", plan_deviation=own).value == pytest.approx(3.0)
    assert value(
        "plan_deviation", plan_deviation=own, offroad=[0, 0, 0, 1, 0, 0]
    ).value == pytest.approx(1.0)


def test_events_give_the_first_time_of_each_kind_among_the_scored_steps():
    columns = {
        "offroad": [1, 0, 0, 0, 1, 1],
        "collision_front": [0, 0, 0, 0, 1, 0],
        "collision_rear": [0, 0, 0, 0, 0, 1],
    }
    found = reduce_rollout(table(**columns, collision_any=[0, 0, 0, 0, 1, 1])).events
    assert [(e["metric"], e["t_us"]) for e in found] == [
        ("collision_front", 400_000),
        ("offroad", 400_000),
    ]


def test_a_rollout_without_handover_has_no_value_unless_the_preset_scores_replays():
    columns = {"eval_relevant": 0.0, "offroad": [0, 1, 0, 0, 0, 0]}
    assert value("offroad", **columns).value is None
    whole = rollout_values(table(**columns), replace(PAPER, replay_is_scored=True))
    assert whole["offroad"].value == 1.0


def test_the_paper_has_no_cut_at_four_metres_and_a_preset_may():
    columns = {"dist_to_gt_trajectory": [0, 0, 1, 5, 6, 7], "collision_any": [0, 0, 0, 0, 1, 0]}
    assert value("collision_any", **columns).value == 1.0
    cut = reduce_rollout(table(**columns), replace(PAPER, stop_beyond_gt_m=4.0))
    assert cut.values["collision_any"].value == 0.0
    assert cut.values["dist_to_gt_trajectory"].value == 5.0
    assert (
        cut.ledger.steps_scored,
        cut.ledger.steps_after_event,
        cut.ledger.steps_after_drift,
    ) == (2, 1, 1)


def test_black_images_remove_the_rollout_only_where_the_preset_says_so():
    columns = {"img_is_black": [0, 0, 0, 0, 0, 1]}
    assert value("offroad", **columns).value == 0.0
    dropped = reduce_rollout(table(**columns), replace(PAPER, drop_black=True))
    assert dropped.values["offroad"].value is None
    assert dropped.ledger.dropped == "dropped: a camera image is black in the scored part"
    kept = reduce_rollout(table(img_is_black=[1, 1, 0, 0, 0, 0]), replace(PAPER, drop_black=True))
    assert kept.values["offroad"].value == 0.0


def test_series_without_eval_relevant_are_refused():
    with pytest.raises(EvaluatorError, match="no eval_relevant"):
        rollout_values([series("offroad", T, 0.0)])


def test_unknown_steps_in_the_warm_up_do_not_matter():
    one = series("offroad", T, 0.0, np.array([False, True, True, True, True, True]), "no edges")
    assert value("offroad", offroad=one).value == 0.0
