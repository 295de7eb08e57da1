"""The pose of a camera that looks along x of its rig."""

import numpy as np


def ahead(height_m=1.5, x_m=0.0):
    """Return it ``(4, 4)``, so high above the ground and so far ahead of the rear axle."""
    return np.array([[0.0, 0, 1, x_m], [-1, 0, 0, 0], [0, -1, 0, height_m], [0, 0, 0, 1]])
