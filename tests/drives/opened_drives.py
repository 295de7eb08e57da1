"""Drives opened from folders, and what each must hold."""

import numpy as np
import pytest

from alpasim_plugin.drives.build import _points
from alpasim_plugin.drives.opening import read_source
from alpasim_plugin.drives.placing import place
from alpasim_plugin.drives.source import checked
from tests.drives.street import COUNT, STEP_M

WAY_M = (COUNT - 1) * STEP_M


def told(*given):
    """Take reports of progress."""


def opened(folder):
    drive = checked(read_source(folder), folder)
    return drive, place(drive, _points(drive, folder, told), camera_height_m=1.5)


def assert_is_the_street(placed):
    ego = placed.ego.xyz
    assert np.linalg.norm(ego[-1] - ego[0]) == pytest.approx(WAY_M, rel=0.03)
    assert np.abs(placed.strip.section_errors).max() < 0.05
    mount = placed.mounts[next(iter(placed.mounts))]
    assert mount[2, 3] == pytest.approx(1.5, abs=0.08)
    assert mount[:3, 2] == pytest.approx([1.0, 0.0, 0.0], abs=0.05)  # it looks ahead
