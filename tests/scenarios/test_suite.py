"""Suites: files, folders, names, seeds and overrides."""

from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InputError
from scenarios.load import load_scenario
from scenarios.suite import ScenarioRef, expand, load_suite

SCENE = "version: 1\nroad: {segments: [{kind: straight, length_m: 200}]}\ntiming: {duration_us: 2000000}\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "one.yaml").write_text(SCENE)
    (tmp_path / "two.yaml").write_text(SCENE)
    (tmp_path / "suite.yaml").write_text(
        "version: 1\nscenarios:\n  - one.yaml\n  - {path: two.yaml, seeds: [4, 5], set: {ego.cruise_mps: 8}}\n  - smoke/straight\n"
    )
    return tmp_path


def test_a_suite_lists_scenarios_with_seeds_and_overrides(folder):
    refs = load_suite(folder / "suite.yaml")
    assert [(Path(r.path).name, r.seed, r.overrides) for r in refs] == [
        ("one.yaml", None, ()),
        ("two.yaml", 4, ("ego.cruise_mps=8",)),
        ("two.yaml", 5, ("ego.cruise_mps=8",)),
        ("straight.yaml", None, ()),
    ]
    scenes = [load_scenario(r.path, r.seed, r.overrides) for r in refs]
    assert len({s.scene_id for s in scenes}) == 4


def test_a_folder_gives_its_scenarios_and_not_its_suites(folder):
    assert [Path(r.path).name for r in load_suite(folder)] == ["one.yaml", "two.yaml"]


def test_one_scenario_or_recording_is_a_suite_of_one(folder, repo):
    assert load_suite(folder / "one.yaml") == [ScenarioRef(str(folder / "one.yaml"))]
    xml = repo / "scenarios" / "data" / "USA_US101-3_3_T-1.xml"
    assert load_suite(xml) == [ScenarioRef(str(xml))]


def test_an_unknown_entry_is_placed_in_the_suite(folder):
    (folder / "bad.yaml").write_text("version: 1\nscenarios:\n  - one.yaml\n  - smoke/strait\n")
    with pytest.raises(InputError) as e:
        load_suite(folder / "bad.yaml")
    assert "bad.yaml:4:5" in e.value.message
    assert "did you mean smoke/straight" in e.value.hint


@pytest.mark.parametrize(
    "text",
    [
        "version: 1\nscenarios: []\n",
        "version: 1\nscenarios: [{path: a, sed: 1}]\n",
        "version: 1\nscenarios: [bad.yaml]\n",
        "scenarios: [a]\n",
        "version: 1\nscenarios: ['']\n",
    ],
)
def test_bad_suites_are_refused(folder, text):
    (folder / "bad.yaml").write_text(text)
    with pytest.raises(InputError):
        load_suite(folder / "bad.yaml")


def test_an_empty_folder_and_a_missing_name_are_refused(tmp_path):
    with pytest.raises(InputError):
        load_suite(tmp_path)
    with pytest.raises(InputError, match="suites/smoke"):
        load_suite("suites/smok")


def test_command_line_overrides_come_last(folder):
    refs = expand(str(folder / "suite.yaml"), ["ego.cruise_mps=9"])
    assert refs[1].overrides == ("ego.cruise_mps=8", "ego.cruise_mps=9")
    assert refs[0].overrides == ("ego.cruise_mps=9",)
