"""With ``--json`` standard output holds one document, whoever else writes to it: a part while it is
imported, the processes that it starts, and what runs after the verb.
"""

import json
import subprocess
import sys

import pytest

LOUD = """
import atexit, os, subprocess, sys
from policies.simple import PurePursuit
from simrun import Frame
import numpy as np

def shout(place):
    print("printed", place)
    os.write(1, b"written\\n")
    subprocess.run([sys.executable, "-c", "print('by a child')"], check=True)

shout("at import")
atexit.register(shout, "at the end")

class Loud(PurePursuit):
    def reset(self, seed, route):
        shout("in reset")
        super().reset(seed, route)

class Grey:
    def __init__(self, scenario):
        shout("in the making")
    def render(self, request):
        camera = request.camera
        image = np.full((camera.height, camera.width, 3), 128, dtype=np.uint8)
        return Frame(request.t_us, camera.name, image)
"""
SCENE = """version: 1
road: {segments: [{kind: straight, length_m: 200}]}
timing: {duration_us: 600000}
"""
DRIVE = ["--renderer", "clean", "--policy", "loud.py:Loud", "scene.yaml"]
RUN = [*DRIVE, "--workers", "1", "--no-report", "--images", "none", "--out", "run"]


@pytest.mark.parametrize(
    ("words", "key"),
    [
        pytest.param([*RUN, "-q", "--json"], "summary", marks=pytest.mark.slow),
        pytest.param([*DRIVE, "--dry-run", "--json"], "rollouts", marks=pytest.mark.slow),
        (["check", "policy", "loud.py:Loud", "--json"], "checks"),
        pytest.param(
            ["check", "renderer", "loud.py:Grey", "--scenario", "scene.yaml", "--json"],
            "renderer",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            [*DRIVE[:2], "--policy", "loud.py:Absent", "scene.yaml", "--json"],
            "error",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_part_and_its_children_write_to_standard_error(tmp_path, words, key):
    (tmp_path / "loud.py").write_text(LOUD)
    (tmp_path / "scene.yaml").write_text(SCENE)
    done = subprocess.run(
        [sys.executable, "-m", "alpasim_plugin.cli.main", *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert key in json.loads(done.stdout)
    assert "written" in done.stderr or key == "error"
