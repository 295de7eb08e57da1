"""AlpaSim's aggregation: its own tables and summaries of the golden runs, and its rules on
hand-made rollouts.
"""

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.core.errors import EvaluatorError, InputError
from evaluators import PRESETS
from evaluators.alpasim import (
    ScoredRollout,
    load_settings,
    metrics_results_table,
    metrics_unprocessed_table,
    over_sweeps,
    reduce_run,
    results_summary,
    scene_score,
)
from evaluators.alpasim.settings import SceneScoreSettings
from evaluators.metrics.score import series
from tests.evaluators.golden import RUN, SETS, close, golden_set

ALPASIM = PRESETS["alpasim"]


def same(got, want, path=""):
    """List where two documents differ; numbers to 1e-4 absolute or 1e-5 relative."""
    if isinstance(want, dict) and isinstance(got, dict):
        odd = [f"{path}/{key}" for key in set(got) ^ set(want)]
        return odd + [
            line
            for key in set(got) & set(want)
            for line in same(got[key], want[key], f"{path}/{key}")
        ]
    if isinstance(want, list) and isinstance(got, list) and len(want) == len(got):
        return [
            line
            for i, (a, b) in enumerate(zip(got, want, strict=True))
            for line in same(a, b, f"{path}[{i}]")
        ]
    if isinstance(want, float) and isinstance(got, float):
        return [] if close(got, want) else [f"{path}: {got} for {want}"]
    return [] if got == want and type(got) is type(want) else [f"{path}: {got!r} for {want!r}"]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name, marks=[pytest.mark.slow] if name in ("rollouts", "other-settings") else []
        )
        for name in SETS
    ],
)
def test_golden_runs_give_alpasims_tables(shared_data, name):
    one = golden_set(shared_data / "alpasim-golden", name)
    run = one.run()
    assert len(run) == {"rollouts": 46, "other-settings": 22}.get(name, 2)
    reduced = reduce_run(run, one.settings.preset())
    sweeps = over_sweeps(reduced)
    want = pq.read_table(one.folder / one.aggregate / "metrics_results.parquet")
    assert same(metrics_results_table(sweeps, run).to_pylist(), want.to_pylist()) == []
    marks = {}
    if one.settings.scene_score.enabled:
        marks = {
            i: scene_score(r.values, one.settings.scene_score)
            for i, r in enumerate(reduced)
            if not r.dropped
        }
    failures = one.folder / "failed_rollouts.json"
    failed = json.loads(failures.read_text()) if failures.exists() else ()
    summary = results_summary(reduced, marks, failed, sweeps, one.settings.scene_score)
    expected = json.loads((one.folder / one.aggregate / "results-summary.json").read_text())
    assert same(json.loads(json.dumps(summary, allow_nan=False)), expected) == []


@pytest.mark.parametrize("case", ["no-map", "no-road-edges"])
def test_runs_that_alpasim_stops_at_stop_here_with_the_same_metric(shared_data, case):
    one = golden_set(shared_data / "alpasim-golden", case)
    run = one.run()
    reduced = reduce_run(run, one.settings.preset())
    want = pq.read_table(one.folder / "aggregate-partial" / "metrics_results.parquet")
    assert (
        same(metrics_results_table(over_sweeps(reduced), run).to_pylist(), want.to_pylist()) == []
    )
    stops = reduced[
        -1
    ]  # in the run without edges the first rollout stays in its lane and has a score
    with pytest.raises(EvaluatorError, match="'offroad'"):
        scene_score(stops.values, load_settings(one.folder / "eval-config.yaml").scene_score)
    assert "'offroad'" in json.loads((one.folder / "expected_failure.json").read_text())["error"]


# --- by hand


def rollout(name, scene="s", n=4, absent=(), **values):
    """A rollout of n steps in which nothing happens, except for what is given as a number or one
    number a step.
    """
    line = np.arange(n, dtype=np.int64) * 100_000
    columns = dict.fromkeys(
        ("collision_any", "collision_front", "collision_lateral", "collision_rear", "offroad"), 0.0
    )
    columns |= {
        "img_is_black": 0.0,
        "dist_to_gt_trajectory": 0.0,
        "eval_relevant": 1.0,
        "progress": 0.5,
        "dist_traveled_m": 100.0,
    }
    columns |= {"gt_dist_traveled_m": 50.0} | values
    made = [
        series(key, line, np.broadcast_to(np.asarray(value, dtype=float), n))
        for key, value in columns.items()
        if key not in absent
    ]
    return ScoredRollout(scene, name, tuple(made), *RUN)


def table(*rollouts):
    return over_sweeps(reduce_run(rollouts, ALPASIM))


def test_rollouts_are_paired_by_the_rank_of_their_names_and_spread_over_sweeps():
    row = table(
        rollout("b", "s1", progress=0.2),
        rollout("a", "s1", progress=0.6),
        rollout("x", "s2", progress=0.8),
        rollout("y", "s2"),
    )
    # Sweeps: (a, x) and (b, y).
    assert row["progress"] == pytest.approx((0.7 + 0.35) / 2)
    assert row["progress_std"] == pytest.approx(np.std([0.7, 0.35], ddof=1))
    assert (row["n_clips"], row["n_clips_std"], row["n_rollouts"]) == (2.0, 0.0, 2)


def test_a_dropped_rollout_makes_the_number_of_clips_a_fraction():
    row = table(
        rollout("a", "s1"),
        rollout("b", "s1"),
        rollout("a", "s2", img_is_black=[0, 1, 0, 0]),
        rollout("b", "s2"),
    )
    assert (row["n_clips"], row["n_rollouts"]) == (1.5, 2)


def test_distances_between_incidents_are_kilometres_and_infinite_without_one():
    hit = rollout(
        "a",
        "s1",
        collision_any=[0, 0, 1, 1],
        collision_rear=[0, 0, 1, 1],
        dist_traveled_m=[0, 100, 300, 900],
    )
    row = table(hit, rollout("a", "s2"))
    assert row["avg_dist_between_incidents"] == pytest.approx((300 + 100) / 1000)
    assert row["avg_dist_between_incidents_at_fault"] == np.inf
    assert row["avg_dist_between_incidents_std"] is None  # one sweep has no spread


def test_without_any_map_offroad_counts_as_none_and_has_no_column():
    one, two = reduce_run(
        [rollout("a", absent=("offroad",)), rollout("b", absent=("offroad",), collision_any=1.0)],
        ALPASIM,
    )
    assert "offroad" not in one.values
    assert (one.values["offroad_or_collision"], two.values["offroad_or_collision"]) == (0.0, 1.0)


def test_a_map_in_some_rollouts_only_leaves_the_others_unknown_unless_they_collide():
    parts = [
        rollout("a"),
        rollout("b", absent=("offroad",)),
        rollout("c", absent=("offroad",), collision_any=[0, 0, 1, 0]),
    ]
    _, quiet, hit = reduce_run(parts, ALPASIM)
    assert quiet.values["offroad"] is quiet.values["offroad_or_collision"] is None
    assert (hit.values["offroad"], hit.values["offroad_or_collision"]) == (None, 1.0)


def test_no_camera_image_in_any_log_stops_the_aggregation():
    with pytest.raises(EvaluatorError, match="no image of camera"):
        reduce_run([rollout("a", absent=("img_is_black",))], ALPASIM)
    kept = reduce_run([rollout("a"), rollout("b", absent=("img_is_black",))], ALPASIM)
    assert kept[1].values["img_is_black"] is None


def test_two_rollouts_of_a_scene_with_one_name_are_refused():
    with pytest.raises(InputError, match="two rollouts named 'a'"):
        table(rollout("a"), rollout("a"))


def test_nothing_left_gives_no_row():
    assert table(rollout("a", img_is_black=1.0)) == {}


def test_unprocessed_steps_keep_order_and_a_row_for_an_empty_metric():
    one = rollout("a", n=2)
    empty = replace(
        one,
        series=(*one.series, series("plan_deviation", np.zeros(0, dtype=np.int64), np.zeros(0))),
    )
    rows = metrics_unprocessed_table([empty]).to_pylist()
    assert [row["timestamps_us"] for row in rows if row["name"] == "progress"] == [0, 100_000]
    (placeholder,) = (row for row in rows if row["name"] == "plan_deviation")
    assert placeholder["timestamps_us"] is None
    assert placeholder["time_aggregation"] == "mean"


SCORED = {
    "progress_clipped_rel": 0.6,
    "gt_dist_traveled_m": 50.0,
    "collision_at_fault": 0.0,
    "offroad": 0.0,
}


@pytest.mark.parametrize(
    ("changes", "score", "reason"),
    [
        ({}, 0.75, None),
        ({"progress_clipped_rel": 0.8}, 1.0, None),
        ({"progress_clipped_rel": 1.4}, 1.0, None),
        ({"progress_clipped_rel": -0.1}, 0.0, None),
        ({"progress_clipped_rel": 0.1, "gt_dist_traveled_m": 4.99}, 1.0, None),
        ({"progress_clipped_rel": 0.1, "gt_dist_traveled_m": 5.0}, 0.125, None),
        ({"collision_at_fault": 1.0, "offroad": 1.0}, 0.0, "collision_at_fault"),
        ({"offroad": 1.0, "gt_dist_traveled_m": 1.0}, 0.0, "offroad"),
    ],
)
def test_scene_score(changes, score, reason):
    found = scene_score(SCORED | changes, SceneScoreSettings())
    assert (found.score, found.failure_reason, found.passed) == (
        pytest.approx(score),
        reason,
        reason is None,
    )


@pytest.mark.parametrize("value", [None, np.nan, np.inf])
def test_no_scene_score_without_its_metrics(value):
    with pytest.raises(EvaluatorError, match="progress_clipped_rel"):
        scene_score(SCORED | {"progress_clipped_rel": value}, SceneScoreSettings())


def test_settings_name_the_nearest_key_and_refuse_senseless_values(tmp_path):
    path = tmp_path / "eval.yaml"
    path.write_text("scorers:\n  min_ade:\n    time_delta: [1.0]\n")
    with pytest.raises(InputError, match="time_deltas"):
        load_settings(path)
    path.write_text("scene_score: {progress_saturation_threshold: 0}\n")
    with pytest.raises(InputError, match="progress_saturation_threshold"):
        load_settings(path)
    for senseless in ("-1", "0.0", ".nan"):
        path.write_text(f"scorers: {{min_ade: {{time_deltas: [0.5, {senseless}]}}}}\n")
        with pytest.raises(InputError):
            load_settings(path)
    path.write_text(
        "video: {render_video: true}\nscorers: {min_ade: {target: SELF, time_deltas: [0.4]}}\n"
    )
    chosen = load_settings(path).preset()
    assert (chosen.min_ade_target, chosen.min_ade_horizons_s, chosen.stop_beyond_gt_m) == (
        "self",
        (0.4,),
        4.0,
    )
