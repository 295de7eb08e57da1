"""The core neither names nor needs the rooms of the block generators and of the laboratory."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2] / "alpasim_plugin"
ROOMS = ("alpasim_plugin.block_fixers", "alpasim_plugin.lab")
LABORATORY = ("training", "bench", "nets/judges", "cli/train", "cli/bench", "cli/quality", "cli/judge")  # works with the rooms
NETWORKS_OF_JUDGES = {"i3d", "lpips", "dists", "perceptual", "image_distance"}

ALONE = """
import importlib, importlib.abc, pkgutil, sys

class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.startswith({rooms!r}):
            raise ImportError("refused: " + name)

sys.meta_path.insert(0, Refuse())
"""
IMPORT_ALL = """
for room in ("fixers", "nets", "renderers"):
    package = importlib.import_module("alpasim_plugin." + room)
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        parts = module.name.split(".")
        if "judges" not in parts and parts[-1] not in {judges!r}:
            importlib.import_module(module.name)
"""
REPAIR = """
import numpy as np
from alpasim_plugin.fixers import make_fixer
from alpasim_plugin.core.types import Frame

rgb = np.full((32, 48, 3), 90, np.uint8)
alpha = np.ones((32, 48), np.float32)
alpha[8:16, 8:16] = 0
fixer = make_fixer("onefixer", scene_id="scene", seed=0)
(fixed,) = fixer.step([Frame(0, "front", rgb, alpha, None)], [])
assert fixer.trained and not fixed.events and (fixed.rgb != rgb).any()
"""
ABSENT = """
import alpasim_plugin.core.lazy
alpasim_plugin.core.lazy.installed = lambda group: {}
try:
    from alpasim_plugin.nets import WanVAE
except ImportError as error:
    assert "WanVAE" in str(error) and "simrun.networks" in str(error), error
else:
    raise AssertionError("a network without its room")
"""


def alone(*code: str) -> None:
    """Run code in a process that can import neither room."""
    text = "".join((ALONE, *code)).replace("{rooms!r}", repr(ROOMS)).replace("{judges!r}", repr(NETWORKS_OF_JUDGES))
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr


def core_files() -> list[Path]:
    files = [path for path in sorted(ROOT.rglob("*.py")) if not path.name.endswith("_pb2.py")]
    rooms = ("block_fixers/", "lab/", *LABORATORY)
    return [
        path for path in files if not str(path.relative_to(ROOT)).startswith(rooms) and not ("nets" in path.parts and path.stem in NETWORKS_OF_JUDGES)
    ]


def test_no_module_of_the_core_imports_or_names_a_room() -> None:
    found = []
    for path in core_files():
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                names = [node.value]
            found += [f"{path.name}:{node.lineno}: {name[:60]}" for name in names if any(room in name for room in ROOMS)]
    assert found == []


def test_every_core_module_of_fixers_networks_and_renderers_imports_without_the_rooms() -> None:
    alone(IMPORT_ALL)


def test_onefixer_repairs_a_frame_without_the_rooms() -> None:
    alone(REPAIR)


def test_a_network_whose_package_is_absent_is_named_in_the_error() -> None:
    alone(ABSENT)


@pytest.mark.parametrize("name", ["CosmosCausalDiT", "DiTSizes", "TextContext", "TinyDecoder", "TinyVAE", "WanVAE"])
def test_networks_of_the_block_generators_are_imported_by_their_public_names(name: str) -> None:
    from alpasim_plugin import nets

    assert getattr(nets, name).__module__.startswith(ROOMS[0])
    with pytest.raises(AttributeError, match="no attribute"):
        nets.nothing  # noqa: B018
