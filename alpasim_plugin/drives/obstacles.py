"""Standing obstacles of a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence

from alpasim_plugin.core.types import HeightField, Trajectory
from alpasim_plugin.gaussians.cloud import GaussianCloud
from scenarios.drive import Obstacle


def standing_obstacles(cloud: GaussianCloud, ground: HeightField, ego: Trajectory) -> Sequence[Obstacle] | None:
    """Return what stands beside the path."""
    return None
