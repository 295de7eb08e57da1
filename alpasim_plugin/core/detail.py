"""How fine a street is built for cameras with many pixels per radian."""

import numpy as np

from alpasim_plugin.core.types import Scenario

# Pixels per radian from which a camera sees that the usual cells are soft; 1.2 for 512 pixels across
# 70 degrees, and 2.5 for 1900 across 120.
USUAL_PX_PER_RAD = 450.0
MOST_HALVINGS = 2


def halvings_of(px_per_rad: float) -> int:
    """Return how many times the finest cells are halved for a camera with so many pixels per radian;
    0 for usual cameras.

    Each doubling beyond `USUAL_PX_PER_RAD` halves them once.
    """
    return min(int(np.log2(max(px_per_rad / USUAL_PX_PER_RAD, 1.0))), MOST_HALVINGS)


def halvings(scenario: Scenario) -> range:
    """Return the halvings for the cameras of a scenario, from the most to one; empty for usual
    cameras.
    """
    sharpest = max((camera.K[0, 0] for camera in scenario.cameras), default=1.0)
    return range(halvings_of(sharpest), 0, -1)
