"""The background file of a scenario: read, placed, and refused where nothing of it could be seen on the drive."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, BackgroundFile, Scenario
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files.formats import read_gaussians
from alpasim_plugin.gaussians.scene.builder import placed_cloud
from alpasim_plugin.gaussians.scene.coverage import Coverage, coverage_of, suggested_transform

LEAST = 0.05  # share of the route with Gaussians near it; below it the cameras look into emptiness


def read_background(background: BackgroundFile, path: F64) -> tuple[GaussianCloud, Coverage]:
    """Read a background file and measure how it covers the drive.

    Args:
        background: The file and its transform.
        path: ``(N, 3)`` recorded positions, metres, world.

    Returns:
        The Gaussians in the file's frame, and their coverage once placed.

    Raises:
        InputError: It cannot be read, no Gaussian of it can be drawn, or it covers next to nothing of the path; then the error suggests a
            transform.
    """
    cloud, report = read_gaussians(background.path)
    if report.n_kept == 0:
        raise InputError("loading a background", background.path, str(report), "give a file with at least one drawable Gaussian")
    coverage = coverage_of(placed_cloud(cloud, background.T_world_file), path)
    if coverage.covered < LEAST:
        low, high = path.min(axis=0), path.max(axis=0)
        drive = ", ".join(f"{axis} {a:.1f} to {b:.1f}" for axis, a, b in zip("xyz", low, high, strict=True))
        found = f"{coverage}, which runs through {drive} m: nothing of it would be seen"
        raise InputError("placing a background", background.path, found, _advice(cloud, path))
    return cloud, coverage


def background_note(scenario: Scenario) -> str:
    """Say in one sentence what the scenario's background file shows; empty without one.

    Raises:
        InputError: As `read_background`.
    """
    if scenario.background is None:
        return ""
    _, coverage = read_background(scenario.background, scenario.ego_log.xyz)
    road = "the built road is drawn with it" if scenario.background.keep_road else "it replaces the built road, markings and houses"
    return f"background {scenario.background.path}: {coverage}; {road}"


def _advice(cloud: GaussianCloud, path: F64) -> str:
    guess = suggested_transform(cloud, path)
    if coverage_of(placed_cloud(cloud, guess), path).covered < LEAST:
        return "give background.transform; the file is too small or too sparse for the route as it stands, its scale may be wrong"
    rows = ", ".join("[" + ", ".join(_short(v) for v in row) + "]" for row in guess)
    return f"a transform to start from: transform: [{rows}]"


def _short(value: float) -> str:
    """Print a number of a matrix; a rotation with fewer digits would be refused as none."""
    return f"{np.round(value, 7) + 0.0:.8g}"
