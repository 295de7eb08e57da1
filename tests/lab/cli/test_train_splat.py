"""``simrun train splat`` as a user meets it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians import read_ply, write_ply
from alpasim_plugin.gaussians.fit import Reconstruction, logged_views, start_from_depth
from alpasim_plugin.gaussians.fit.photographs import write_views
from alpasim_plugin.renderers.gaussian import scene_of
from scenarios.load import load_scenario

SCENE = "smoke/straight"
SMALL = ["--steps", "3", "--views", "6", "--width", "32", "--gaussians", "240", "--threads", "1"]


@pytest.mark.slow
def test_files_metrics_and_pictures_and_the_same_command_continues(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


@pytest.mark.slow
def test_given_images_with_times_and_points_make_a_scene_with_its_actors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario, images = load_scenario("smoke/lead_car"), tmp_path / "images"
    views = logged_views(scenario, scene_of(scenario), 6, 32, threads=1)
    write_views(images, views)
    command = [
        "train",
        "splat",
        "smoke/lead_car",
        "--out",
        str(tmp_path / "out"),
        "--images",
        str(images),
        *SMALL,
    ]
    assert run_command(command) == 2, "no points to start from"
    assert "ply_file_path" in capsys.readouterr().err
    write_ply(images / "points.ply", start_from_depth(views, {}, 100, "s", 0).background)
    document = json.loads((images / "transforms.json").read_text())
    for frame, view in zip(document["frames"], views, strict=True):
        frame["t_us"] = int(view.name.rsplit("-", 1)[1])
    (images / "transforms.json").write_text(json.dumps(document | {"ply_file_path": "points.ply"}))
    assert run_command(command) == 0
    model = Reconstruction.load(tmp_path / "out")
    assert set(model.actors) == {actor.actor_id for actor in scenario.actors}
    assert "aside_2m" not in json.loads((tmp_path / "out" / "metrics.json").read_text()), (
        "there is no truth beside given images"
    )


def test_a_folder_without_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="simrun train splat"):
        Reconstruction.load(tmp_path)
