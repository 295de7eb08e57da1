"""Where a Gaussian file stands relative to the drive, and where it might belong."""

import re

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.geometry import se2
from alpasim_plugin.gaussians.cloud import GaussianCloud, placed_cloud
from alpasim_plugin.gaussians.files.ply import write_ply
from alpasim_plugin.renderers.background import coverage_of

PATH = np.stack([np.linspace(0.0, 80.0, 81), np.zeros(81), np.zeros(81)], axis=1)
ROAD = """
version: 1
road: {segments: [{kind: straight, length_m: 120}]}
timing: {duration_us: 1000000}
"""


def street(n=6000):
    """Return a street of 80 x 16 m along x: ground, and two rows of house fronts up to 12 m
    high.
    """
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(0, 80, n), rng.uniform(-8, 8, n), rng.normal(0, 0.02, n)])
    wall = np.column_stack(
        [rng.uniform(0, 80, n // 3), rng.choice([-8.0, 8.0], n // 3), 12 * rng.random(n // 3) ** 2]
    )
    means = np.concatenate([ground, wall]).astype(np.float32)
    m = len(means)
    quats = np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (m, 1))
    return GaussianCloud(
        means,
        quats,
        np.full((m, 3), 0.3, dtype=np.float32),
        np.full(m, 0.9, dtype=np.float32),
        np.zeros((m, 1, 3), dtype=np.float32),
    )


# x right, y down, z forward, as structure from motion leaves a file; and a turn and a shift that no
# file tells of
T_FILE_WORLD = np.array([[0.0, -1, 0, 40], [0, 0, -1, 3], [1, 0, 0, -900], [0, 0, 0, 1]]) @ se2(
    5.0, 2.0, 0.6
)


def test_coverage_counts_the_part_of_the_path_that_has_gaussians_near_it():
    whole = coverage_of(street(), PATH)
    assert whole.covered == 1.0
    assert whole.low[0] == pytest.approx(0.8, abs=0.5)
    assert whole.high[2] < 12.0
    half = coverage_of(placed_cloud(street(), se2(-45.0, 0.0, 0.0)), PATH)
    assert half.covered == pytest.approx(0.53, abs=0.05)  # to 35 m, and 10 m further by nearness
    assert coverage_of(placed_cloud(street(), se2(0.0, 60.0, 0.0)), PATH).covered == 0.0
    above = np.eye(4)
    above[2, 3] = 30.0
    assert coverage_of(placed_cloud(street(), above), PATH).covered == 0.0
    clear = street()
    assert (
        coverage_of(
            GaussianCloud(clear.means, clear.quats, clear.scales, 0 * clear.opacities, clear.sh),
            PATH,
        ).covered
        == 0.0
    )


def test_a_file_that_cannot_be_seen_is_refused_until_it_is_placed(tmp_path, capsys):
    write_ply(tmp_path / "lying.ply", placed_cloud(street(), T_FILE_WORLD))
    scene = tmp_path / "scene.yaml"
    scene.write_text(ROAD + "background: {file: lying.ply}\n")
    command = ["--renderer", "clean", "--dry-run", "--json", str(scene)]
    assert run_command(command) == 2
    capsys.readouterr()
    matrix = np.linalg.inv(T_FILE_WORLD).tolist()
    scene.write_text(ROAD + f"background: {{file: lying.ply, transform: {matrix}}}\n")
    assert run_command(["--renderer", "clean", "--dry-run", str(scene)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert re.search(
        r"background .*lying.ply: it spans x .* and covers \d+ % of the route; it replaces the built road",
        told,
    )
