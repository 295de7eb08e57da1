"""`render_lidar` over our renderer: points from depth, against exact geometry."""

from __future__ import annotations

import numpy as np
import pytest

from alpasim_plugin.alpasim.server.assembly import Settings, assemble
from alpasim_plugin.alpasim.server.sensorsim import LIDARS, points_of
from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.log.schema import wire_pose
from alpasim_plugin.log.wire import sensorsim_pb2
from alpasim_plugin.log.wire.services import Stub
from scenarios.load import load_scenario
from tests.alpasim.service_cases import channel_to, hosted

GROUND_M = -1.9  # the plane z
BOX = np.array([[8.0, -1.0, -1.9], [12.0, 1.0, -0.4]])  # least and greatest corner


def plain_lengths(rays: np.ndarray) -> np.ndarray:
    """How far each ray goes until it meets the plane or the box; infinite where it meets
    neither.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(rays[:, 2] < 0, GROUND_M / rays[:, 2], np.inf)
        first, second = BOX[0] / rays, BOX[1] / rays
    enter, leave = np.fmin(first, second).max(axis=1), np.fmax(first, second).min(axis=1)
    return np.minimum(plane, np.where((enter <= leave) & (enter > 0), enter, np.inf))


@pytest.mark.parametrize("device", [sensorsim_pb2.PANDAR128, sensorsim_pb2.AT128])
def test_points_of_a_plane_and_a_box_are_exact_but_at_edges(device):
    lidar = LIDARS[device]
    depths, cameras = [], lidar.cameras()
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
        rays, cameras, depths, [np.full((*d.shape, 3), 51, np.uint8) for d in depths]
    )
    found = np.linalg.norm(xyz, axis=1)
    error_m = np.abs(found - plain_lengths(xyz / found[:, None]))
    assert np.median(error_m) < 1e-4
    assert np.mean(error_m > 0.02) < 0.01
    assert np.count_nonzero(np.abs(xyz[:, 0] - 8.0) < 1e-3) > 500  # the near face of the box
    expected = np.count_nonzero(plain_lengths(rays) <= 200)
    assert abs(len(xyz) - expected) < 0.01 * expected
    np.testing.assert_allclose(bright, 0.2)


@pytest.mark.slow
def test_gaussians_of_a_road_and_a_car_are_where_they_are():
    scenario = load_scenario("smoke/lead_car")
    made = assemble(Settings(renderer="clean", scenes=["smoke/lead_car"], threads=1))
    t_us, up = scenario.start_us + 1_000_000, np.eye(4)
    up[2, 3] = -GROUND_M
    ego = interpolate(scenario.ego_log, t_us)
    sensor = wire_pose(ego @ up, "a test")
    asked = sensorsim_pb2.LidarRenderRequest(
        scene_id=scenario.scene_id,
        frame_start_us=t_us - 100_000,
        frame_end_us=t_us,
        lidar_config={"lidar_type": sensorsim_pb2.AT128},
        sensor_pose=sensorsim_pb2.PosePair(start_pose=sensor, end_pose=sensor),
    )
    car = next(actor for actor in scenario.actors if not actor.is_static)
    ahead = np.eye(4)
    ahead[:3, 3] = 15.0, 0.0, car.box.height_m / 2
    box = ego @ ahead
    asked.dynamic_objects.add(
        track_id=car.actor_id,
        pose_pair={"start_pose": wire_pose(box, "a test"), "end_pose": wire_pose(box, "a test")},
    )
    with hosted({"SensorsimService": made.service}) as host, channel_to(host) as channel:
        stub = Stub(channel, "SensorsimService")
        answer = stub.render_lidar(asked)
        both = stub.render_aggregated(sensorsim_pb2.AggregatedRenderRequest(lidar_requests=[asked]))
    assert both.lidar_returns[0] == answer
    xyz = np.frombuffer(answer.point_xyzs_buffer, "<f4").reshape(-1, 3)
    assert len(xyz) == answer.num_points == len(answer.point_intensities_buffer) // 4
    near = (
        (xyz[:, 0] > 7)
        & (xyz[:, 0] < 12)
        & (np.abs(xyz[:, 1]) < 1.5)
        & (xyz[:, 2] < GROUND_M + 0.4)
    )
    road_m = xyz[near, 2] - GROUND_M
    centre = (np.linalg.inv(ego @ up) @ box)[:3, 3]
    rear = centre[0] - car.box.length_m / 2
    on_car = (
        (np.abs(xyz[:, 1] - centre[1]) < 0.5)
        & (np.abs(xyz[:, 2] - centre[2]) < 0.3)
        & (np.abs(xyz[:, 0] - rear) < 2)
    )
    car_m = xyz[on_car, 0] - rear
    print(
        "road",
        np.median(road_m),
        np.percentile(np.abs(road_m), 95),
        len(road_m),
        "car",
        np.median(car_m),
        np.percentile(np.abs(car_m), 95),
        len(car_m),
    )
    assert np.median(np.abs(road_m)) < 0.05
    assert len(car_m) > 20
    assert abs(np.median(car_m)) < 0.25
