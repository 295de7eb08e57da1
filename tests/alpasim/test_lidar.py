"""`render_lidar` over our renderer: points from depth, against exact geometry."""

import numpy as np
import pytest

from alpasim_plugin.alpasim.server.sensorsim import LIDARS, points_of
from alpasim_plugin.log.wire import sensorsim_pb2

GROUND_M = -1.9  # the plane z
BOX = np.array([[8.0, -1.0, -1.9], [12.0, 1.0, -0.4]])  # least and greatest corner


def plain_lengths(rays):
    """How far each ray goes until it meets the plane or the box; infinite where it meets
    neither.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(rays[:, 2] < 0, GROUND_M / rays[:, 2], np.inf)
        first = BOX[0] / rays
        second = BOX[1] / rays
    enter = np.fmin(first, second).max(axis=1)
    leave = np.fmax(first, second).min(axis=1)
    return np.minimum(plane, np.where((enter <= leave) & (enter > 0), enter, np.inf))


@pytest.mark.parametrize("device", [sensorsim_pb2.PANDAR128, sensorsim_pb2.AT128])
def test_points_of_a_plane_and_a_box_are_exact_but_at_edges(device):
    lidar = LIDARS[device]
    depths = []
    cameras = lidar.cameras()
    for camera in cameras:
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        p = np.stack(
            [
                (u - camera.K[0, 2]) / camera.K[0, 0],
                (v - camera.K[1, 2]) / camera.K[1, 1],
                np.ones_like(u),
            ],
            axis=-1,
        ).reshape(-1, 3)
        length = plain_lengths(
            p @ camera.T_rig_camera[:3, :3].T
        )  # in units of the ray whose depth is 1
        depths.append(np.where(length < 500, length, 0.0).reshape(u.shape).astype(np.float32))
    rays = lidar.rays()
    assert len(lidar.rows_deg) == 128
    xyz, bright = points_of(
        rays, cameras, depths, [np.full((*d.shape, 3), 51, dtype=np.uint8) for d in depths]
    )
    found = np.linalg.norm(xyz, axis=1)
    error_m = np.abs(found - plain_lengths(xyz / found[:, None]))
    assert np.median(error_m) < 1e-4
    assert np.mean(error_m > 0.02) < 0.01
    assert np.count_nonzero(np.abs(xyz[:, 0] - 8.0) < 1e-3) > 500  # the near face of the box
    expected = np.count_nonzero(plain_lengths(rays) <= 200)
    assert abs(len(xyz) - expected) < 0.01 * expected
    np.testing.assert_allclose(bright, 0.2)
