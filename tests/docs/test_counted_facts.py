"""Facts that pages count or quote are those of the code."""

import importlib
import re

import pytest
import yaml

from evaluators import PRESETS
from evaluators.results import SCHEMA
from evaluators.statistics.gate import LIBRARY
from policies.parts import PARTS
from scenarios.cameras import RIGS_FILE
from scenarios.suite import load_suite, suites

WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def test_the_changelog_counts_the_scenes_and_suites_that_ship(repo):
    text = (repo / "CHANGELOG.md").read_text()
    scenes, others = re.search(
        r"(\d+) scenarios in the suite `all`, and (\w+) other suites", text
    ).groups()
    assert int(scenes) == len(load_suite("suites/all"))
    assert others == WORDS[len(suites()) - 1]


def test_the_pages_name_the_schema_of_the_summary(repo):
    for name, pattern in (
        ("runs.md", r"with `schema` (\d+)"),
        ("statistics.md", r"`schema` is (\d+)"),
    ):
        (number,) = re.findall(pattern, (repo / "docs" / name).read_text())
        assert int(number) == SCHEMA, name


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("gate-file.md", [path.stem for path in LIBRARY.glob("*.yaml")]),
        ("cameras.md", list(yaml.safe_load(RIGS_FILE.read_text()))),
        ("policies.md", [part.name for part in PARTS]),
        ("metrics.md", list(PRESETS)),
        ("scenarios.md", [name.removeprefix("suites/") for name in suites()]),
    ],
)
def test_a_page_names_everything_of_its_kind_that_ships(repo, page, names):
    text = (repo / "docs" / page).read_text()
    assert names
    assert [name for name in names if not re.search(rf"`(suites/)?{name}`", text)] == []


OF_PYTEST_ALONE = {"SIMRUN_TESTS_BEGAN_S"}  # set and read by the tests themselves


def test_every_environment_variable_of_ours_is_on_its_page(repo):
    rooms = ("alpasim_plugin", "evaluators", "policies", "scenarios", "simrun", "tests")
    named = set()
    for room in rooms:
        for path in (repo / room).rglob("*.py"):
            named |= set(re.findall(r"(?<![A-Z_])SIMRUN_[A-Z_]*[A-Z]\b", path.read_text("utf-8")))
    page = (repo / "docs" / "environment.md").read_text()
    assert len(named) > len(OF_PYTEST_ALONE)
    assert {name for name in named - OF_PYTEST_ALONE if name not in page} == set()


def test_the_picture_of_the_rooms_is_that_of_the_layers(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    script = importlib.import_module("architecture_picture")
    assert script.PICTURE.read_text() == script.picture(), f"run python {script.__file__}"
    edges = set(script.direct(script.imports()))
    assert ("renderers", "streets") in edges
    assert ("renderers", "world") not in edges  # follows from streets
