"""The rules of later AlpaSim (commit 6f1029c) in preset ``alpasim@6f1029c``; its own tests and its
code gave the numbers.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.types import Trajectory
from evaluators import METRICS, PRESETS, preset, reduce_rollout, score
from evaluators.alpasim import (
    EvalSettings,
    ScoredRollout,
    load_settings,
    over_sweeps,
    reduce_run,
    results_summary,
    scene_score,
)
from evaluators.alpasim.settings import Modifiers, SceneScoreSettings
from evaluators.metrics.route import from_corridor, to_path
from tests.evaluators.eval_build import (
    TWO_LANES,
    by_name,
    lane,
    road_map,
    rollout,
    scene,
    track,
    values_of,
)
from tests.evaluators.golden import scored

NOW = PRESETS["alpasim"]
LATER = PRESETS["alpasim@6f1029c"]
RECORDED = track(np.linspace(0.0, 50.0, 51), 0.0)


@pytest.mark.parametrize(
    ("path", "at", "away_m"),
    [  # AlpaSim's tests/test_ground_truth_corridor.py
        ([(0, 0), (50, 0)], (56.0, 0.0), 0.0),
        ([(0, 0), (50, 0)], (70.0, 0.0), 0.0),
        ([(0, 0), (50, 0)], (25.0, 4.5), 4.5),
        ([(0, 0), (50, 0)], (56.0, 5.0), 5.0),
        ([(0, 0), (0, 0)], (3.0, 4.0), 5.0),
        ([(0, 0), (50, 0)], (-6.0, 0.0), 6.0),  # its near end does not go on
        ([(0, 0), (50, 0), (50, 0)], (56.0, 0.0), 6.0),  # nor a far end without direction
    ],
)
def test_distance_to_the_side_ignores_what_was_driven_past_the_end(path, at, away_m):
    line = np.array(path, dtype=float)
    point = np.array([at])
    distance_m, s = to_path(line, point)
    assert from_corridor(line, s, point, distance_m) == pytest.approx([away_m])


def drift(y_end, x_end=50.0):
    ego = track(np.linspace(0.0, x_end, 51), np.linspace(0.0, y_end, 51))
    return rollout(ego, log=RECORDED, warmup_us=500_000)


def values(log, chosen, road=TWO_LANES):
    return {name: one.value for name, one in values_of(log, road, chosen).items()}


def test_leaving_the_path_to_the_side_is_a_fault_and_passing_its_end_is_none():
    drifted = values(drift(4.6), LATER)
    ahead = values(drift(0.0, 61.0), LATER)
    assert drifted["left_corridor_laterally"] == 1.0
    assert drifted["lateral_dist_to_gt_trajectory"] == pytest.approx(
        4.048, abs=1e-3
    )  # of the first row beyond 4 m; later ones are dropped
    assert ahead["left_corridor_laterally"] == 0.0
    assert ahead["dist_to_gt_trajectory"] == pytest.approx(
        4.9
    )  # that one ends the rollout's rows under both versions
    assert "left_corridor_laterally" not in values(drift(4.6), NOW)
    settings = SceneScoreSettings()
    assert scene_score(drifted, settings).failure_reason == "left_corridor_laterally"
    assert (scene_score(drifted, settings).score, scene_score(ahead, settings).score) == (0.0, 1.0)
    assert scene_score(values(drift(4.6), NOW), settings).score > 0.9


def test_progress_is_a_share_of_what_the_recording_reaches():
    # The recording speeds up; the rollout ends a step before it does, as AlpaSim's whole steps make
    # it.
    recorded = track(np.arange(60.0) ** 2 / 50, 0.0)
    ego = Trajectory(recorded.t_us[:-1], recorded.xyz[:-1], recorded.quat[:-1])
    found = [values(rollout(ego, log=recorded), chosen) for chosen in (NOW, LATER)]
    assert found[0]["progress_clipped_rel"] == pytest.approx(58**2 / 59**2)
    assert (
        found[1]["progress_clipped_rel"] == found[1]["progress_rel_to_total"] == pytest.approx(1.0)
    )
    assert found[1]["progress"] == pytest.approx(58**2 / 59**2)
    faster = Trajectory(ego.t_us, ego.xyz * [1.01, 1.0, 1.0], ego.quat)
    assert values(rollout(faster, log=recorded), LATER)["progress_clipped_rel"] == pytest.approx(
        1.01, abs=1e-3
    )  # not cut to 1


def test_a_road_edge_overhead_is_not_touched():
    def edge(y, z):
        x = np.arange(-50.0, 200.0, 2.0)
        return np.column_stack([x, np.full_like(x, y), np.full_like(x, z)])

    log = rollout(track(np.linspace(0, 20, 21), -1.5))  # beside the lane, across y = -1.75
    deck = road_map(lane("right", 0.0), edges=[edge(-1.75, 6.0), edge(-9.0, 0.0)])
    kerb = road_map(lane("right", 0.0), edges=[edge(-1.75, 2.0), edge(-9.0, 0.0)])
    far = road_map(lane("right", 0.0), edges=[edge(-1.75, 60.0)])
    off = [
        [by_name(score(log, scene(road, log), one))["offroad"].value.max() for one in (NOW, LATER)]
        for road in (deck, kerb, far)
    ]
    assert off == [[1.0, 0.0], [1.0, 1.0], [1.0, 0.0]]


def test_settings_and_result_files_name_the_version():
    chosen = EvalSettings(aggregation_modifiers=Modifiers(max_dist_to_gt_trajectory=2.0)).preset(
        LATER
    )
    assert (chosen.name, chosen.corridor, chosen.stop_beyond_gt_m) == ("alpasim@6f1029c", True, 2.0)
    assert "6f1029c" in str(preset("alpasim@6f1029c").as_dict()["reproduces"])
    assert "3032e0c" in str(NOW.reproduces)
    log = drift(4.6)
    for one, shown in ((NOW, False), (LATER, True)):
        series = tuple(score(log, scene(TWO_LANES, log), one))
        black = next(s for s in series if s.name == "offroad")
        series = (*series, replace(black, metric=METRICS["img_is_black"], value=0 * black.value))
        reduced = reduce_run([ScoredRollout("scene", "a", series)], one)
        summary = results_summary(
            reduced, {}, [{"rollout_id": "b"}], over_sweeps(reduced), SceneScoreSettings()
        )
        assert ("left_corridor_laterally" in summary["score_criteria"]) == shown
        assert ("left_corridor_laterally" in summary["rollouts"][1]["score_metrics"]) == shown


@pytest.mark.parametrize(
    ("name", "rollout_id", "score_there", "reason", "lateral_m", "progress", "clipped"),
    [  # AlpaSim's evaluation with the files of 6f1029c, on logs that its runtime wrote
        (
            "drift-a",
            "d796f5c0-e557-11f1-bfca-02fc00000001",
            0.0,
            "left_corridor_laterally",
            4.259358,
            0.426836,
            0.579653,
        ),
        (
            "standstill-c",
            "c15fd60a-e557-11f1-ade6-02fc00000001",
            0.0,
            "left_corridor_laterally",
            4.14875,
            1.0,
            1.0,
        ),
        (
            "seam-c",
            "b5500b0a-e557-11f1-8adf-02fc00000001",
            0.0,
            "offroad",
            2.187058,
            0.335811,
            0.397196,
        ),
        (
            "lane-change-a",
            "b9155f60-e557-11f1-b1de-02fc00000001",
            1.0,
            None,
            3.61542,
            0.787192,
            1.069075,
        ),
        (
            "standstill-a",
            "d6261e14-e557-11f1-88ac-02fc00000001",
            1.0,
            None,
            1e-06,
            0.603732,
            0.964489,
        ),
    ],
)
def test_golden_logs_have_the_values_of_the_later_code(
    shared_data, name, rollout_id, score_there, reason, lateral_m, progress, clipped
):
    folder = shared_data / "alpasim-golden"
    scene_id = f"synthetic-{name}"
    log = folder / "rollouts" / scene_id / rollout_id / "rollout.asl"
    settings = load_settings(folder / "eval-config.yaml")
    chosen = settings.preset(LATER)
    found = {
        key: one.value
        for key, one in reduce_rollout(
            scored(log, folder / "scenes" / f"{scene_id}.usdz", chosen), chosen
        ).values.items()
    }
    got = [
        found[key] for key in ("lateral_dist_to_gt_trajectory", "progress", "progress_clipped_rel")
    ]
    assert got == pytest.approx([lateral_m, progress, clipped], abs=1e-5)
    result = scene_score(found, settings.scene_score)
    assert (result.score, result.failure_reason) == (score_there, reason)
