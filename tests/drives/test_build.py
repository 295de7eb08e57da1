"""A recording becomes a folder that drives: what stands in it, how it is loaded, and that nothing
is left half-written.
"""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.drives import build
from alpasim_plugin.drives.build import import_drive
from alpasim_plugin.drives.held_out import measured
from alpasim_plugin.drives.opening import read_source
from alpasim_plugin.drives.placing import place
from alpasim_plugin.drives.source import Points
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.world.ground import height_at
from scenarios.load import load_scenario
from tests.drives.conftest import at_once
from tests.drives.street import (
    COUNT,
    HEIGHT,
    STEP_M,
    WIDTH,
    Street,
    edited,
    write_kitti,
    write_transforms,
)

pytestmark = pytest.mark.slow


def test_the_scenario_carries_photographs_model_and_a_corridor_without_paint(
    imported,
):
    scenario = load_scenario(imported / "scenario.yaml")
    assert scenario.source == "drive"
    assert scenario.model == str(imported / "model")
    uses = [(one.camera, one.use) for one in scenario.recording]
    assert (uses.count(("front", "fitted")), uses.count(("front", "held-out"))) == (COUNT - 3, 3)
    assert uses.count(("right", "never-fitted")) == COUNT
    assert all(Path(one.path).is_file() for one in scenario.recording)
    assert scenario.recording[0].exposure == (1.1, 1.0, 0.9)
    (lane,) = scenario.lane_map.lanes.values()
    assert (lane.left_mark_type, lane.right_mark_type) == ("none", "none")
    assert scenario.cameras[0].name == "front"
    assert (scenario.cameras[0].width % 16, scenario.cameras[0].height % 16) == (0, 0)
    assert "000024.png" in str(scenario.notes)


def test_the_wheels_stand_on_the_road_that_bows(imported):
    scenario = load_scenario(imported / "scenario.yaml")
    street = Street()
    x = np.arange(4.0, 16.0)
    found = height_at(scenario.ground, np.column_stack([x, np.zeros(len(x))]))
    true = street.ground(x)
    slope = np.polyfit(
        x, found - true, 1
    )  # up is the road's own: its mean slope and height are not known
    assert np.abs(found - true - np.polyval(slope, x)).max() < 0.05
    ego = scenario.ego_log.xyz
    assert np.abs(ego[:, 2] - height_at(scenario.ground, ego)).max() < 0.05
    assert np.linalg.norm(np.diff(ego, axis=0), axis=1) == pytest.approx(STEP_M, abs=0.02)


def test_the_same_command_again_gives_the_same_and_another_import_is_refused(imported, tmp_path):
    source = imported.parent / "street"
    assert import_drive(source, imported) == json.loads((imported / "quality.json").read_text())
    with pytest.raises(InputError):
        import_drive(source, imported, camera_height_m=1.2)
    (tmp_path / "mine").mkdir()
    with pytest.raises(InputError):
        import_drive(source, tmp_path / "mine")


@pytest.mark.slow
def test_an_import_that_is_stopped_goes_on_and_leaves_no_scenario(tmp_path, monkeypatch, quick_fit):
    source = write_kitti(tmp_path / "street", stereo=False)
    real = build.measure

    def stop(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(build, "measure", stop)
    with pytest.raises(KeyboardInterrupt):
        import_drive(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(build, "measure", real)
    import_drive(source, tmp_path / "out")
    assert not (tmp_path / ".out.unfinished").exists()
    assert load_scenario(tmp_path / "out/scenario.yaml").model


def test_a_street_can_be_looked_at_and_driven_while_it_is_fitted(imported):
    said = [tuple(told) for told in json.loads((imported.parent / "said.json").read_text())]
    preview = build.preview_folder(imported)
    assert load_scenario(preview / "scenario.yaml").model == str(preview / "model")
    assert any("1300 updates, about 5 minutes in all on this machine" in text for text, *_ in said)
    assert ("fitting", 260, 1300) in said, "half of the updates take a fifth of the time"
    (sentence,) = [text for text, _, all in said if all == 0 and "a quarter of the updates" in text]
    image = Path(sentence.split("look at ")[1].split(" (")[0])
    assert image.is_file()
    assert image.is_relative_to(preview)
    assert str(preview / "scenario.yaml") in sentence
    assert "a preview" in (preview / "quality.md").read_text()
    assert "a preview" not in (imported / "quality.md").read_text()


def test_a_number_of_updates_is_that_of_the_fit_and_makes_another_import(
    imported, tmp_path, monkeypatch
):
    source = imported.parent / "street"
    with pytest.raises(InputError, match="with other options"):
        import_drive(source, imported, steps=400)
    tasks = []

    def stop(task, tell):
        tasks.append(task)
        raise KeyboardInterrupt

    monkeypatch.setattr(build, "_built", stop)
    with pytest.raises(KeyboardInterrupt):
        import_drive(source, tmp_path / "out", steps=400)
    assert tasks[0].recipe.steps == 400


def test_a_folder_in_the_place_of_a_preview_stays(tmp_path):
    mine = build.preview_folder(tmp_path / "out")
    mine.mkdir()
    said = []
    task = SimpleNamespace(out=tmp_path / "out")
    build._write_preview(task, *[None] * 6, lambda *told: said.append(told))
    assert said == [(f"no preview is written: {mine} is there", 0, 0)]


@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), InputError("too thin", "take more")]
)
def test_an_import_goes_on_without_a_preview_that_cannot_be_written(tmp_path, monkeypatch, error):
    def refuse(*given):
        raise error

    monkeypatch.setattr(build, "begin", refuse)
    said = []
    task = SimpleNamespace(out=tmp_path / "out", key="k")
    build._write_preview(task, *[None] * 6, lambda *told: said.append(told))
    assert said[0] == ("writing a preview", 0, 1)
    assert said[1][0].startswith("no preview is written: ")
    assert str(error) in said[1][0]


@pytest.mark.slow
def test_scale_without_metres_comes_from_the_cameras_height(tmp_path, quick_fit):
    folder = write_transforms(tmp_path / "walk")
    with edited(folder) as document:
        for frame in document["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= 0.37
    stages = []
    quality = import_drive(
        folder,
        tmp_path / "out",
        camera_height_m=1.5,
        report=lambda stage, done, all: stages.append(stage),
    )
    assert "photographs; how long their fit takes" in stages[0], "before anything is done"
    assert quality["scale"] == "scale from the camera's height above the ground, 1.5 m (as given)"
    ego = load_scenario(tmp_path / "out/scenario.yaml").ego_log.xyz
    assert np.linalg.norm(ego[-1] - ego[0]) == pytest.approx((COUNT - 1) * STEP_M, rel=0.03)


def test_where_no_road_is_below_the_cameras_every_fifth_photograph_is_held_out(walk, tmp_path):
    drive = read_source(walk)
    placed = place(
        replace(drive, metric=None), Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    )
    assert placed.strip is None
    _, _, stride = measured(lambda stride: (drive, placed))
    photographs = build.placed_photographs(drive, placed, stride)
    assert sum(photograph.use == "held-out" for photograph in photographs) == 5
    assert "photographs taken along a road" in str(placed.notes)


def test_the_command_tells_what_it_found_and_fits_whole_photographs(tmp_path, monkeypatch, capsys):
    """Of a lens that bends lines: the fit and the comparison see its image, borders and all."""
    fitted = []

    def keep_views(views, start, **rest):
        fitted.extend(views)
        return at_once(views, start, **rest)

    monkeypatch.setattr(build, "fit_drive", keep_views)
    bend = (-0.12, 0.01, 1e-3, -1e-3)
    folder = write_transforms(tmp_path / "walk", "opengl", say_axes=False, bend=bend, unit="m")
    command = [
        "import",
        "drive",
        str(folder),
        "--out",
        str(tmp_path / "out"),
        "--camera-height",
        "1.5",
        "--json",
    ]
    assert run_command([*command, "--device", "cuda:999"]) == 4
    capsys.readouterr()
    assert run_command(command) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["scenario"] == str(tmp_path / "out/scenario.yaml")
    assert any("opengl" in note for note in told["notes"])
    assert told["held-out"]["psnr_db"] > 5
    assert "## What is missing or assumed" in (tmp_path / "out/quality.md").read_text()
    assert all(isinstance(view.camera, LensCamera) for view in fitted)
    assert fitted[0].camera.spec.lens.coefficients == (*bend, 0.0)
    as_taken = cv2.imread(str(folder / "images/000.png"))[..., ::-1]
    np.testing.assert_array_equal(fitted[0].rgb, as_taken)
    compared = cv2.imread(str(next((tmp_path / "out/images").glob("held-out-*.jpg"))))
    assert compared.shape == (2 * HEIGHT, WIDTH, 3)
    straight = cv2.imread(str(tmp_path / "out/photographs/front/000000.png"))[..., ::-1]
    assert np.abs(straight.astype(float) - as_taken).mean() > 5.0


XODR = """<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4"/><road name="r" length="60" id="1" junction="-1"><planView>
<geometry s="0" x="{x}" y="{y}" hdg="0" length="60"><line/></geometry></planView><elevationProfile/><lanes><laneSection s="0">
<center><lane id="0" type="none" level="false"/></center><right><lane id="-1" type="driving" level="false">
<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right></laneSection></lanes></road></OpenDRIVE>"""


@pytest.mark.slow
def test_a_given_map_is_laid_onto_the_ground_and_one_elsewhere_is_refused(tmp_path, quick_fit):
    folder = write_transforms(tmp_path / "walk", unit="m")
    (tmp_path / "here.xodr").write_text(XODR.format(x=-10, y=1.75))
    (tmp_path / "away.xodr").write_text(XODR.format(x=-10, y=501.75))
    with pytest.raises(InputError):
        import_drive(folder, tmp_path / "out", lane_map=tmp_path / "away.xodr")
    assert not (tmp_path / "out").exists()
    assert (
        run_command(
            [
                "import",
                "drive",
                str(folder),
                "--out",
                str(tmp_path / "out"),
                "--map",
                str(tmp_path / "here.xodr"),
            ]
        )
        == 0
    )
    scenario = load_scenario(tmp_path / "out/scenario.yaml")
    (lane,) = scenario.lane_map.lanes.values()
    assert np.abs(lane.centre[:, 2] - height_at(scenario.ground, lane.centre)).max() < 1e-9
    assert (
        np.abs(
            scenario.ego_log.xyz[:, 1]
            - np.interp(scenario.ego_log.xyz[:, 0], lane.centre[:, 0], lane.centre[:, 1])
        ).max()
        < 0.3
    )


def test_an_imported_drive_is_handed_on_as_a_scene_of_alpasim(imported, tmp_path):
    from scenarios.usdz import read_usdz
    from scenarios.usdz_write import write_usdz

    scenario = load_scenario(imported / "scenario.yaml")
    write_usdz(tmp_path / "street.usdz", scenario)
    scene = read_usdz(tmp_path / "street.usdz")
    assert scene.scene_id == scenario.scene_id
    assert np.allclose(scene.ego_log.xyz, scenario.ego_log.xyz)
    assert len(scene.lane_map.lanes) == 1
    assert len(scene.actors) == len(scenario.actors)


def test_policies_drive_behind_the_reconstruction_and_clean_is_refused(imported, tmp_path, capsys):
    scenario = str(imported / "scenario.yaml")
    short = [
        "--set",
        "timing.duration_us=700000",
        "--workers",
        "1",
        "--no-report",
        "--json",
    ]
    assert (
        run_command(
            [
                "--renderer",
                "3dgs",
                "--policy",
                "log-replay",
                scenario,
                "--out",
                str(tmp_path / "run"),
                *short,
            ]
        )
        == 0
    )
    told = json.loads(capsys.readouterr().out)
    metrics = (
        told["metrics"]["3dgs"]
        if "metrics" in told
        else json.loads((tmp_path / "run/summary.json").read_text())["metrics"]["3dgs"]
    )
    assert metrics["collision_standing"]["mean"] == 0.0
    assert metrics["collision_any"]["mean"] == 0.0
    assert metrics["offroad"]["mean"] == 0.0
    assert (
        run_command(
            [
                "--renderer",
                "clean",
                "--policy",
                "lane-camera",
                scenario,
                "--out",
                str(tmp_path / "no"),
                *short,
            ]
        )
        != 0
    )
    assert "nothing was built" in capsys.readouterr().out + str(
        [path.read_text() for path in (tmp_path / "no").rglob("manifest.json")]
    )
