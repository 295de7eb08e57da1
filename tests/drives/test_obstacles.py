"""What stands in a reconstruction can be hit where it is, and what was driven through is free."""

import numpy as np
import pytest

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import Trajectory, Vehicle
from alpasim_plugin.drives.obstacles import standing_obstacles
from alpasim_plugin.drives.source import Points
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.world.ground import flat
from scenarios.load import load_scenario

LOW, HIGH = np.array([12.0, 1.6, 0.0]), np.array([16.4, 3.4, 1.5])  # a parked car


def surface(low, high, count):
    """Return points on the four sides of an upright box."""
    rng = stream("obstacles", 0, "surface")
    points = rng.uniform(low, high, (count, 3))
    side = rng.integers(0, 4, count)
    for k, (axis, value) in enumerate(((0, low[0]), (0, high[0]), (1, low[1]), (1, high[1]))):
        points[side == k, axis] = value
    return points


def cloud_at(points, size_m=0.06, opacity=0.9):
    n = len(points)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    scales = np.full((n, 3), size_m)
    return GaussianCloud(points, quats, scales, np.full(n, opacity), np.zeros((n, 1, 3)))


def straight(length_m=30.0):
    x = np.arange(0.0, length_m)
    return Trajectory(
        (x * 1e5).astype(np.int64),
        np.column_stack([x, 0 * x, 0 * x]),
        np.tile([1.0, 0, 0, 0], (len(x), 1)),
    )


def points_at(xyz, spread_m):
    return Points(
        xyz, np.full(xyz.shape, 0.5), np.tile(np.eye(3) * spread_m**2 / 3, (len(xyz), 1, 1))
    )


def test_a_parked_car_stands_where_it_is_seen():
    body = surface(LOW, HIGH, 4000)
    found = standing_obstacles(
        cloud_at(body), points_at(body[::20], 0.05), flat(), straight(), Vehicle()
    ).obstacles
    corners = np.array(
        [
            one.xyz[:2] + side * np.array([one.box.length_m, one.box.width_m]) / 2
            for one in found
            for side in (-1, 1)
        ]
    )
    assert corners.min(axis=0) == pytest.approx(LOW[:2], abs=0.3)
    assert corners.max(axis=0) == pytest.approx(HIGH[:2], abs=0.3)
    assert max(one.xyz[2] + one.box.height_m / 2 for one in found) == pytest.approx(1.5, abs=0.1)
    assert [one.uncertainty_m for one in found] == pytest.approx([0.11] * len(found), abs=0.01)


def test_dark_doors_leave_no_hole_to_drive_into_and_what_stands_behind_is_apart():
    body = surface(LOW, HIGH, 4000)
    doors = (body[:, 0] > 13.7) & (body[:, 0] < 14.7) & (body[:, 1] < 3.0)
    hedge = surface(np.array([8.0, 5.2, 0.0]), np.array([20.0, 5.6, 1.2]), 4000)
    seen = np.concatenate([body[~doors], hedge])
    found = standing_obstacles(
        cloud_at(seen), points_at(seen[::20], 0.05), flat(), straight(), Vehicle()
    ).obstacles
    sides = [(one.xyz[1] - one.box.width_m / 2, one.xyz[1] + one.box.width_m / 2) for one in found]
    assert all(high < 3.9 or low > 4.7 for low, high in sides)
    for x in np.arange(12.2, 16.3, 0.4):
        near = [
            low
            for one, (low, _) in zip(found, sides, strict=True)
            if abs(x - one.xyz[0]) < one.box.length_m / 2 + 0.1
        ]
        assert min(near) == pytest.approx(LOW[1], abs=0.3)


def test_the_driven_path_is_free_and_what_was_opaque_there_is_counted():
    body = surface(LOW - np.array([0, 2.5, 0]), HIGH - np.array([0, 2.5, 0]), 4000)  # in the way
    found = standing_obstacles(cloud_at(body), points_at(body, 0.05), flat(), straight(), Vehicle())
    assert found.cleared > 50
    assert all(
        abs(one.xyz[1]) - one.box.width_m / 2 > Vehicle().box.width_m / 2 - 0.1
        for one in found.obstacles
    )


@pytest.mark.parametrize(
    ("size_m", "opacity", "lift_m"),
    [(0.06, 0.1, 0.0), (1.0, 0.9, 0.0), (0.06, 0.9, 3.0), (0.06, 0.9, -1.4)],
)
def test_haze_background_and_what_is_too_high_or_low_do_not_stand(size_m, opacity, lift_m):
    body = surface(LOW, HIGH, 3000) + np.array([0, 0, lift_m])
    assert (
        standing_obstacles(
            cloud_at(body, size_m, opacity), points_at(body, 0.05), flat(), straight(), Vehicle()
        ).obstacles
        == ()
    )


@pytest.mark.slow
def test_contact_with_what_stands_is_reported_apart(imported):
    from evaluators.metrics.collision import evaluate_collision
    from evaluators.metrics.presets import preset
    from tests.drives.rollouts import rollout_along

    scenario = load_scenario(imported / "scenario.yaml")
    assert scenario.scene.standing == "found"
    for lateral_m, touched in ((0.0, 0.0), (2.5, 1.0)):
        log = rollout_along(scenario, lateral_m, box=(np.array([14.0, 2.5]), 1.0))
        values = {
            one.name: one for one in evaluate_collision(log, scenario.scene, preset("strict"))
        }
        series = values["collision_standing"]
        assert series.valid.all()
        assert series.value.max() == touched
