"""Judges over clips: values, features, sets, the user's detections, and the table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import CameraSpec
from alpasim_plugin.lab.bench.judged import (
    MOTION,
    Judging,
    camera_of,
    judge_clip,
    judge_sets,
    paper_row,
)
from alpasim_plugin.lab.learned_metrics.facts import FD_16, FD_CLIP, FVMD_LK
from alpasim_plugin.lab.learned_metrics.nets.files import (
    NAMES,
    file_name,
    freeze,
    save_judge,
    untrained,
)
from alpasim_plugin.lab.learned_metrics.table import judged_markdown
from tests.lab.training.pair_files import make, pair

MOUNT = np.array(
    [[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
)
CAMERA = CameraSpec("camera", 48, 32, np.array([[30.0, 0, 24], [0, 30.0, 16], [0, 0, 1]]), MOUNT)
CLEAN = np.stack([pair(i).rgb_gt for i in range(17)])
LANE = {"score": 0.9, "points": [[3.0, 1.7], [40.0, 1.7]]}
CAR = {"label": "car", "score": 0.7, "box": [0.0, 0.0, 12.0, 4.0, 2.0, 4.0, -1.57]}


def write_detections(folder: Path, variant: str, lane: dict[str, Any], detector: str = "D") -> None:
    frames = [{"frame": i, "cuboids": [CAR], "lanes": [lane]} for i in range(17)]
    document = {
        "detector": detector,
        "weights_sha256": "ab",
        "size": [48, 32],
        "K": CAMERA.K.tolist(),
        "frames": frames,
    }
    (folder / variant).mkdir(parents=True, exist_ok=True)
    (folder / variant / "a.json").write_text(json.dumps(document))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frozen judges that were never trained: what is tested here holds for any."""
    path = tmp_path_factory.mktemp("judges")
    torch.manual_seed(0)
    for name in NAMES:
        save_judge(path / file_name(name, 0), name, untrained(name), {})
    freeze(path)
    return path


@pytest.mark.slow
def test_a_clip_against_itself_is_without_error_and_has_features_of_every_kind(
    folder: Path,
) -> None:
    values, features = judge_clip("a", "3dgs", CLEAN, CLEAN, CAMERA, Judging((0,), folder=folder))
    assert {name: values[name] for name in values if "f1" in name} == {
        name: 1.0 for name in values if "f1" in name
    }
    assert all(value == 0.0 for name, value in values.items() if "xerr" in name)
    assert {key: x.shape for key, x in features.items()} == {
        MOTION: (1, 1024),
        "windows-0": (1, 128),
    }
    assert np.isfinite(features["windows-0"]).all()


def test_a_users_detector_fills_the_papers_names(tmp_path: Path) -> None:
    write_detections(tmp_path, "truth", LANE)
    write_detections(tmp_path, "v9", {**LANE, "points": [[3.0, 2.0], [40.0, 2.0]]})
    values, _ = judge_clip("a", "v9", CLEAN, CLEAN, CAMERA, Judging((), detections=tmp_path))
    assert values["lane_f1"] == 1.0
    assert values["lane_xerr_m"] == pytest.approx(0.3)
    assert values["cuboid_f1"] == 1.0
    without, _ = judge_clip("a", "3dgs", CLEAN, CLEAN, CAMERA, Judging((), detections=tmp_path))
    assert without == {}
    write_detections(tmp_path, "v9", LANE, detector="another")
    with pytest.raises(InputError, match="another detector"):
        judge_clip("a", "v9", CLEAN, CLEAN, CAMERA, Judging((), detections=tmp_path))


def write_tracks(folder: Path, variant: str, name: str, tracks: np.ndarray) -> None:
    (folder / variant).mkdir(parents=True, exist_ok=True)
    np.savez(folder / variant / f"{name}.tracks.npz", tracks=tracks)


def test_tracks_of_the_users_give_the_papers_fvmd_and_a_variant_without_them_is_null(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(0)
    start = rng.uniform(20, 200, size=(1, 1, 400, 2))
    features: dict[str, list[dict[str, np.ndarray]]] = {"truth": [], "v9": [], "3dgs": []}
    for name in ("a", "b", "c"):
        tracks = start + rng.normal(size=(1, 16, 400, 2)).cumsum(axis=1)
        write_tracks(tmp_path, "truth", name, tracks)
        write_tracks(tmp_path, "v9", name, tracks + 0.5 * rng.normal(size=tracks.shape))
        for variant, mine in features.items():
            truth = None if variant == "truth" else CLEAN
            mine.append(
                judge_clip(name, variant, CLEAN, truth, CAMERA, Judging((), detections=tmp_path))[1]
            )
    found = judge_sets(features, "3dgs")["fvmd"]["variants"]
    assert found["v9"]["value"] > 0
    assert found["v9"]["n"] == 3
    assert found["3dgs"] == {"value": None, "reason": "no_detections", "n": 0}
    cells = paper_row({}, {"fvmd": {"variants": found}}, "v9")
    assert cells["fvmd"]["value"] == found["v9"]["value"]
    write_tracks(tmp_path, "v9", "a", np.zeros((2, 16, 400, 2)))
    with pytest.raises(InputError, match=r"a clip of 17 frames has \(1, 16, 400, 2\)"):
        judge_clip("a", "v9", CLEAN, CLEAN, CAMERA, Judging((), detections=tmp_path))


def clips(seed: int, shift: float = 0.0, count: int = 6) -> list[dict[str, np.ndarray]]:
    rng = np.random.default_rng(seed)
    return [
        {MOTION: rng.poisson(1.0, (2, 32)) + shift, "windows-0": rng.normal(size=(3, 8)) + shift}
        for _ in range(count)
    ]


def test_sets_are_compared_with_the_truth_and_swapped_with_the_baseline() -> None:
    truth = clips(0)
    near = [{key: x + 0.01 for key, x in clip.items()} for clip in truth]
    sets = judge_sets({"3dgs": clips(0, 2.0), "v9": near, "same": truth, "truth": truth}, "3dgs")
    assert set(sets) == {FD_16, FD_CLIP, FVMD_LK}
    cell = sets[FD_16]
    assert cell["dimensions"] == 8
    assert cell["oracle"] > 0
    assert cell["variants"]["same"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert cell["variants"]["3dgs"]["value"] == pytest.approx(8 * 4.0)
    assert cell["variants"]["v9"]["difference"] < 0
    assert cell["variants"]["v9"]["p_value"] < 0.05
    assert cell["variants"]["v9"]["n"] == 18
    assert sets[FD_CLIP]["variants"]["v9"]["n"] == 6
    one = judge_sets({"3dgs": truth[:1], "truth": truth[:1]}, "3dgs")
    assert one[FD_CLIP]["variants"]["3dgs"] == {"value": None, "reason": "too_few_clips", "n": 1}


def test_the_table_says_null_where_the_paper_has_a_name_and_the_user_no_weights() -> None:
    truth = clips(0)
    sets = judge_sets({"3dgs": clips(1), "truth": truth}, "3dgs")
    means = {"lane_f1_syn": {"mean": 0.5}, "lpips_alex": {"mean": 0.2}}
    summary = {
        "baseline": "3dgs",
        "sets": sets,
        "paper": {"3dgs": paper_row(means, sets, "3dgs")},
        "judges": {"judge-lane-0": "ab" * 32},
    }
    text = judged_markdown(summary)
    assert "| fvd_clip | null (weights_missing) |" in text
    assert "| lane_f1 | null (no_detections) |" in text
    assert "| lpips_alex | 0.2 |" in text
    assert "judge-lane-0 abababababab" in text
    assert judged_markdown({"arms": {}}) == ""


def test_a_sequence_without_mounting_asks_for_its_scene(tmp_path: Path) -> None:
    sequence = make(tmp_path)
    with pytest.raises(InputError, match="--scenes"):
        camera_of(sequence, None)
    sequence.info["camera"] = {
        "width": 48,
        "height": 32,
        "K": CAMERA.K.tolist(),
        "T_rig_camera": MOUNT.tolist(),
    }
    assert np.array_equal(camera_of(sequence, None).T_rig_camera, MOUNT)


def test_judges_that_are_not_frozen_are_not_asked(folder: Path) -> None:
    with pytest.raises(InputError, match="not among the frozen judges"):
        _ = Judging((0, 7), folder=folder).identity
    assert len(Judging((0,), folder=folder).identity["judges"]) == 3


def test_hashes_are_printed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["judge", "hash", "--json", "--folder", str(folder)]) == 0
    assert [len(digest) for digest in json.loads(capsys.readouterr().out).values()] == [64] * len(
        NAMES
    )
    assert run_command(["judge", "check", "pairs", "--scenes", "scenes", "--judge", "taste"]) == 2
    assert "no such judge" in capsys.readouterr().err
