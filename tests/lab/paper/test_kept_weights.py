"""The wheel has the shipped fixer and the budgets, and leaves out the weights of the paper's systems."""

import json
import shutil
import subprocess
import sys

LISTED = """
import json
from setuptools import Distribution
from setuptools.config.pyprojecttoml import apply_configuration

distribution = apply_configuration(Distribution({"script_name": "setup.py"}), "pyproject.toml")
build = distribution.get_command_obj("build_py")
build.ensure_finalized()
data = [f"{source}/{name}" for _, source, _, names in build.data_files for name in names]
print(json.dumps(sorted([*build.get_source_files(), *data])))
"""


def files_of_the_wheel(folder):
    """Return the files that setuptools takes into the wheel of a source tree."""
    done = subprocess.run(
        [sys.executable, "-c", LISTED], cwd=folder, check=True, capture_output=True, text=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def test_the_wheel_leaves_the_weights_of_the_papers_systems_out(repo, tmp_path):
    shutil.copy(repo / "pyproject.toml", tmp_path)
    shutil.copy(repo / "README.md", tmp_path)
    shutil.copytree(repo / "configs", tmp_path / "configs")
    (tmp_path / "alpasim_plugin").mkdir()
    shutil.copy(repo / "alpasim_plugin" / "__init__.py", tmp_path / "alpasim_plugin")
    weights = tmp_path / "configs" / "paper" / "weights"
    for name in ("fixer.safetensors", "fixer.card.json", "stage.json"):
        (weights / "train-V9").mkdir(exist_ok=True)
        (weights / "train-V9" / name).write_bytes(b"{}")
    files = files_of_the_wheel(tmp_path)
    assert "configs/fixers/weights/onefixer.safetensors" in files
    assert "configs/paper/small.yaml" in files
    assert "configs/paper/pilot/quality.json" in files
    assert [name for name in files if name.startswith("configs/paper/weights")] == []
