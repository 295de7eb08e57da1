"""The thin distribution for AlpaSim's environment: built from this checkout, installed beside
packages with AlpaSim's pins, and used.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest
import yaml

from alpasim_plugin.alpasim.bridge import build as building
from tests.alpasim.test_wire_generated import environment

PINS = ("protobuf>=4.25,<5", "grpcio==1.62.3", "hydra-core")  # as AlpaSim's own (main, 3032e0c)
USING = """
import sys
from importlib import metadata
(entry,) = metadata.entry_points(group="alpasim.configs")
assert entry.name == "onefixer" and entry.load().__name__ == entry.value
from hydra import compose, initialize_config_module
with initialize_config_module(version_base=None, config_module=entry.value):
    assert compose("renderer/onefixer").runtime.renderer.kind == "sensorsim"
assert not {"torch", "numba", "av", "alpasim_plugin"} & set(sys.modules), sys.modules.keys()
"""

REPO = Path(__file__).resolve().parents[2]
PAGE, SCENES = (
    REPO / "docs" / "alpasim.md",
    REPO.parent / "shared" / "data" / "alpasim-golden" / "scenes",
)
WIZARD = "SIMRUN_ALPASIM_PYTHON"


@pytest.fixture(scope="module")
def staged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bridge")
    building.stage(folder)
    return folder


def test_presets_are_of_the_group_renderer_and_name_one_endpoint(staged):
    presets = sorted((staged / building.PACKAGE / "configs" / "renderer").glob("*.yaml"))
    kinds = {}
    for path in presets:
        assert path.read_text().startswith("# @package _global_\n")
        preset = yaml.safe_load(path.read_text())
        kinds[path.stem] = preset["runtime"]["renderer"]["kind"]
        assert len(preset["wizard"]["external_services"]["renderer"]) == 1
        assert preset["runtime"]["endpoints"]["physics"]["skip"]
        assert preset["runtime"]["simulation_config"]["physics_update_mode"] == "NONE"
        assert preset["wizard"]["debug_flags"]["use_localhost"]
        assert "driver" in preset["wizard"]["run_sim_services"]
    assert kinds == {"onefixer": "sensorsim"}


LINES = [
    shlex.split(line, comments=True)
    for line in re.findall(r"-m alpasim_wizard (.*)", PAGE.read_text().replace("\\\n", " "))
]


@pytest.mark.slow
@pytest.mark.parametrize("words", LINES, ids=lambda words: " ".join(words[2:]))
def test_alpasims_wizard_gives_an_address_of_every_service_that_is_not_skipped(
    staged, tmp_path, words
):
    python = os.environ.get(WIZARD)
    if python is None:
        pytest.skip(f"needs {WIZARD}, a Python that has AlpaSim's wizard")
    facts = staged / f"{building.PACKAGE}-0.dist-info"
    facts.mkdir(exist_ok=True)
    (facts / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {building.PACKAGE}\nVersion: 0\n"
    )
    (facts / "entry_points.txt").write_text(
        f"[alpasim.configs]\nonefixer = {building.PACKAGE}.configs\n"
    )
    still = (
        "wizard.run_method=NONE",
        "wizard.validate_mount_points=false",
        "scenes.scene_ids=null",
        f"scenes.local_usdz_dir={SCENES}",
    )
    command = [python, "-m", "alpasim_wizard", *words, *still, f"wizard.log_dir={tmp_path}"]
    path = os.pathsep.join([str(staged), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}
    )
    assert done.returncode == 0, done.stderr[-2000:]
    network = yaml.safe_load((tmp_path / "generated-network-config.yaml").read_text())
    asked = yaml.safe_load((tmp_path / "generated-user-config-0.yaml").read_text())["endpoints"]
    for name, service in network.items():
        assert bool(service["endpoints"]) != asked[name].get("skip", False), name
        assert all(one["address"].startswith("localhost:") for one in service["endpoints"])


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_wheel_installs_beside_alpasims_pins_and_gives_the_presets(tmp_path):
    wheel = building.build(tmp_path / "dist")
    python = environment(tmp_path / "venv", *PINS)
    subprocess.run([python, "-m", "pip", "install", "-q", str(wheel)], check=True)
    subprocess.run([python, "-c", USING], check=True, cwd=tmp_path)
