"""Facts that pages count or quote are those of the code."""

import re

from evaluators.results import SCHEMA
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
