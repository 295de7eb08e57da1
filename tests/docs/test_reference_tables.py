"""The tables of options, metrics, scenario keys and fields on the pages are those of the code."""

import importlib


def test_the_tables_on_the_pages_are_those_of_the_code(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    pages = importlib.import_module("reference_tables").written()
    names = {"cli.md", "metrics.md", "scenario-files.md", "formats.md", "runs.md"}
    assert {path.name for path in pages} == names
    for path, text in pages.items():
        stale = f"{path.name} is stale: run python docs/scripts/reference_tables.py"
        assert path.read_text(encoding="utf-8") == text, stale
