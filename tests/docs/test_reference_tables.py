"""The tables of options, metrics, scenario keys and fields on the pages are those of the code."""

import importlib
import re

import pytest

# The forms of docs/formats.md by the first words of their row, with the lists of fields of their
# readers; forms without fields, and those that are refused as a whole, have none.
LISTS = {
    "3DGS PLY": ["3DGS PLY"],
    "several models in one PLY": ["3DGS PLY"],
    "compressed PLY": ["compressed PLY"],
    "`.splat`": [],
    "SPZ": ["SPZ"],
    "SOG": ["SOG"],
    "`.ksplat`, `.lcc`": [],
    "`transforms.json` of nerfstudio": ["transforms.json", "dataparser_transforms.json"],
    "`transforms.json` of a rig": ["transforms.json of a rig"],
    "COLMAP": ["COLMAP"],
    "KITTI": ["KITTI odometry"],
    "py123d": ["py123d"],
    "any drive": [],
    "Argoverse 2": ["Argoverse 2", "Argoverse 2 calibration"],
    "AlpaSim scene": ["AlpaSim scene", "f-theta camera"],
    "OpenDRIVE": ["OpenDRIVE"],
    "Lanelet2": ["Lanelet2"],
    "OSI": ["OSI"],
    "CommonRoad": ["CommonRoad"],
    "CAN database": ["CAN database"],
    "rollout log": ["rollout log"],
    "video": [],
}


@pytest.fixture(scope="module")
def tables(repo):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(repo / "docs" / "scripts"))
        yield importlib.import_module("reference_tables")


def test_the_tables_on_the_pages_are_those_of_the_code(tables):
    pages = tables.written()
    names = {"cli.md", "metrics.md", "scenario-files.md", "scenarios.md", "formats.md", "runs.md"}
    assert {path.name for path in pages} == names
    for path, text in pages.items():
        stale = f"{path.name} is stale: run python docs/scripts/reference_tables.py"
        assert path.read_text(encoding="utf-8") == text, stale


def rows(text, heading):
    section = text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    cells = re.findall(r"^\|\s*([^|]*?)\s*\|", section, re.MULTILINE)
    return [cell for cell in cells if cell != "form" and set(cell) - set("-")]


def test_every_reader_on_the_page_of_formats_has_its_lists_there(repo):
    page = (repo / "docs" / "formats.md").read_text(encoding="utf-8")
    listed = set()
    for form in rows(page, "Files that others wrote"):
        (prefix,) = [prefix for prefix in LISTS if form.startswith(prefix)]
        listed |= set(LISTS[prefix])
    assert listed == set(rows(page, "Fields that readers know"))


def test_every_list_of_fields_in_the_code_is_on_the_page(repo, tables):
    for room in ("alpasim_plugin", "scenarios", "evaluators", "policies", "simrun"):
        for path in (repo / room).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            for name in re.findall(r"^(\w+) = Fields\(", text, re.MULTILINE):
                module = ".".join(path.relative_to(repo).with_suffix("").parts)
                fields = getattr(importlib.import_module(module), name)
                assert fields in tables.FORMATS, f"{module}.{name} is missing in FORMATS"


def test_the_page_of_the_api_is_that_of_the_code(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    for path, text in importlib.import_module("api_reference").written().items():
        stale = f"{path.name} is stale: run python docs/scripts/api_reference.py"
        assert path.read_text(encoding="utf-8") == text, stale


def test_the_rollout_by_hand_of_the_api_page_runs(repo, capsys):
    page = (repo / "docs" / "api.md").read_text()
    (block,) = re.findall(r"^```python\n(.*?)^```", page, re.S | re.M)
    block = block.replace(
        '"smoke/curve"', '"smoke/curve", overrides=["timing.duration_us=1000000"]'
    )
    exec(compile(block.replace('"lane-camera"', '"constant-velocity"'), "api.md", "exec"), {})
    assert 0.0 <= float(capsys.readouterr().out) <= 1.0


def test_every_environment_variable_of_ours_is_on_a_page(repo):
    page = (repo / "docs" / "environment.md").read_text()
    variables = set()
    for folder in ("alpasim_plugin", "evaluators", "policies", "scenarios"):
        for path in (repo / folder).rglob("*.py"):
            variables |= set(re.findall(r'"(SIMRUN_[A-Z_]+)"', path.read_text()))
    assert variables
    assert sorted(name for name in variables if f"`{name}`" not in page) == []
