"""What a part of the user's reads while it is imported, remembered and driven makes its rollouts,
whoever read it first in a process.
"""

import hashlib
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_json
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.log.run_folder.manifests import read_manifest, read_run_json
from alpasim_plugin.runs.cell import find_rollout_state, kept_failure, run_cell
from alpasim_plugin.runs.plan import RunOptions, make_plan
from scenarios.load import load_scenario
from scenarios.suite import expand

SHORT = ("timing.duration_us=800000",)
OPTIONS = RunOptions(images="none", video="none")
HELPER = """
from functools import lru_cache
from alpasim_plugin.core.files import read_json

UNIT = read_json("{folder}/unit.json")

@lru_cache
def table():
    return read_json("{folder}/table.json")
"""
POLICY = """
import {helper}
from policies.simple import ConstantVelocity

class Mine(ConstantVelocity):
    def act(self, observation):
        assert {helper}.table()["gain"] > 0
        return super().act(observation)
"""


@pytest.fixture
def policies(tmp_path, monkeypatch):
    """Write two policies that import one helper, which reads a file when it is imported and one when
    it is first called; a process imports a name from one place.
    """
    monkeypatch.chdir(tmp_path)
    helper = f"helper_of_{hashlib.sha256(str(tmp_path).encode()).hexdigest()[:8]}"
    (tmp_path / "unit.json").write_text("1")
    (tmp_path / "table.json").write_text('{"gain": 1}')
    (tmp_path / f"{helper}.py").write_text(HELPER.replace("{folder}", str(tmp_path)))
    for name in ("first", "second"):
        (tmp_path / f"{name}.py").write_text(POLICY.replace("{helper}", helper))
    return [f"{tmp_path / name}.py:Mine" for name in ("first", "second")]


def planned(policies, seeds=(0,)):
    """Return the rollouts of policies on a short scene."""
    return make_plan(expand("smoke/straight", SHORT), ("clean",), policies, seeds, OPTIONS).cells


def drive(cells, root):
    """Drive rollouts in this process, one after another."""
    return [run_cell(cell, OPTIONS, root, 1) for cell in cells]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_what_a_helper_read_counts_for_each_policy_that_imports_it(policies, tmp_path, order):
    cells = planned([policies[number] for number in order])
    root = tmp_path / "run"
    for manifest in drive(cells, root):
        read = {Path(path).name for path in manifest.inputs}
        assert manifest.ok
        assert read == {"unit.json", "table.json"}
    assert [find_rollout_state(cell, root)[0] for cell in cells] == ["none", "none"]
    (tmp_path / "unit.json").write_text("2")
    assert [find_rollout_state(cell, root)[0] for cell in cells] == ["drive", "drive"]


def test_what_a_part_remembers_from_an_earlier_rollout_counts_for_the_later_one(policies, tmp_path):
    cells = planned(policies[:1], seeds=(0, 1))
    root = tmp_path / "run"
    drive(cells, root)
    (tmp_path / "table.json").write_text('{"gain": 2}')
    assert [find_rollout_state(cell, root)[0] for cell in cells] == ["drive", "drive"]


def test_a_helper_that_was_edited_after_one_policy_imported_it_is_refused_for_the_other(policies):
    resolve("policy", policies[0])
    helper = next(Path.cwd().glob("helper_of_*.py"))
    helper.write_text(f"{helper.read_text()}\nGAIN = 2\n")
    with pytest.raises(InputError, match="edited after this process imported it"):
        resolve("policy", policies[1])


def test_a_failure_is_that_of_the_files_that_were_read_before_it(policies, tmp_path):
    (tmp_path / "table.json").write_text('{"gain": "1"}')
    (cell,) = planned(policies[:1])
    root = tmp_path / "run"
    (manifest,) = drive([cell], root)
    assert manifest.final
    assert find_rollout_state(cell, root)[0] == "none"
    assert str(tmp_path / "table.json") in kept_failure(cell, manifest)
    (tmp_path / "table.json").write_text('{"gain": 1}')
    assert find_rollout_state(cell, root)[0] == "drive"


COUNTS = """
from pathlib import Path
from alpasim_plugin.core.files import read_json
from policies.simple import ConstantVelocity

class Mine(ConstantVelocity):
    {declared}

    def reset(self, seed, route):
        super().reset(seed, route)
        state = Path("{state}")
        state.write_text(str(read_json(state) + 1))
"""
WORDS = ("--renderer", "clean", "--workers", "1", "--images", "none", "--no-report", "--quiet")


@pytest.mark.parametrize(
    "declared", ["", pytest.param('files = ("state.json",)', marks=pytest.mark.slow)]
)
def test_a_policy_that_rewrites_its_state_is_driven_again_each_time_and_it_is_said(
    tmp_path, monkeypatch, capfd, declared
):
    monkeypatch.chdir(tmp_path)
    state = tmp_path / "state.json"
    state.write_text("1")
    text = COUNTS.replace("{state}", str(state)).replace("{declared}", declared)
    (tmp_path / "counts.py").write_text(text)
    command = [*WORDS, "--policy", "counts.py:Mine", "--set", *SHORT, "--out", "run"]
    for drive_number in (1, 2):
        assert run_command([*command, "smoke/straight"]) == 0
        said = capfd.readouterr().err
        assert ("1 rollout is driven again" in said) == (drive_number == 2)
        assert (f"{state} was changed during the rollout" in said) == (drive_number == 2)
        (sentence,) = read_run_json(Path("run")).rewritten.values()
        assert "each command" in sentence
    manifest = next(Path("run").glob("rollouts/*/*/*/*/manifest.json")).parent
    assert read_manifest(manifest).rewritten == (str(state),)
    assert read_json(state) > 2


ENDS = """
import os
from pathlib import Path
from policies.simple import ConstantVelocity

class Mine(ConstantVelocity):
    def act(self, observation):
        if Path("{folder}/broken").exists():
            os._exit(1)
        return super().act(observation)
"""


def test_a_policy_that_ended_its_process_in_the_check_is_checked_again(
    tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken").touch()
    (tmp_path / "ends.py").write_text(ENDS.replace("{folder}", str(tmp_path)))
    command = [*WORDS, "--policy", "constant-velocity,ends.py:Mine", "--set", *SHORT]
    command += ["--out", "run", "smoke/straight"]
    assert run_command(command) == 2
    (tmp_path / "broken").unlink()
    assert run_command(command) == 0
    check = read_run_json(Path("run")).policy_checks["ends.py:Mine"]
    assert check.breaches == ()
    capfd.readouterr()


SOURCE = """
from alpasim_plugin.core.files import read_json
from tests.core.toy.toy_parts import Csv

SCALE = read_json("{folder}/scale.json")

class Mine(Csv):
    pass
"""


def test_what_a_source_read_when_it_was_imported_counts_for_every_scene_of_it(tmp_path):
    (tmp_path / "scale.json").write_text("1")
    (tmp_path / "source.py").write_text(SOURCE.replace("{folder}", str(tmp_path)))
    for name in ("first", "second"):
        log = tmp_path / f"{name}.toycsv"
        log.write_text("".join(f"{i * 100000},{i},0\n" for i in range(30)))
        scenario = load_scenario(log, source=f"{tmp_path / 'source.py'}:Mine")
        assert str(tmp_path / "scale.json") in scenario.files
