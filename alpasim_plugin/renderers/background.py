"""The background file of a scenario: read, placed, and refused where nothing of it could be seen on
the drive.

`Coverage` says whether a Gaussian file stands where the drive is: its bounds, and the share of the
path near it.
"""

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.types import F64, BackgroundFile, Scenario
from alpasim_plugin.gaussians.cloud import GaussianCloud, placed_cloud
from alpasim_plugin.gaussians.files import read_gaussians

# A Gaussian is near a point of the path: in plan view, and in height.
NEAR_M = 10.0
BELOW_M = 5.0
ABOVE_M = 15.0
FEWEST = 20  # Gaussians near a point of the path for it to count as covered
STEP_M = 2.0
VISIBLE = 0.05  # opacity
BULK = (1.0, 99.0)  # percentiles: files have strays


@dataclass(frozen=True)
class Coverage:
    """Where a model stands.

    Attributes:
        low, high: ``(3,)`` bounds of its bulk (1st to 99th percentile of what is not transparent),
            metres, world.
        covered: Share of the path with Gaussians near it, 0..1.
    """

    low: F64
    high: F64
    covered: float

    def __str__(self) -> str:
        spans = (
            f"{axis} {low:.1f} to {high:.1f}"
            for axis, low, high in zip("xyz", self.low, self.high, strict=True)
        )
        return f"it spans {', '.join(spans)} m and covers {100 * self.covered:.0f} % of the route"


def coverage_of(cloud: GaussianCloud, path: F64) -> Coverage:
    """Measure how much of a path a model covers.

    Args:
        cloud: In world coordinates.
        path: ``(N, 3)`` metres, world: the recorded drive.
    """
    points = np.asarray(cloud.means[cloud.opacities > VISIBLE], dtype=np.float64)
    if not len(points):
        return Coverage(np.full(3, np.nan), np.full(3, np.nan), 0.0)
    low, high = np.percentile(points, BULK, axis=0)
    length_m = float(arc_lengths(path[:, :2])[-1])
    places = resample(path, np.linspace(0.0, length_m, max(2, int(length_m / STEP_M) + 1)))
    near = [
        np.sum(
            (np.hypot(*(points[:, :2] - place[:2]).T) <= NEAR_M)
            & (points[:, 2] >= place[2] - BELOW_M)
            & (points[:, 2] <= place[2] + ABOVE_M)
        )
        for place in places
    ]
    return Coverage(low, high, float(np.mean(np.array(near) >= FEWEST)))


LEAST = 0.05  # share of the route with Gaussians near it; below it the cameras look into emptiness


def read_background(
    background: BackgroundFile, path: F64
) -> tuple[GaussianCloud, Coverage, tuple[str, ...]]:
    """Read a background file and measure how it covers the drive.

    Args:
        background: The file and its transform.
        path: ``(N, 3)`` recorded positions, metres, world.

    Returns:
        The Gaussians in the file's frame, their coverage once placed, and notes on the file.

    Raises:
        InputError: It cannot be read, no Gaussian of it can be drawn, or it covers next to nothing
            of the path.
    """
    cloud, report = read_gaussians(background.path)
    if report.n_kept == 0:
        raise InputError(
            f"{background.path}: {report}",
            "give a file with at least one drawable Gaussian",
        )
    coverage = coverage_of(placed_cloud(cloud, background.T_world_file), path)
    if coverage.covered < LEAST:
        low = path.min(axis=0)
        high = path.max(axis=0)
        drive = ", ".join(
            f"{axis} {least:.1f} to {most:.1f}"
            for axis, least, most in zip("xyz", low, high, strict=True)
        )
        raise InputError(
            f"{background.path}: {coverage}, which runs through {drive} m: nothing of it would be seen",
            "give background.transform, from the file's frame to the world (docs/scenario-files.md)",
        )
    return cloud, coverage, report.notes


def background_note(scenario: Scenario) -> str:
    """Say in one sentence what the scenario's background file shows; empty without one.

    Raises:
        InputError: As `read_background`.
    """
    if scenario.background is None:
        return ""
    _, coverage, notes = read_background(scenario.background, scenario.ego_log.xyz)
    road = (
        "the built road is drawn with it"
        if scenario.background.keep_road
        else "it replaces the built road, markings and houses"
    )
    return f"background {scenario.background.path}: {'; '.join([str(coverage), road, *notes])}"
