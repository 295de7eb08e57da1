"""A scene is driven by one shard, however it is named and in whatever order."""

import json
import os

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runs.shards import shard_of
from scenarios.suite import expand

SCENE = """version: 1
road: {segments: [{kind: straight, length_m: 200}]}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Give a folder of five scenes, which a link leads to as well."""
    monkeypatch.chdir(tmp_path)
    for name in "abcde":
        (tmp_path / f"{name}.yaml").write_text(SCENE)
    os.symlink(tmp_path, tmp_path / "link")
    return tmp_path


def test_a_scene_that_two_arguments_name_is_in_one_shard_of_four(folder, capsys):
    (folder / "suite.yaml").write_text("version: 1\nscenarios: [a.yaml, d.yaml, e.yaml]\n")
    scenes = []
    for shard in range(1, 5):
        command = ["--renderer", "clean", "--policy", "constant-velocity", "--dry-run", "--json"]
        places = ["a.yaml", "./b.yaml", "link/c.yaml", str(folder / "d.yaml"), "suite.yaml"]
        assert run_command([*command, "--shard", f"{shard}/4", *places]) == 0
        scenes += json.loads(capsys.readouterr().out)["scenes"]
    assert sorted(name.rpartition("-")[2] for name in scenes) == ["a", "b", "c", "d", "e"]


QUICK = ("through a link", "a suite")
SPELLINGS = {
    "beside": "b.yaml",
    "with a dot": "./b.yaml",
    "through a link": "link/b.yaml",
    "whole path": "{folder}/b.yaml",
    "a suite": "version: 1\nscenarios: [b.yaml]\n",
    "its own seed": "version: 1\nscenarios: [{path: b.yaml, seeds: [0]}]\n",
    "what it has set": "version: 1\nscenarios: [{path: b.yaml, set: {version: 1}}]\n",
}


@pytest.mark.parametrize(
    "spelling",
    [
        pytest.param(text, id=name, marks=[] if name in QUICK else pytest.mark.slow)
        for name, text in SPELLINGS.items()
    ],
)
def test_a_scene_is_in_one_shard_however_it_is_spelled(folder, spelling):
    place = spelling.format(folder=folder) if "version" not in spelling else "suite.yaml"
    (folder / "suite.yaml").write_text(spelling)
    plain = [*(f"{name}.yaml" for name in "abcde")]
    for places in (
        plain,
        ["a.yaml", place, *plain[2:]],
        [*reversed(plain), place],
        [place, *plain],
    ):
        refs = [ref for name in places for ref in expand(name)]
        shards = [shard_of(refs, f"{number}/3") for number in (1, 2, 3)]
        names = [[os.path.basename(ref.path)[0] for ref in shard] for shard in shards]
        assert names == [["a", "d"], ["b", "e"], ["c"]]


def test_two_files_with_one_scene_id_are_refused_by_every_shard(folder):
    (folder / "x.yaml").write_text(f"scene_id: twice\n{SCENE}")
    (folder / "y.yaml").write_text(f"scene_id: twice\n{SCENE.replace('200', '300')}")
    refs = [ref for name in "axby" for ref in expand(f"{name}.yaml")]
    for number in (1, 2, 3):
        with pytest.raises(InputError, match="scene id 'twice'"):
            shard_of(refs, f"{number}/3")


@pytest.mark.parametrize("shard", ["0/3", "4/3", "x", "3/3"])
def test_a_shard_that_does_not_exist_is_refused(folder, shard):
    with pytest.raises(InputError, match="--shard"):
        shard_of(expand("a.yaml") + expand("b.yaml"), shard)
