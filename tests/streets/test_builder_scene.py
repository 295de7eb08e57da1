from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.geometry import quat_from_yaw, se3
from alpasim_plugin.core.types import Environment, LaneMap
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import placed_cloud
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.gaussians.scene.scene_graph import with_background
from alpasim_plugin.streets.builder import build_scene
from alpasim_plugin.streets.site import make_site
from alpasim_plugin.world.ground import height_at
from tests.examples import first_of
from tests.gaussians.scene_maps import (
    STREET_ACTORS,
    camera_spec,
    crossing,
    curve,
    line,
    make_scenario,
    road_lanes,
    straight,
)

pytestmark = pytest.mark.slow


def built(scenario):
    return build_scene(scenario, partial(height_at, scenario.ground))


def view(scenario, index, left_m=0.0, width=256, height=144):
    T = se3(scenario.ego_log.xyz[index], scenario.ego_log.quat[index])
    T[:3, 3] += left_m * T[:3, 1]
    spec = camera_spec(width, height)
    return PinholeCamera.from_pose(width, height, spec.K, T @ spec.T_rig_camera)


def digest(graph):
    nodes = (*graph.background, *graph.actors.values())
    return b"".join(
        a.tobytes()
        for n in nodes
        for lv in n.levels
        for a in (lv.cloud.means, lv.cloud.quats, lv.cloud.scales, lv.cloud.sh)
    )


@pytest.fixture(scope="module")
def street():
    scenario = straight()
    return scenario, built(scenario)


def test_same_scenario_builds_bit_identical_gaussians(street):
    assert digest(street[1]) == digest(built(straight()))


@lru_cache(maxsize=3)
def empty_street(make):
    scenario = make(actors=())
    return scenario, built(scenario)


@pytest.mark.parametrize("make", first_of([crossing, straight, curve]))
@pytest.mark.parametrize("left_m", [0.0, 3.0])
def test_ground_has_no_holes_from_the_path_or_three_metres_aside(make, left_m):
    scenario, graph = empty_street(make)
    n = len(scenario.ego_log)
    for index in (0, n // 2, n - 1):
        alpha = graph.render(view(scenario, index, left_m), {}).alpha[90:]
        assert alpha.min() > 0.8
        assert np.mean(alpha < 0.93) < 0.01


def test_lane_lines_are_brighter_than_the_asphalt_beside_them(
    street,
):
    scenario, graph = street
    camera = view(scenario, 2, width=480, height=272)
    image = graph.render(camera, {}).rgb
    eye = camera.centre_world

    def seen(y_m, ahead_m):
        p = (
            camera.T_camera_world[:3, :3] @ np.array([eye[0] + ahead_m, y_m, 0.0])
            + camera.T_camera_world[:3, 3]
        )
        return np.asarray(
            image[
                int(camera.fy * p[1] / p[2] + camera.cy), int(camera.fx * p[0] / p[2] + camera.cx)
            ]
        )

    for ahead in (10.0, 13.0, 17.0):
        edge = seen(-7.2, ahead)
        lane = seen(-1.8, ahead)
        centre = seen(0.16, ahead)
        assert edge.min() > lane.max() + 0.15  # the white line at the right edge
        assert centre[0] > centre[2] + 0.15  # the yellow line between the directions
        assert np.ptp(lane) < 0.06


def test_lines_and_lamps_are_sharper_where_a_camera_has_more_pixels_per_radian(street):
    scenario, usual = street
    camera = camera_spec(1280, 720)
    sharp = built(replace(scenario, cameras=(camera,)))

    def steepest(graph):
        steps = np.diff(graph.render(view(scenario, 0, 0.0, 1280, 720), {}).rgb[400:], axis=1)
        return np.quantile(np.abs(steps).max(axis=-1), 0.999)

    assert steepest(sharp) > 1.2 * steepest(usual)
    assert len(sharp) > 1.1 * len(usual)


def test_a_camera_sees_the_same_whatever_sharper_cameras_its_rig_has(street):
    scenario, usual = street
    wide = camera_spec(1280, 720)
    tele = camera_spec(5120, 2880)
    alone, rig = (built(replace(scenario, cameras=some)) for some in ((wide,), (wide, tele)))
    actors = {name: log_actors(scenario, scenario.start_us)[name] for name in usual.actors}
    for size, graph in (((320, 180), usual), ((1280, 720), alone)):
        seen = [one.render(view(scenario, 0, 0.0, *size), actors).rgb for one in (graph, rig)]
        assert_array_equal(*seen)


def test_a_sharp_camera_sees_what_four_times_its_pixels_average_to(street):
    scenario, _ = street
    graph = built(replace(scenario, cameras=(camera_spec(1280, 720),)))
    whole = view(scenario, 0, 0.5, 2560, 1440)
    fine = graph.render(whole.window(slice(640, 880), slice(0, 2560)), {}).rgb
    averaged = fine.reshape(120, 2, 1280, 2, 3).mean(axis=(1, 3))

    def psnr_db(px_per_rad):
        camera = view(scenario, 0, 0.5, 1280, 720)
        seen = graph.render(camera, {}, px_per_rad=px_per_rad).rgb[320:440]
        return -10 * np.log10(np.mean((seen - averaged) ** 2))

    assert psnr_db(None) > max(40.0, psnr_db(400.0) + 3.0)


def test_houses_leave_road_actors_and_each_other_alone():
    scenario = straight(environment=Environment(buildings=1.0))
    site = make_site(scenario, partial(height_at, scenario.ground))
    graph = built(scenario)
    walls = [n for n in graph.background if n.name.startswith("house")]
    assert len(walls) > 8
    for node in walls:
        plan = site.frame.to_ground(node.levels[0].cloud.means.astype(np.float64))
        assert site.look_up(site.off_road_m, plan).min() > 1.5
        assert not site.look_up(site.taken, plan).any()


def test_map_without_edges_gets_a_road_around_its_centres():
    lanes = {
        k: replace(v, left=None, right=None)
        for k, v in road_lanes(line((-20, 0), (120, 0)), "r", 1).items()
    }
    scenario = make_scenario(LaneMap(lanes), line((0, -1.8), (60, -1.8)))
    site = make_site(scenario, partial(height_at, scenario.ground))
    on = site.look_up(
        site.road, site.frame.to_ground(np.array([[20.0, -1.8], [20.0, 1.8], [20.0, 12.0]]))
    )
    assert on.tolist() == [True, True, False]
    assert built(scenario).render(view(scenario, 3), {}).alpha[100:].min() > 0.8


def test_empty_map_gives_a_road_under_the_logged_path():
    scenario = make_scenario(LaneMap({}), line((0, 0), (50, 0)))
    site = make_site(scenario, partial(height_at, scenario.ground))
    assert site.look_up(site.road, site.path).all()
    assert built(scenario).render(view(scenario, 3), {}).alpha[100:].min() > 0.8


def test_actor_fills_its_box_and_stays_inside(street):
    for actor in STREET_ACTORS:
        cloud = street[1].actors[actor.actor_id].levels[0].cloud
        half = np.array([actor.box.length_m, actor.box.width_m, actor.box.height_m]) / 2
        low = cloud.means.min(axis=0)
        high = cloud.means.max(axis=0)
        assert np.all(low > -half - np.array([0.1, 0.15, 0.05]))
        assert np.all(high < half + np.array([0.1, 0.15, 0.05]))
        assert high[2] - low[2] > 1.4 * half[2]


def test_file_background_is_scaled_turned_and_cut_into_blocks(
    street,
):
    cloud = street[1].actors["bus-1"].levels[0].cloud
    T = np.eye(4)
    T[:3, :3] = 2.0 * se3([0, 0, 0], quat_from_yaw(0.5))[:3, :3]
    T[:3, 3] = (30.0, 5.0, 3.0)
    placed = placed_cloud(cloud, T)
    assert_allclose(placed.means, cloud.means @ T[:3, :3].T + T[:3, 3], atol=1e-9)
    assert_allclose(placed.scales, 2.0 * cloud.scales, rtol=1e-6)
    graph = with_background(street[1], cloud, T)
    added = graph.background[
        len(street[1].background) :
    ]  # what was there stays: its builder leaves the road out where the file has one
    assert sum(len(n.levels[0].cloud) for n in added) == len(cloud)
    assert len(added) > 1
    assert set(graph.actors) == set(street[1].actors)
