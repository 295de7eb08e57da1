"""The paper's names: null with a reason without the user's detections or weights, and detections
read from JSON.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.learned_metrics.cuboids import cuboid_f1
from alpasim_plugin.lab.learned_metrics.damage import KINDS, STRENGTHS, damaged, in_order
from alpasim_plugin.lab.learned_metrics.external import read_detections
from alpasim_plugin.lab.learned_metrics.facts import CLIP_FACTS, PAPER, SET_FACTS, paper_cells

BOX = {"label": "car", "score": 0.7, "box": [0.0, 1.0, 12.0, 4.0, 2.0, 4.0, -1.57]}
LANE = {"score": 0.8, "points": [[3.0, 1.7], [30.0, 1.9]]}


def write(path: Path, **changes: Any) -> Path:
    document = {
        "detector": "D",
        "weights_sha256": "ab",
        "size": [256, 144],
        "K": [[100, 0, 128], [0, 100, 72], [0, 0, 1]],
        "frames": [{"frame": 1, "cuboids": [BOX], "lanes": [LANE]}],
    }
    path.write_text(json.dumps({**document, **changes}))
    return path


def test_without_the_users_weights_every_cell_of_the_paper_is_null_with_a_reason() -> None:
    cells = paper_cells({})
    assert set(cells) == set(PAPER)
    assert all(cell["value"] is None and cell["reason"] for cell in cells.values())
    assert cells["cuboid_f1"]["reason"] == "no_detections: a detector's boxes in --detections"


def test_no_metric_of_ours_has_a_name_of_the_papers() -> None:
    ours = {name.lower() for name in (*CLIP_FACTS, *SET_FACTS)}
    assert not ours & {*PAPER, "fvd", "fvmd", "lpips", "dists", "cuboid_f1", "lane_f1"}
    assert all(name.endswith("_lk") or "_syn" in name for name in ours)


def test_a_value_fills_its_own_cell_only() -> None:
    cells = paper_cells({"fvd_clip": 410.0, "fd_syn_clip": 3.0})
    assert cells["fvd_clip"] == {"value": 410.0, "reason": None}
    assert cells["fvd_16"]["value"] is None


def test_detections_are_read_frame_by_frame(tmp_path: Path) -> None:
    found = read_detections(write(tmp_path / "a.json"), frames=3)
    assert [len(c) for c in found.cuboids] == [0, 1, 0]
    assert found.size == (144, 256)
    assert found.K is not None
    assert found.lanes[1][0].lateral_m[0] == pytest.approx(1.7)
    assert np.isnan(found.lanes[1][0].lateral_m[14])  # 31 m: beyond what was seen
    assert cuboid_f1(found.cuboids, found.cuboids, found.K, found.size) == 1.0


def test_boxes_that_stand_on_their_origin_are_lifted(tmp_path: Path) -> None:
    found = read_detections(write(tmp_path / "a.json", origin="bottom"), frames=2)
    assert found.cuboids[1][0].y_m == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"frames": [{"frame": 0}, {"frame": 0}]}, "list every frame once"),
        ({"frames": [{"frame": 9}]}, "of a clip of 3"),
        (
            {"frames": [{"frame": 0, "cuboids": [{**BOX, "box": [0, 0, 1]}]}]},
            "not a detector's results",
        ),
        ({"frames": [{"frame": 0, "lanes": [{"score": 1.0, "points": []}]}]}, "without points"),
        ({"detector": None, "frames": 3}, "not a detector's results"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_detections(write(tmp_path / "a.json", **change), frames=3)


def test_damage_keeps_the_length_and_grows() -> None:
    rng = np.random.default_rng(0)
    clip = rng.integers(0, 255, (20, 16, 24, 3)).astype(np.uint8)
    for kind in KINDS:
        changed = [
            float(np.abs(damaged(clip, kind, s).astype(int) - clip).mean()) for s in STRENGTHS[kind]
        ]
        assert damaged(clip, kind, STRENGTHS[kind][0]).shape == clip.shape
        assert changed[0] > 0
        if kind != "drop":  # of a random clip, any dropping changes all later frames
            assert in_order(changed, lower_is_better=True)
    assert np.array_equal(damaged(clip, "drop", 1.0)[:10], clip[::2])
    assert np.array_equal(damaged(clip, "drop", 1.0)[10:12], clip[16:12:-2])
