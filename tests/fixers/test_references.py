"""Recorded frames as references: which are chosen, and that a warp puts every surface where it
is.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from alpasim_plugin.cameras.shutter import bands, rolling
from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import (
    Actor,
    Box,
    CameraSpec,
    Exposure,
    Frame,
    RecordedFrame,
    RenderRequest,
    Trajectory,
)
from alpasim_plugin.fixers.references import ReferenceIndex, ReferenceSession
from alpasim_plugin.fixers.warp import (
    INCONSISTENT,
    VALID,
    RecordedImage,
    WarpTarget,
    warp,
)
from tests.camera_builders import ahead

WIDTH = 64
HEIGHT = 32
K = np.array([[40.0, 0, 32], [0, 40.0, 16], [0, 0, 1]])
FORWARD = ahead()
NOBODY = {}


def at(x, y=0.0, yaw=0.0):
    return se2(x, y, yaw) @ FORWARD


def wall(x_m, T_world_camera):
    """Depth of a wall across the street at ``x_m``, seen along x."""
    return np.full((HEIGHT, WIDTH), x_m - T_world_camera[0, 3], dtype=np.float32)


def picture(T_world_camera, depth, rgb=None, actors=NOBODY):
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return RecordedImage(K, T_world_camera, noise if rgb is None else rgb, depth, actors)


def columns():
    """A picture whose red says the column, four grey levels each."""
    return np.repeat(
        np.broadcast_to(4 * np.arange(WIDTH, dtype=np.uint8), (HEIGHT, WIDTH))[..., None], 3, axis=2
    )


def test_a_frame_warped_into_its_own_view_is_itself():
    depth = np.random.default_rng(1).uniform(2, 60, (HEIGHT, WIDTH)).astype(np.float32)
    depth[:8] = 0  # sky
    one = picture(at(3.0, 1.0, 0.3), depth)
    out = warp(one, WarpTarget(K, one.T_world_camera, depth, {}, {}))
    assert (out[..., 3] == VALID).all()
    assert np.abs(out[..., :3].astype(int) - one.rgb).max() <= 1


def test_what_stood_behind_something_is_doubted_and_what_lay_outside_is_not_there():
    here = at(0.0)
    seen = wall(20.0, here)
    depth = wall(20.0, here)
    seen[:, 20:40] = 5.0  # a post hid the wall when the frame was recorded
    out = warp(picture(here, seen), WarpTarget(K, here, depth, {}, {}))
    assert (out[:, 20:40, 3] == INCONSISTENT).all()
    assert (out[:, :20, 3] == VALID).all()
    aside = warp(
        picture(here, depth), WarpTarget(K, at(0.0, 12.0), depth, {}, {})
    )  # 12 m to the left: 24 px at 20 m
    assert (aside[:, :24, 3] == 0).all()
    assert (aside[:, 24:, 3] == VALID).all()


def test_nothing_but_the_rotation_moves_the_sky():
    sky = np.zeros((HEIGHT, WIDTH), dtype=np.float32)
    one = picture(at(0.0), sky, columns())
    assert (
        np.abs(
            warp(one, WarpTarget(K, at(40.0, 9.0), sky, {}, {}))[..., 0].astype(int)
            - one.rgb[..., 0]
        ).max()
        <= 1
    )
    turned = warp(one, WarpTarget(K, at(0.0, 0.0, 0.1), sky, {}, {}))
    middle = 32 - 40 * np.tan(0.1)  # a turn to the left looks at what lay left of the middle
    assert turned[HEIGHT // 2, 32, 0] == pytest.approx(4 * middle, abs=3)


def test_the_pinholes_of_a_lens_show_together_what_one_of_them_does_not():
    here = at(0.0)
    depth = np.zeros((HEIGHT, WIDTH), dtype=np.float32)
    left, right = (picture(at(0.0, 0.0, yaw), depth) for yaw in (0.6, -0.6))
    view = WarpTarget(K, here, depth, {}, {})
    alone = warp(left, view)
    other = warp(right, view)
    whole = warp(replace(left, others=(right,)), view)
    shown = alone[..., 3:] > 0
    assert 0.2 < shown.mean() < 0.8
    assert_array_equal(whole, np.where(shown, alone, other))
    one, another = recorded([(0, 0.6), (0, -0.6)], step_us=0)
    lens = [replace(one, camera="wide.left"), one, replace(another, camera="wide.right")]
    assert [ReferenceIndex(lens).lens(i) for i in range(3)] == [[0, 2], [1], [2, 0]]


def test_a_car_is_looked_up_where_it_was():
    box = Box(4.0, 2.0, 1.5)
    now = se2(20.0, 0.0, 0.0, 0.75)
    then = se2(14.0, 3.0, 0.0, 0.75)
    here = at(0.0)
    depth = np.zeros((HEIGHT, WIDTH), dtype=np.float32)
    rows = slice(16, 19)
    car = slice(30, 34)
    depth[rows, car] = 18.0  # its rear
    before = np.zeros((HEIGHT, WIDTH), dtype=np.float32)
    before[:, :] = 12.0
    out = warp(
        picture(here, before, columns(), {"car": then}),
        WarpTarget(K, here, depth, {"car": now}, {"car": box}),
    )
    middle = 32 - 40 * 3.0 / 12.0  # 3 m to the left at 12 m
    assert out[17, 31:33, 0].mean() == pytest.approx(4 * (middle - 0.5), abs=4)
    assert (out[rows, car, 3] == VALID).all()
    gone = warp(
        picture(here, before, columns()), WarpTarget(K, here, depth, {"car": now}, {"car": box})
    )
    assert (gone[rows, car, 3] == 0).all()


def recorded(
    places,
    step_us=500_000,
    read=None,
):
    def none():
        return np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8), np.zeros(
            (HEIGHT, WIDTH), dtype=np.float32
        )

    return [
        RecordedFrame(i * step_us, "front", K, at(x, 0.0, yaw), {}, read or none)
        for i, (x, yaw) in enumerate(places)
    ]


def test_the_nearest_frames_come_first_and_far_old_or_turned_ones_not_at_all():
    index = ReferenceIndex(recorded([(0, 0), (5, 0), (10, 0), (11, 2.0), (200, 0)]))
    assert index.choose(at(6.0), 600_000, 2) == (1, 2)
    assert index.choose(at(6.0), 600_000, 9) == (1, 2, 0)
    assert index.choose(at(6.0), 20_000_000, 9) == ()
    assert index.choose(at(6.0), 600_000, 0) == ()
    assert ReferenceIndex([]).choose(at(0.0), 0, 2) == ()


def test_a_reference_stays_until_another_is_clearly_nearer():
    index = ReferenceIndex(recorded([(0, 0), (5, 0)], step_us=1))
    assert index.choose(at(2.6), 0, 1) == (1,)
    assert index.choose(at(2.6), 0, 1, last=(0,)) == (0,)
    assert index.choose(at(3.5), 0, 1, last=(0,)) == (1,)


def test_a_frame_of_fewer_pixels_counts_as_farther():
    sharp, near = recorded([(0, 0), (5, 0)], step_us=1)
    index = ReferenceIndex([sharp, replace(near, K=np.diag([0.25, 0.25, 1]) @ K)])
    assert index.choose(at(4.0), 0, 1, focal_px=K[0, 0]) == (0,)


def test_only_earlier_frames_are_references_where_the_past_is_asked_for():
    index = ReferenceIndex(recorded([(0, 0), (5, 0), (10, 0)]))
    assert index.choose(at(6.0), 500_000, 3, past=True) == (0,)
    assert index.choose(at(6.0), 0, 3, past=True) == ()


def session(which="all", hysteresis=True, road_m=0.0):
    reads = []

    def read():
        reads.append(1)
        return np.random.default_rng(0).integers(
            0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8
        ), np.full((HEIGHT, WIDTH), 20.0, dtype=np.float32)

    car = Actor(
        "car",
        "car",
        Box(4, 2, 1.5),
        Trajectory(np.array([0]), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]])),
    )
    frames = recorded([(float(x), 0.0) for x in range(0, 60, 2)], step_us=100_000, read=read)
    ego_log = Trajectory(
        np.array([0, 6_000_000]),
        np.array([[0.0, 0, road_m], [60, 0, road_m]]),
        np.array([[1.0, 0, 0, 0]] * 2),
    )
    return ReferenceSession(frames, [car], ego_log, 2, which, hysteresis), reads  # type: ignore[arg-type]


def request(x, t_us):
    spec = CameraSpec("front", WIDTH, HEIGHT, K, FORWARD)
    frame = Frame(
        t_us,
        "front",
        np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8),
        None,
        np.full((HEIGHT, WIDTH), 20.0, dtype=np.float32),
    )
    return RenderRequest(t_us, spec, np.stack([at(x), at(x)]), {}), frame


def references_of(found, asked, frame):
    return found.added([asked], [frame])[0].references


def test_the_ground_is_that_of_the_log_however_the_camera_is_said_to_be_mounted():
    asked, frame = request(10.0, 500_000)
    frame = replace(frame, depth=np.zeros((HEIGHT, WIDTH), dtype=np.float32))  # nothing but holes
    wrong = replace(
        asked, camera=replace(asked.camera, T_rig_camera=se2(0.0, 0.0, 0.0, 1.0) @ FORWARD)
    )
    images = references_of(session()[0], asked, frame)
    for image, same, of_lower_road in zip(
        images,
        references_of(session()[0], wrong, frame),
        references_of(session(road_m=-1.0)[0], asked, frame),
        strict=True,
    ):
        assert_array_equal(image, same)
        assert (image != of_lower_road).any()


def test_without_memory_the_same_view_has_the_same_references_whatever_came_before():
    found, _ = session(hysteresis=False)
    alone = references_of(found, *request(10.9, 500_000))
    references_of(found, *request(40.0, 2_000_000))
    again = references_of(found, *request(10.9, 500_000))
    assert all(np.array_equal(a, b) for a, b in zip(alone, again, strict=True))


def test_references_of_a_rolling_shutter_are_those_of_the_pose_at_each_row():
    found, _ = session(hysteresis=False)
    asked, frame = request(10.0, 500_000)
    start = at(9.5, 0.0, 0.02)
    share = rolling(WIDTH, HEIGHT, "rows", backwards=False)
    rolled = replace(
        asked,
        T_world_camera=np.stack([start, asked.T_world_camera[1]]),
        exposure=Exposure(share, {}),
    )
    images = references_of(found, rolled, frame)
    assert len(images) == 2
    assert (images[0] != references_of(found, asked, frame)[0]).any()
    parts = bands(rolled)
    assert len(parts) > 2
    for band in parts:
        T = np.stack([band.T_world_camera] * 2)
        for image, alone in zip(
            images, references_of(found, replace(asked, T_world_camera=T), frame), strict=True
        ):
            assert_array_equal(image[band.rows], alone[band.rows])


def test_a_frame_of_half_the_focal_length_counts_as_four_times_as_far_and_only_the_past_is_past():
    wide = np.diag([0.5, 0.5, 1.0]) @ K
    frames = [
        RecordedFrame(t_us, camera, matrix, at(x), {}, None)
        for t_us, camera, matrix, x in (
            (1_000_000, "wide", wide, 1.0),
            (1_000_000, "front", K, 3.0),
            (900_000, "front", K, 3.5),
        )
    ]
    index = ReferenceIndex(frames)
    choose = partial(index.choose, at(0.0), 1_000_000, 3)
    assert choose(focal_px=40.0)[0] == 1
    assert choose(focal_px=20.0)[0] == 0
    assert choose(focal_px=40.0, past=True) == (2,)
