"""What the log views say: when, who was there, and which holes are sky."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.scene.log_views import SkyMask, SkyView, log_actors
from alpasim_plugin.gaussians.scene.sky import STEP_PX, _upsample
from tests.gaussians.scene_maps import parked, straight


def camera(width, height, yaw_rad=0.0, x_m=0.0):
    T_rig_camera = np.eye(4)
    T_rig_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    K = [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]
    return PinholeCamera.from_pose(width, height, K, se2(x_m, 0, yaw_rad) @ T_rig_camera)


def view(alpha, name="", **pose):
    sky = (alpha <= 0.5).astype(np.float32)
    return SkyView(camera(alpha.shape[1], alpha.shape[0], **pose), sky, name)


def test_same_pose_at_twice_the_size_repeats_what_the_view_saw():
    alpha = np.ones((18, 32), dtype=np.float32)
    alpha[:8] = 0.0
    share = SkyMask([view(alpha)]).share(camera(64, 36))
    assert_array_equal(share[:15], 1.0)
    assert_array_equal(share[17:], 0.0)


def test_turning_left_moves_the_skyline_to_the_right():
    alpha = np.ones((18, 32), dtype=np.float32)
    alpha[:, 16:] = 0.0  # sky to the right of straight ahead
    share = SkyMask([view(alpha)]).share(camera(32, 18, yaw_rad=np.arctan(4 / 32)))
    columns = share[9] > 0.5
    assert np.flatnonzero(columns)[0] in (19, 20, 21)  # 4 columns on, as the focal length says
    assert columns[21:].all()


def test_what_no_view_saw_is_no_sky():
    clear = np.zeros((18, 32), dtype=np.float32)
    turned = camera(32, 18, yaw_rad=np.arctan(4 / 32))
    share = SkyMask([view(clear)]).share(turned)
    assert share[9, :3].max() == 0.0  # to the left of the view's border
    assert share[9, 5:].min() == 1.0
    assert SkyMask([view(clear)]).share(camera(32, 18, yaw_rad=np.pi)).max() == 0.0


def test_a_view_of_the_own_camera_comes_before_a_nearer_one_of_another():
    """A metre to the side of the path a neighbouring camera's eye is nearer than the own one's."""
    clear = np.zeros((18, 32), dtype=np.float32)
    hidden = np.ones((18, 32), dtype=np.float32)
    mask = SkyMask(
        [
            view(clear, "front", x_m=0.0),
            view(hidden, "front", x_m=9.0),
            view(hidden, "left", x_m=1.0, yaw_rad=0.6),
        ]
    )
    assert mask.share(camera(32, 18, x_m=1.0), "front").min() == 1.0
    assert mask.share(camera(32, 18, x_m=8.0), "front").max() == 0.0


def test_another_camera_of_the_rig_completes_what_the_own_one_did_not_see():
    clear = np.zeros((18, 32), dtype=np.float32)
    hidden = np.ones((18, 32), dtype=np.float32)
    hidden[:, 16:] = 0.0
    mask = SkyMask([view(hidden, "front"), view(clear, "left", yaw_rad=0.5)])
    share = mask.share(camera(32, 18, yaw_rad=np.arctan(4 / 32)), "front")
    assert share[9, :3].min() == 1.0  # what only the left camera saw
    assert share[9, 6:18].max() == 0.0  # what the front camera saw to be a wall
    assert share[9, 22:].min() == 1.0


def test_many_views_of_the_own_camera_leave_room_for_the_one_that_saw_the_rest():
    """Of a drive a camera has a view every second, and all of them lack what lies to the side."""
    clear = np.zeros((18, 32), dtype=np.float32)
    fronts = [view(clear, "front", x_m=float(x)) for x in range(20)]
    mask = SkyMask([*fronts, view(clear, "left", yaw_rad=0.5)])
    turned = camera(32, 18, x_m=5.0, yaw_rad=0.3)
    assert SkyMask(fronts).share(turned, "front")[9, :6].max() == 0.0
    assert mask.share(turned, "front").min() == 1.0


def test_a_camera_without_a_view_of_its_name_takes_the_nearest_that_shows_its_image():
    clear = np.zeros((18, 32), dtype=np.float32)
    hidden = np.ones((18, 32), dtype=np.float32)
    mask = SkyMask([view(clear, "front"), view(hidden, "left", x_m=0.9, yaw_rad=0.9)])
    assert mask.share(camera(32, 18, x_m=1.0), "camera_front_wide_120fov").min() == 1.0


def test_nearest_view_that_looks_the_same_way_is_taken():
    clear = np.zeros((18, 32), dtype=np.float32)
    hidden = np.ones((18, 32), dtype=np.float32)
    mask = SkyMask(
        [view(clear, x_m=0.0), view(hidden, x_m=10.0), view(clear, x_m=9.0, yaw_rad=np.pi)]
    )
    assert mask.share(camera(32, 18, x_m=1.0)).min() == 1.0
    assert mask.share(camera(32, 18, x_m=9.0)).max() == 0.0


def test_directions_between_corners_are_those_at_the_middles_of_pixels():
    height = 2 * STEP_PX + 3
    width = 3 * STEP_PX + 5
    grid = np.random.default_rng(0).uniform(-1e3, 1e3, (4, 5))
    rows, columns = np.indices((height, width), dtype=np.float32)
    plain = cv2.remap(
        grid.astype(np.float32), (columns + 0.5) / STEP_PX, (rows + 0.5) / STEP_PX, cv2.INTER_LINEAR
    )
    assert_allclose(_upsample(grid, height, width), plain, rtol=1e-6, atol=2e-4)


def test_only_actors_present_are_posed():
    early = replace(
        parked("early", 5, 0),
        track=replace(parked("early", 5, 0).track, t_us=np.array([0, 1_000_000])),
    )
    scenario = straight(actors=(parked("always", 9, 0), early))
    assert set(log_actors(scenario, 500_000)) == {"always", "early"}
    assert set(log_actors(scenario, 1_500_000)) == {"always"}
