"""A log is scored in the scene that was driven: with what a suite and ``--set`` changed, of the
content that the run states.
"""

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_json
from alpasim_plugin.runs.score_logs import KnownScenes, scenario_finder

SCENE = """version: 1
scene_id: bend
road: {segments: [{kind: straight, length_m: 200}]}
timing: {duration_us: 1200000}
"""
SUITE = """version: 1
scenarios: [{path: bend.yaml, set: {road.lane_width_m: 3.1}}]
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "bend.yaml").write_text(SCENE)
    (tmp_path / "suite.yaml").write_text(SUITE)
    return tmp_path


def drive(folder, *words):
    command = ["--renderer", "clean", "--policy", "constant-velocity", "--images", "none"]
    command += ["--workers", "1", "--no-report", "--quiet", "--out", str(folder / "run")]
    assert run_command([*command, *words, str(folder / "suite.yaml")]) == 0
    return read_json(folder / "run/run.json")["scenes"]["bend"]["content_hash"]


def score(folder, *scenes):
    words = [word for scene in scenes for word in ("--scene", str(folder / scene))]
    return run_command(["score", str(folder / "run"), *words, "--out", str(folder / "scored")])


@pytest.mark.parametrize("scene", ["suite.yaml", "bend.yaml"])
def test_what_suite_and_command_set_is_in_the_scene_of_the_score(folder, scene):
    driven = drive(folder, "--set", "ego.speed_mps=7")
    assert score(folder, scene) == 0
    scored = read_json(folder / "scored/run.json")["scenes"]["bend"]["content_hash"]
    assert scored == driven


def test_a_scene_that_was_edited_since_is_refused(folder, capfd):
    drive(folder)
    (folder / "bend.yaml").write_text(SCENE.replace("200", "210"))
    assert score(folder, "suite.yaml") == 2
    assert "not what was driven" in capfd.readouterr().err


def test_two_scenes_with_one_id_are_refused(folder):
    (folder / "other.yaml").write_text(SCENE.replace("200", "210"))
    places = [str(folder / "bend.yaml"), str(folder / "other.yaml")]
    with pytest.raises(InputError, match="bend"):
        KnownScenes(places)
    with pytest.raises(InputError, match="bend"):
        scenario_finder(places)


def test_a_served_policy_meets_the_scene_as_the_suite_sets_it(folder):
    lanes = scenario_finder([str(folder / "suite.yaml")])("bend").lane_map.lanes.values()
    assert max(abs(lane.left[0] - lane.right[0])[1] for lane in lanes) == pytest.approx(3.1)
