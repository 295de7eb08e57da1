"""The ground below a drive: it bows, tilts and has kerbs; what stands on it, and how few points
there are, does not move it.
"""

import numpy as np
import pytest

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.drives.ground import fit_ground
from alpasim_plugin.drives.source import Points

HEIGHT_M = 1.6
PATH_X = np.arange(0.0, 60.0, 1.0)


def road(x, y):
    """Return a road that rises to a crest, tilts, and has kerbs of 12 cm beside it."""
    return 0.6 * np.sin(x / 20) + 0.02 * y + np.where(np.abs(y) > 2.0, 0.12, 0.0)


def path():
    return np.column_stack([PATH_X, 0 * PATH_X, road(PATH_X, 0 * PATH_X) + HEIGHT_M])


def points_on(xy, lift=0.0):
    z = road(xy[:, 0], xy[:, 1]) + lift
    return Points(
        np.column_stack([xy, z]),
        np.full((len(xy), 3), 0.5),
        np.tile(np.eye(3) * 0.01**2, (len(xy), 1, 1)),
    )


@pytest.mark.parametrize("unit", [1.0, 0.02, 300.0])
def test_it_follows_a_crest_in_any_unit(unit):
    xy = stream("ground", 0, "road").uniform([0, -3], [60, 3], (1500, 2))
    scale = np.diag([unit, unit, unit, 1.0])
    strip = fit_ground(points_on(xy).moved(scale), unit * path())
    assert strip.height / unit == pytest.approx(HEIGHT_M, abs=0.02)
    wheels = np.array([[x, y] for x in np.arange(4.0, 56.0, 2.0) for y in (-0.8, 0.0, 0.8)])
    assert np.abs(strip.z(unit * wheels) / unit - road(*wheels.T)).max() < 0.03


def test_what_stands_on_it_does_not_lift_it():
    rng = stream("ground", 0, "cars")
    xy = rng.uniform([0, -1.4], [60, 1.4], (400, 2))
    cars = rng.uniform([0, -2.2], [60, 2.2], (500, 2))
    strip = fit_ground(points_on(xy).joined(points_on(cars, rng.uniform(0.2, 1.0, 500))), path())
    wheels = np.column_stack([np.arange(4.0, 56.0, 2.0), np.zeros(26)])
    assert np.abs(strip.z(wheels) - road(*wheels.T)).max() < 0.05


def test_few_points_under_the_path_are_helped_by_those_beside_it():
    rng = stream("ground", 0, "few")
    under = rng.uniform([0, -1.4], [60, 1.4], (20, 2))
    beside = rng.uniform([0, 1.7], [60, 1.95], (60, 2))
    strip = fit_ground(points_on(np.concatenate([under, beside])), path())
    assert strip.height == pytest.approx(HEIGHT_M, abs=0.1)


def test_too_few_points_are_no_ground():
    assert (
        fit_ground(
            points_on(stream("ground", 0, "none").uniform([0, -1], [60, 1], (12, 2))), path()
        )
        is None
    )
    nothing = Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert fit_ground(nothing, path()) is None
