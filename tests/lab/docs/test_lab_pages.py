"""The laboratory's pages, what leads to them from the other pages, and the commands of its verbs on
all of them.
"""

import importlib
import re

import pytest

from alpasim_plugin.cli.main import verbs
from alpasim_plugin.lab.training import episode_references
from alpasim_plugin.lab.training.map_errors import CHANCES
from alpasim_plugin.lab.training.pixel_rollout import PixelObjectives
from tests.docs import page_links as core
from tests.docs.commands import LAB, LAB_VERBS, commands, lab_pages, pages
from tests.docs.parsed_commands import needing_the_checkout, not_understood


@pytest.fixture
def everywhere(repo):
    return [repo / "CHANGELOG.md", *pages(repo), *lab_pages(repo)]


def test_links_to_and_from_the_pages_resolve(repo, everywhere):
    assert core.broken_links(repo, everywhere, to_lab=True) == []
    assert core.broken_links(repo, lab_pages(repo), to_lab=False) == []


def test_pages_that_code_and_pages_name_exist(repo, everywhere):
    folders = ("alpasim_plugin", "evaluators", "policies", "scenarios", "configs", "tests", "docs")
    code = [
        path
        for folder in folders
        for suffix in ("py", "yaml")
        for path in (repo / folder).rglob(f"*.{suffix}")
    ]
    named = [
        (file, page)
        for file in (*code, *everywhere)
        for page in core.MENTION.findall(file.read_text(encoding="utf-8"))
    ]
    assert [
        f"{file.relative_to(repo)}: {page}"
        for file, page in named
        if page.startswith(LAB) and not (repo / page).is_file()
    ] == []


def test_pages_are_reachable_and_their_pictures_shown(repo):
    assert [
        page.name for page in lab_pages(repo) if page not in core.reachable(repo / "docs")
    ] == []
    assert core.unshown(repo / LAB, lab_pages(repo)) == []


def test_files_and_modules_that_pages_name_exist(repo, everywhere):
    assert core.files_not_there(repo, everywhere) == []
    assert core.imports_of_nothing(repo, everywhere) == []


def test_every_command_is_understood_and_needs_no_checkout(repo):
    every = commands(repo, [*pages(repo), *lab_pages(repo)])
    every = [one for one in every if "docs/experiments" not in one.page]  # of an older commit
    assert not_understood([one for one in every if one.is_of_lab or one.page.startswith(LAB)]) == []
    assert sum(one.is_of_lab for one in every) > 20
    assert needing_the_checkout(lab_pages(repo)) == []


def test_every_verb_of_the_laboratory_is_there_and_on_a_page(repo):
    text = "\n".join(page.read_text(encoding="utf-8") for page in lab_pages(repo))
    assert {verb for verb, where in verbs().items() if ".lab." in where} == set(LAB_VERBS)
    assert [verb for verb in LAB_VERBS if not re.search(rf"simrun {verb}\b", text)] == []


def test_the_stages_on_the_page_of_the_systems_are_those_of_the_recipes(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    for path, text in importlib.import_module("recipe_table").written().items():
        stale = f"{path.name} is stale: run python docs/scripts/recipe_table.py"
        assert path.read_text(encoding="utf-8") == text, stale


def test_the_weights_of_the_terms_on_the_page_of_training_are_those_of_the_code(repo):
    page = (repo / LAB / "training.md").read_text(encoding="utf-8")
    weights = PixelObjectives()
    for term in ("perceptual", "temporal", "grid", "choice", "flow"):
        (said,) = re.findall(rf"^ {term} .*weight ([\d.]+)", page, re.M)
        assert float(said) == getattr(weights, term), term


def test_the_faults_of_inputs_on_the_page_of_training_are_those_of_the_code(repo):
    page = (repo / LAB / "training.md").read_text(encoding="utf-8")
    none, one, two, three = (f"{100 * chance:.0f} %" for chance in episode_references.COUNTS)
    counts = f"none in {none} of the episodes, one in {one}, two in {two}, three in {three}"
    assert counts in page
    said = {
        "the nearest ones missing": episode_references.P_SKIP,
        "0.23 degrees": episode_references.P_MISPLACED,
        "of another exposure": episode_references.P_EXPOSURE,
        "of another place": episode_references.P_WRONG,
        "| the map | missing": CHANCES["missing"],
        "without lane markings": CHANCES["unpainted"],
        "beside the road": CHANCES["shifted"],
        "of another street": CHANCES["other"],
    }
    assert [
        words for words, chance in said.items() if f"{words} ({100 * chance:.0f} %)" not in page
    ] == []
