"""The thin distribution for AlpaSim's environment: built from this checkout, installed beside
packages with AlpaSim's pins, and used.
"""

import ast
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from alpasim_plugin.alpasim.bridge import build as building
from alpasim_plugin.alpasim.bridge.client import main
from tests.alpasim.service_cases import CAMERA
from tests.alpasim.wire_environment import environment
from tests.data_sets import shared_folder

# AlpaSim's own pins (main, 3032e0c): alpasim_grpc wants protobuf < 5 and was built with grpcio
# 1.62.3.
PINS = ("protobuf>=4.25,<5", "grpcio==1.62.3", "numpy>=2,<2.3", "hydra-core")
USING = """
import sys
from importlib import metadata
from google.protobuf import descriptor_pb2, descriptor_pool
foreign = descriptor_pb2.FileDescriptorProto(name="alpasim_grpc/v0/common.proto", package="common")
foreign.message_type.add(name="Vec3")
descriptor_pool.Default().AddSerializedFile(foreign.SerializeToString())
from alpasim_onefixer_bridge.client import main
(entry,) = metadata.entry_points(group="alpasim.configs")
assert entry.name == "onefixer" and entry.load().__name__ == entry.value
from hydra import compose, initialize_config_module
with initialize_config_module(version_base=None, config_module=entry.value):
    assert compose("renderer/onefixer").runtime.renderer.kind == "sensorsim"
code = main([sys.argv[1]])
assert not {"torch", "numba", "av", "alpasim_plugin"} & set(sys.modules), sys.modules.keys()
sys.exit(code)
"""

REPO = Path(__file__).resolve().parents[2]
PAGE = REPO / "docs" / "alpasim.md"
SCENES = shared_folder() / "alpasim-golden" / "scenes"
WIZARD = "SIMRUN_ALPASIM_PYTHON"


@pytest.fixture(scope="module")
def staged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bridge")
    building.stage(folder)
    return folder


def test_the_bridge_imports_nothing_heavy_and_nothing_of_the_project(staged):
    allowed = {"grpc", "google", "__future__", *sys.stdlib_module_names}
    modules = [path for path in staged.rglob("*.py") if not path.name.endswith("_pb2.py")]
    assert len(modules) >= 5
    for path in modules:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += (
                [node.module or ""] if isinstance(node, ast.ImportFrom) and node.level == 0 else []
            )
            assert {name.split(".")[0] for name in names} <= allowed, path


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


def test_the_command_says_what_a_service_is(upstream, capsys, monkeypatch):
    assert main([upstream.address]) == 0
    shown = capsys.readouterr().out
    assert "version stand-in" in shown
    assert CAMERA in shown
    monkeypatch.setattr("alpasim_plugin.alpasim.bridge.client.WAIT_S", 0.2)
    assert main(["127.0.0.1:1"]) == 4
    assert main([]) == 2


@pytest.mark.slow
@pytest.mark.network
@pytest.mark.timeout(3600)
def test_the_wheel_installs_beside_alpasims_pins_and_talks_to_a_service(upstream, tmp_path):
    wheel = building.build(tmp_path / "dist")
    python = environment(tmp_path / "venv", *PINS)
    subprocess.run([python, "-m", "pip", "install", "-q", str(wheel)], check=True)
    versions = subprocess.run(
        [python, "-m", "pip", "list", "--format=freeze"], check=True, capture_output=True, text=True
    ).stdout
    assert "protobuf==4.25" in versions
    assert "grpcio==1.62.3" in versions
    done = subprocess.run(
        [python, "-c", USING, upstream.address], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "version stand-in" in done.stdout
