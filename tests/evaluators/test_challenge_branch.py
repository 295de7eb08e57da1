"""Scene scores against those that AlpaSim's branch ``e2e_challenge`` (commit 9177bd0) gave the same
logs, and the comparison that counts what differs.
"""

import json
import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from evaluators import PRESETS
from evaluators.alpasim import ScoredRollout, load_settings, reduce_run, scene_score
from tests.evaluators.golden import RUN, compare_with, scored


def score_of(folder, scene, rollout, version):
    """Return the scene score of a golden log and why it failed; None where it is dropped."""
    settings = load_settings(folder / "eval-config.yaml")
    chosen = settings.preset(PRESETS[version])
    log = folder / "rollouts" / scene / rollout / "rollout.asl"
    series = scored(log, folder / "scenes" / f"{scene}.usdz", chosen)
    (reduced,) = reduce_run([ScoredRollout(scene, rollout, series, *RUN)], chosen)
    if reduced.dropped:
        return None
    result = scene_score(reduced.values, settings.scene_score)
    return result.score, result.failure_reason


@pytest.mark.parametrize(
    ("name", "rollout", "score", "reason"),
    [
        # cut where it is 4 m from the recording, before it touches a car
        ("drift-a", "d796f5c0-e557-11f1-bfca-02fc00000001", 0.533545013, None),
        # samples shorter than the longest horizon: no minADE, and scored all the same
        ("plans-a", "da56072e-e557-11f1-88ac-02fc00000001", 0.799134504, None),
        ("curve-offroad-c", "b01ddf36-e557-11f1-8adf-02fc00000001", 0.0, "offroad"),
        ("front-brake-a", "a8d4dc2a-e557-11f1-88ac-02fc00000001", 0.0, "collision_at_fault"),
        # touched from behind: not at fault
        ("rear-hit-a", "e40362fe-e556-11f1-8b22-02fc00000001", 0.511345618, None),
        # the recording is shorter than 5 m
        ("standstill-c", "c15fd60a-e557-11f1-ade6-02fc00000001", 1.0, None),
    ],
)
def test_golden_logs_have_the_scene_scores_of_the_challenges_branch(
    shared_data, name, rollout, score, reason
):
    folder = shared_data / "alpasim-golden"
    score_here = score_of(folder, f"synthetic-{name}", rollout, "alpasim")
    assert score_here == (pytest.approx(score, abs=1e-6), reason)


def test_where_the_branch_scores_otherwise_is_named(shared_data):
    folder = shared_data / "alpasim-golden"
    black = "synthetic-black-frame-a", "c3ea9c98-e557-11f1-9e01-02fc00000001"
    assert score_of(folder, *black, "alpasim") is None  # 1.0 there: black images drop nothing
    drifts = "synthetic-drift-a", "d796f5c0-e557-11f1-bfca-02fc00000001"
    later = score_of(folder, *drifts, "alpasim@6f1029c")  # 0.53 there: no such fault
    assert later == (0.0, "left_corridor_laterally")


def test_the_comparison_with_another_version_counts_each_value_and_row_that_differs(
    shared_data, tmp_path
):
    folder = shared_data / "alpasim-golden"
    scene, rollout = "synthetic-cut-in-c", "ac8e6f7a-e557-11f1-8adf-02fc00000001"
    shutil.copy(folder / "eval-config.yaml", tmp_path)
    (tmp_path / "rollouts" / scene / rollout).mkdir(parents=True)
    (tmp_path / "aggregate").mkdir()
    table = pq.read_table(folder / "rollouts" / scene / rollout / "expected_metrics.parquet")
    rows = table.to_pydict()
    progress = [i for i, name in enumerate(rows["name"]) if name == "progress"]
    rows["values"][progress[3]] += 0.01
    kept = [i for i in range(len(table)) if i != progress[5]]
    changed = pa.table({name: [column[i] for i in kept] for name, column in rows.items()})
    pq.write_table(changed, tmp_path / "rollouts" / scene / rollout / "metrics.parquet")
    score = {"clipgt_id": scene, "rollout_id": rollout, "score": 0.5}
    (tmp_path / "aggregate/results-summary.json").write_text(json.dumps({"rollouts": [score]}))
    compared = compare_with(folder, tmp_path)
    assert compared.unequal == {"progress": 1}
    assert compared.only == {("ours", "progress"): 1}
    assert compared.unequal_scores == [(scene, rollout, 0.5, 0.0)]
    assert compared.values > 500
