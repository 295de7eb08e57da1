"""The core does not need the rooms of the block generators and of the laboratory."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

ROOMS = ("alpasim_plugin.block_fixers", "alpasim_plugin.lab")

ALONE = """
import importlib, importlib.abc, pkgutil, sys

class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.startswith({rooms!r}):
            raise ImportError("refused: " + name)

sys.meta_path.insert(0, Refuse())
"""
IMPORT_ALL = """
for room in ("fixers", "renderers"):
    package = importlib.import_module("alpasim_plugin." + room)
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
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


def alone(*code):
    """Run code in a process that can import neither room."""
    text = "".join((ALONE, *code)).replace("{rooms!r}", repr(ROOMS))
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr


def test_without_the_rooms_core_modules_import_onefixer_repairs():
    alone(IMPORT_ALL, REPAIR)  # in one process: most of the time goes by while torch is imported
