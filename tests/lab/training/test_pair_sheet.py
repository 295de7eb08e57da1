"""Statistics of pairs against numbers known by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.lab.training.pair_sheet import (
    PSNR_EDGES_DB,
    contact_sheet,
    markdown,
    measure_sequence,
    sheet,
)
from alpasim_plugin.lab.training.pair_store import Pair, PairSequence, write_sequence
from tests.lab.training.pair_files import make


def flat(level: int, opacity_rows: int, map_rows: int) -> Pair:
    """Return a frame whose input is 10 grey levels off, with rows of full opacity and rows of
    map.
    """
    gt = np.full((20, 30, 3), level, np.uint8)
    opacity, sdmap = np.zeros((20, 30), np.uint8), np.zeros((20, 30, 3), np.uint8)
    opacity[:opacity_rows], sdmap[:map_rows, :, 1] = 255, 9
    return Pair((gt + 10).astype(np.uint8), gt, opacity, sdmap, np.eye(4), 0)


@pytest.fixture
def sequence(tmp_path: Path) -> PairSequence:
    folder = tmp_path / "train" / "s"
    frames = []
    for i in range(11):
        pose = np.eye(4)
        pose[1, 3] = 0.5 * i
        frames.append(flat(51, 15, 4)._replace(T_world_camera=pose, t_us=i))
    write_sequence(
        folder,
        frames,
        11,
        {"family": "street", "degradation": {"kind": "cycle"}, "moving_actors": 2},
    )
    return PairSequence(folder)


def test_numbers_of_a_sequence_known_by_hand(sequence: PairSequence) -> None:
    facts = measure_sequence(sequence, "train")
    assert (facts.family, facts.degradation, facts.frames, facts.moving_actors) == (
        "street",
        "cycle",
        11,
        2,
    )
    assert facts.psnr_db == pytest.approx([20 * np.log10(255 / 10)] * 3)
    assert facts.hole_share == pytest.approx(0.25)
    assert facts.map_share == pytest.approx(0.2)
    assert facts.luminance == pytest.approx(0.2)
    assert facts.travel_m == pytest.approx(5.0)


def test_sheet_counts_by_split_family_and_degradation(
    sequence: PairSequence, tmp_path: Path
) -> None:
    other = make(tmp_path, "val", "own")
    document = sheet([measure_sequence(sequence, "train"), measure_sequence(other, "val")])
    assert document["all"]["sequences"] == 2
    assert document["all"]["frames"] == 11 + 12
    assert document["all"]["families"] == {"imported": 1, "street": 1}
    assert document["splits"]["train"]["degradations"] == {"cycle": 1}
    assert document["splits"]["train"]["with_moving_actors"] == 1
    histogram = document["splits"]["train"]["psnr_histogram"]
    assert sum(histogram["frames"]) == 3
    assert histogram["frames"][PSNR_EDGES_DB.index(28)] == 3
    json.dumps(document, allow_nan=False)
    text = markdown(document)
    assert "| sequences | 1 | 1 | 2 |" in text
    assert "| 28 to 30 | 3 | 0 | 3 |" in text


def test_contact_sheet_has_a_row_for_every_chosen_sequence(
    sequence: PairSequence, tmp_path: Path
) -> None:
    picture = contact_sheet([sequence, make(tmp_path, "val", "own")])
    assert picture.shape == (2 * 128 + 2 * 2, 8 * 192, 3)
    assert contact_sheet([sequence] * 50, rows=4).shape[0] == 4 * 130


def test_command_prints_json_and_writes_table_and_picture(
    sequence: PairSequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        run_command(["train", "pairs-sheet", str(tmp_path), "--out", str(tmp_path / "sheet")]) == 0
    )
    assert json.loads(capsys.readouterr().out)["all"]["frames"] == len(sequence.clip)
    assert (tmp_path / "sheet" / "sheet.md").read_text().startswith("|  | train | all |")
    assert (tmp_path / "sheet" / "sheet.jpg").stat().st_size > 1000
    assert run_command(["train", "pairs-sheet", str(tmp_path / "nothing")]) == 2
    assert "no finished sequence" in capsys.readouterr().err


def test_unknown_poses_give_no_distance_instead_of_zero(tmp_path: Path) -> None:
    folder = tmp_path / "train" / "drive"
    unknown = flat(51, 15, 0)._replace(T_world_camera=np.full((4, 4), np.nan))
    write_sequence(folder, [unknown] * 3, 3, {"family": "video"})
    facts = measure_sequence(PairSequence(folder), "train")
    assert facts.travel_m is None
    document = sheet([facts])
    json.dumps(document, allow_nan=False)
    assert "| metres driven, mean | - | - |" in markdown(document)
