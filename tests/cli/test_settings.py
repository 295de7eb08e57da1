"""``run --settings``: what the file says, what a command says on top of it, and what is refused."""

import json

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.cli.settings import LIBRARY, load_settings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.config import shipped_names
from scenarios.load import load_scenario

SCENE = """
version: 1
road: {segments: [{kind: straight, length_m: 500}]}
timing: {duration_us: 2000000}
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    return path


def test_the_challenge_s_settings_are_those_of_its_public_configuration(scene):
    settings = load_settings("challenge")
    assert (settings.preset, settings.workers) == ("alpasim", 2)
    scenario = load_scenario(scene, overrides=settings.overrides)
    assert scenario.route_offset_m == 40.0
    assert scenario.warmup_us == 1_700_000
    assert scenario.end_us - scenario.start_us == 20_000_000
    assert scenario.rates.policy_us == scenario.rates.camera_us == 100_000
    sizes = {camera.name: (camera.width, camera.height) for camera in scenario.cameras}
    assert sizes == dict.fromkeys(
        (
            "camera_front_wide_120fov",
            "camera_front_tele_30fov",
            "camera_cross_left_120fov",
            "camera_cross_right_120fov",
        ),
        (1900, 1080),
    )
    assert {camera.shutter_us for camera in scenario.cameras} == {30_000}


def test_the_nuplan_track_is_asked_twice_a_second_with_eight_cameras(scene):
    scenario = load_scenario(scene, overrides=load_settings("challenge-nuplan").overrides)
    assert scenario.rates.policy_us == scenario.rates.camera_us == scenario.warmup_us == 500_000
    assert len(scenario.cameras) == 8
    assert scenario.route_offset_m == 40.0


@pytest.mark.parametrize("name", shipped_names(LIBRARY))
def test_every_value_of_shipped_settings_names_its_source(name):
    lines = (LIBRARY / f"{name}.yaml").read_text(encoding="utf-8").splitlines()
    assert any("github.com/NVlabs/alpasim" in line and "commit" in line for line in lines)
    bare = [line for line in lines if line[:1] not in ("", "#", " ") and "#" not in line]
    assert [line.partition(":")[0] for line in bare] == ["version", "description", "set"]


def test_what_the_command_says_stands_above_the_settings(scene, tmp_path, capsys):
    file = tmp_path / "mine.yaml"
    file.write_text(
        "version: 1\npreset: paper\nworkers: 2\nset: {timing.warmup_us: 300000, seed: 7}\n"
    )
    run = ["run", "--renderer", "clean", "--policy", "constant-velocity", "--settings", str(file)]
    out = tmp_path / "out"
    more = ["--set", "seed=9", "--out", str(out), "--no-report", str(scene)]
    assert run_command([*run, *more, "-q"]) == 0
    info = json.loads((out / "run.json").read_text())
    (facts,) = info["scenes"].values()
    assert info["preset"] == "paper"
    assert facts["seed"] == 9
    assert facts["ref"]["overrides"] == ["timing.warmup_us=300000", "seed=7", "seed=9"]
    capsys.readouterr()
    assert run_command([*run, "--preset", "strict", "--dry-run", "--json", *more]) == 0
    assert json.loads(capsys.readouterr().out)["workers"] <= 2


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("version: 1\npreset: stric\n", "preset 'stric'"),
        ("version: 1\nsets: {seed: 1}\n", "sets"),
        ("version: 2\n", "version"),
        ("version: 1\nworkers: 0\n", "workers"),
    ],
)
def test_bad_settings_are_refused_at_their_line(tmp_path, text, problem):
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as refused:
        load_settings(str(file))
    assert "bad.yaml:" in refused.value.message
    assert problem in refused.value.message


def test_unknown_settings_are_refused_with_the_nearest_name():
    with pytest.raises(InputError) as refused:
        load_settings("chalenge")
    assert "challenge" in refused.value.hint
