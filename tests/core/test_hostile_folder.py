"""The working directory may come from anybody: nothing in it runs unless it is named."""

import json
import os
import sys

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.core.parts.source import load
from alpasim_plugin.core.subprocesses import OURS, SAFE_PATH, own_path_only
from tests.core.hostile_commands import DRIVE, REPO, run_python, simrun

# What libraries of ours import if it is there, and what Python itself imports when it starts a
# worker.
BAITS = (
    "colorama",
    "numexpr",
    "bottleneck",
    "pytz",
    "coverage",
    "multiprocessing",
    "selectors",
    "pickle",
    "runpy",
    "sitecustomize",
    "usercustomize",
    "IPython",
    "readline",
)
POLICY = """
import with_me
from pydantic import BaseModel
class Settings(BaseModel):
    speed: float = 5.0
class Mine(with_me.Base):
    settings_model = Settings
"""
BASE = "from policies.simple import ConstantVelocity as Base\n"


@pytest.fixture
def hostile(tmp_path):
    """Give a folder in which everything that is imported or loaded leaves its name in ``ran``."""
    tmp_path = tmp_path / "work"
    tmp_path.mkdir()
    for name in BAITS:
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'ran')!r}, 'a').write('{name} ')\n"
        )
    (tmp_path / "evil.py").write_text((tmp_path / "pytz.py").read_text())
    info = tmp_path / "evil-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n")
    groups = (
        "simrun.policies",
        "simrun.evaluators",
        "simrun.sources",
        "simrun.renderers",
        "pydantic",
        "numba_extensions",
    )
    (info / "entry_points.txt").write_text(
        "".join(f"[{group}]\nevil = evil:Evil\n" for group in groups)
    )
    return tmp_path


def ran(folder):
    return (folder / "ran").read_text() if (folder / "ran").exists() else ""


NAMES = (
    "pack.inner.policy:Mine",
    "my_policy.py:Mine",
    "my_policy:Mine",
    "pack/inner/policy.py:Mine",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_part_of_the_working_directory_works_by_name_with_what_it_imports_also_in_workers(
    hostile, name
):
    (hostile / "my_policy.py").write_text(POLICY)
    (hostile / "with_me.py").write_text(BASE)
    inner = hostile / "pack" / "inner"
    inner.mkdir(parents=True)
    (hostile / "pack" / "__init__.py").write_text("")
    (inner / "__init__.py").write_text("")
    (inner / "policy.py").write_text(
        POLICY.replace("import with_me", "from .. import with_me\nfrom pack.inner import also")
    )
    (inner / "also.py").write_text("")
    (hostile / "pack" / "with_me.py").write_text(BASE)
    done = simrun(
        hostile,
        *DRIVE,
        "--policy",
        name,
        "--workers",
        "2",
        "--out",
        "mine",
        "smoke/straight",
        "--json",
    )
    assert done.returncode == 0, done.stderr
    assert json.loads((hostile / "mine" / "run.json").read_text())["policies"]
    assert ran(hostile) == ""


POOL = """
import os, sys
sys.path.append({repo!r})
from alpasim_plugin.runs.local_executor import run_jobs
if __name__ == "__main__":
    print(sorted(value for _, value in run_jobs(abs, [-1, -2], 2, threads={threads})))
"""


@pytest.mark.parametrize(
    "threads",
    [
        pytest.param(1, id="forked from a server"),
        pytest.param(2, id="spawned", marks=pytest.mark.slow),
    ],
)
def test_no_process_that_a_pool_of_workers_starts_imports_from_the_working_directory(
    hostile, threads
):
    script = hostile.parent / "pool.py"
    script.write_text(POOL.format(repo=str(REPO), threads=threads))
    done = run_python(hostile, str(script))
    assert (done.returncode, done.stdout) == (0, "[1, 2]\n"), done.stderr
    assert ran(hostile) == ""


def test_folders_named_like_ours_are_never_taken_for_them(tmp_path):
    folder = tmp_path / "work"
    for name in ("policies", "evaluators", "scenarios", "configs"):
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text("raise SystemError('the wrong package')\n")
    listed = simrun(folder, "list", "policies", "--json")
    assert "lane-camera" in json.loads(listed.stdout), listed.stderr
    first_on_the_path = "import sys; sys.path.append(sys.argv[1]); import alpasim_plugin"
    refused = run_python(folder, "-c", first_on_the_path, str(REPO))
    assert refused.returncode != 0
    assert "'configs' of simrun is hidden by" in refused.stderr


def test_only_what_a_named_file_imports_can_be_imported_beside_it(tmp_path):
    (tmp_path / "asks.py").write_text("import beside_asks\nfound = beside_asks.found\n")
    (tmp_path / "beside_asks.py").write_text("found = 3\n")
    (tmp_path / "not_asked.py").write_text("")
    path = list(sys.path)
    assert load(f"{tmp_path}/asks.py:found", "policy") == 3
    assert sys.path == path
    with pytest.raises(ModuleNotFoundError):
        __import__("not_asked")


def test_a_file_never_stands_in_for_an_installed_module(tmp_path):
    (tmp_path / "calls.py").write_text("import shapely\nfound = shapely.__version__\n")
    (tmp_path / "shapely.py").write_text("import numexpr_of_nobody\n")
    (tmp_path / "numexpr_of_nobody.py").write_text("")
    assert load(f"{tmp_path}/calls.py:found", "policy")[0].isdigit()
    with pytest.raises(ModuleNotFoundError):
        __import__("numexpr_of_nobody")


def test_a_worker_on_a_cluster_has_no_working_directory_on_its_path_unless_the_user_put_it_there(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", str(tmp_path), *sys.path])
    monkeypatch.setenv(SAFE_PATH, OURS)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    own_path_only()
    assert str(tmp_path) in sys.path
    assert SAFE_PATH not in os.environ, (
        "a command of the user's that the worker starts finds files beside its script"
    )
    monkeypatch.delenv("PYTHONPATH")
    own_path_only()
    assert not {"", str(tmp_path)} & set(sys.path)


def test_two_files_beside_modules_of_one_name_are_refused(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "part.py").write_text("from same_name_twice import Mine\n")
        (tmp_path / name / "same_name_twice.py").write_text(
            f"{BASE}class Mine(Base):\n    note = '{name}'\n"
        )
    assert resolve("policy", f"{tmp_path}/a/part.py:Mine").note == "a"
    with pytest.raises(InputError, match="same_name_twice was imported from"):
        resolve("policy", f"{tmp_path}/b/part.py:Mine")
