"""``simrun train splat`` as a user meets it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.errors import InputError
from alpasim_plugin.gaussians import read_ply
from alpasim_plugin.gaussians.fit import Reconstruction, logged_views
from alpasim_plugin.gaussians.fit.view_files import write_views
from alpasim_plugin.renderers.gaussian import scene_of
from scenarios.load import load_scenario

SCENE = "smoke/straight"
SMALL = ["--steps", "3", "--views", "6", "--width", "32", "--gaussians", "240", "--threads", "1"]


def test_files_metrics_and_pictures_and_the_same_command_continues(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["train", "splat", SCENE, "--out", str(tmp_path), *SMALL, "--json"]
    assert run_command(command) == 0
    first = capsys.readouterr()
    metrics = json.loads(first.out)
    assert metrics == json.loads((tmp_path / "metrics.json").read_text())
    assert [metrics[group]["views"] for group in ("train", "held_out", "aside_2m")] == [5, 1, 8]
    assert len(metrics["train"]["psnr_db_by_view"]) == 5
    assert "3/3 loss" in first.err
    assert "held_out: PSNR" in first.err
    model = Reconstruction.load(tmp_path)
    assert len(model) == metrics["gaussians"] <= 240
    assert len(read_ply(tmp_path / "background.ply")) == len(model.background)
    picture = cv2.imread(str(next((tmp_path / "held_out").glob("*.png"))))
    assert picture.shape == (18, 64, 3)
    assert run_command(command) == 0
    again = capsys.readouterr()
    assert "loss" not in again.err, "nothing was fitted again"
    assert json.loads(again.out)["held_out"] == metrics["held_out"]


def test_images_without_points_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = load_scenario(SCENE)
    write_views(tmp_path / "images", logged_views(scenario, scene_of(scenario), 2, 32, threads=1))
    assert run_command(["train", "splat", SCENE, "--out", str(tmp_path / "out"), "--images", str(tmp_path / "images"), *SMALL]) == 2
    assert "ply_file_path" in capsys.readouterr().err


def test_a_folder_without_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="simrun train splat"):
        Reconstruction.load(tmp_path)
