"""The laboratory's wheel holds its folder alone, and registers what the core finds by entry
points.
"""

import re
import tomllib
from pathlib import Path

from alpasim_plugin.lab.build import HERE, stage


def test_the_source_tree_of_the_wheel_is_the_laboratory_and_nothing_else(tmp_path):
    stage(tmp_path)
    inside = {
        path.relative_to(tmp_path / "alpasim_plugin" / "lab")
        for path in (tmp_path / "alpasim_plugin").rglob("*")
        if path.is_file()
    }
    assert {path.relative_to(HERE) for path in HERE.rglob("*.py")} <= inside
    assert any(path.suffix == ".safetensors" for path in inside)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alpasim_plugin", "pyproject.toml"]
    assert not (tmp_path / "alpasim_plugin" / "__init__.py").exists()  # the core's


def test_what_it_registers_lies_in_it(tmp_path):
    stage(tmp_path)
    project = tomllib.loads((tmp_path / "pyproject.toml").read_text())
    assert project["tool"]["setuptools"]["packages"]["find"]["include"] == ["alpasim_plugin.lab*"]
    for target in (
        target for group in project["project"]["entry-points"].values() for target in group.values()
    ):
        module, _, attribute = target.partition(":")
        text = (tmp_path / Path(*module.split("."))).with_suffix(".py").read_text()
        assert re.search(rf"^({attribute} = |def {attribute}\()", text, re.M), target
