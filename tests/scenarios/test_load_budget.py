"""Files that name one another several times double at every step: what is read for one command is
bounded.
"""

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.config import load_yaml
from scenarios.suite import load_suite

DEPTH = 12


def test_files_that_extend_the_next_one_four_times_are_refused(tmp_path):
    for i in range(DEPTH):
        (tmp_path / f"{i}.yaml").write_text(f"extends: [{', '.join([f'{i + 1}.yaml'] * 4)}]\n")
    (tmp_path / f"{DEPTH}.yaml").write_text("a: 1\n")
    with pytest.raises(InputError, match=r"more than 64 files"):
        load_yaml(tmp_path / "0.yaml")


def test_suites_that_name_the_next_one_four_times_are_refused(tmp_path):
    for i in range(DEPTH):
        (tmp_path / f"{i}.yaml").write_text(
            f"version: 1\nscenarios: [{', '.join([f'{i + 1}.yaml'] * 4)}]\n"
        )
    (tmp_path / f"{DEPTH}.yaml").write_text("version: 1\nscenarios: [smoke/curve]\n")
    with pytest.raises(InputError, match=r"more than 256 suites to read"):
        load_suite(tmp_path / "0.yaml")


def test_a_base_named_by_several_files_is_no_cycle_and_is_taken(tmp_path):
    (tmp_path / "base.yaml").write_text("a: 1\n")
    for name in ("x", "y"):
        (tmp_path / f"{name}.yaml").write_text(f"extends: base.yaml\n{name}: 2\n")
    (tmp_path / "top.yaml").write_text("extends: [x.yaml, y.yaml]\n")
    assert load_yaml(tmp_path / "top.yaml").data == {"a": 1, "x": 2, "y": 2}
