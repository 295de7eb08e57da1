"""The pages of docs/: links resolve, and every page is reachable from the index.

The laboratory's pages, and what leads to them, are those of `tests/lab/docs`.
"""

import re
from subprocess import DEVNULL, run

import pytest

from tests.docs import commands
from tests.docs.page_links import (
    MENTION,
    OF_COMMIT,
    broken_links,
    files_not_there,
    imports_of_nothing,
    is_program,
    programs_by_commit,
    programs_not_there,
    reachable,
    unshown,
)


@pytest.fixture
def pages(repo):
    """Return README, CHANGELOG and every page of docs/ but the laboratory's."""
    return [repo / "CHANGELOG.md", *commands.pages(repo)]


OF_LAB = re.compile(r"\blab[/.]")  # files and modules of the laboratory


def test_links_resolve(repo, pages):
    assert broken_links(repo, pages, to_lab=False) == []


def test_pages_of_the_docs_that_code_and_pages_name_exist(repo, pages):
    folders = ("alpasim_plugin", "evaluators", "policies", "scenarios", "configs", "tests", "docs")
    code = [
        path
        for folder in folders
        for suffix in ("py", "yaml")
        for path in (repo / folder).rglob(f"*.{suffix}")
    ]
    missing = []
    for file in [*code, *pages]:
        mentions = MENTION.findall(OF_COMMIT.sub("", file.read_text(encoding="utf-8")))
        there = (mention for mention in mentions if not mention.startswith(commands.LAB))
        missing += [
            f"{file.relative_to(repo)}: {mention}"
            for mention in there
            if not (repo / mention).is_file()
        ]
    assert missing == []


def test_studies_that_are_done_are_in_the_commit_that_their_page_names(repo, pages):
    named = {
        study for page in pages for study in OF_COMMIT.findall(page.read_text(encoding="utf-8"))
    }
    assert named
    known = {
        one
        for one in named
        if not run(
            ["git", "cat-file", "-e", ":".join(reversed(one))], cwd=repo, stderr=DEVNULL
        ).returncode
    }
    if not known or (repo / ".git/shallow").exists():
        pytest.skip("the history of the project is not here")
    assert named == known


def test_programs_that_pages_start_are_in_the_tree_or_in_the_commit_that_is_named(repo, pages):
    assert programs_not_there(repo, pages) == []
    of_commits = {
        (path, commits[0])
        for page in pages
        for path, commits in programs_by_commit(page)
        if commits and not is_program(repo, path)
    }
    assert of_commits
    git = ["git", "cat-file", "-e"]
    missing = {
        (path, commit)
        for path, commit in of_commits
        if run([*git, f"{commit}:{path}"], cwd=repo, stderr=DEVNULL).returncode
    }
    if missing == of_commits or (repo / ".git/shallow").exists():
        pytest.skip("the history of the project is not here")
    assert missing == set()


def test_a_program_that_is_gone_is_named_unless_its_paragraph_names_a_commit(tmp_path):
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "there.py").touch()
    page = tmp_path / "page.md"
    page.write_text(
        "Made by `python -m tests.there` and `python -m torch.distributed.x`.\n\n"
        "Made by `python -m tests.gone --quick` and `python tools/gone.py`.\n\n"
        "Made by `python tools/old.py`\nat commit d32adb86.\n"
    )
    assert programs_not_there(tmp_path, [page]) == [
        "page.md: tools/gone.py",
        "page.md: tests/gone.py",
    ]


def test_every_page_is_reachable_from_the_index(repo):
    assert [
        page.name for page in sorted({*commands.pages(repo)[1:]} - reachable(repo / "docs"))
    ] == []


def test_every_picture_is_shown(repo, pages):
    assert unshown(repo / "docs" / "img", pages) == []


def test_files_that_pages_name_exist(repo, pages):
    assert [line for line in files_not_there(repo, pages) if not OF_LAB.search(line)] == []


def test_python_examples_parse_and_import_what_exists(repo, pages):
    assert [line for line in imports_of_nothing(repo, pages) if not OF_LAB.search(line)] == []
