from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Box
from alpasim_plugin.fixers.semantic_map.draw import draw_map, seen_from
from alpasim_plugin.fixers.semantic_map.prepare import ActorBox, prepare_map
from alpasim_plugin.fixers.semantic_map.style import COLOURS
from tests.examples import first_of
from tests.fixers.views import BIG, CAR, EMPTY, PIN, at, line, marked

SMALL = replace(PIN, width=128, height=72, K=np.diag([0.5, 0.5, 1]) @ PIN.K)


def lit(image, colour, slack=40):
    return (np.abs(image.astype(int) - colour).max(axis=2) <= slack) & (image.max(axis=2) > 0)


# --- what is drawn


def test_empty_map_is_black():
    image = draw_map(prepare_map(EMPTY), PIN, at())
    assert image.shape == (144, 256, 3)
    assert image.dtype == np.uint8
    assert not image.any()


def test_line_lies_where_the_formula_puts_it_and_fades_with_depth():
    edge = line((5, -1, 0), (150, -1, 0))
    image = draw_map(prepare_map(replace(EMPTY, road_edges=(edge,))), BIG, at())
    for depth in (6.0, 10.0, 20.0, 50.0, 100.0):
        u = 640 + 640 * 1.0 / depth
        v = 360 + 640 * 1.5 / depth
        fade, pixel_m = (
            1 - depth / 200,
            depth**2 / (640 * 1.5),
        )  # a pixel of height is this much of depth
        assert_allclose(
            image[int(v), int(u)],
            np.array(COLOURS["road_boundary"]) * fade,
            atol=2 + 0.75 * pixel_m / 200 * 253,
        )


def test_a_horizontal_line_is_thinner_by_the_aspect_ratio():
    depth = 20.0
    upright = draw_map(
        prepare_map(replace(EMPTY, poles=(line((depth, 0, -5), (depth, 0, 5)),))), BIG, at(z=0)
    )
    flat = draw_map(
        prepare_map(replace(EMPTY, poles=(line((depth, -5, 0), (depth, 5, 0)),))), BIG, at(z=0)
    )
    fade = 1 - depth / 200
    across_px = upright[360].max(axis=1).sum() / (183 * fade)
    along_px = flat[:, 640].max(axis=1).sum() / (183 * fade)
    assert across_px == pytest.approx(5.0 * fade, abs=0.6)
    assert along_px == pytest.approx(5.0 * 720 / 1280 * fade, abs=0.6)


def test_lines_end_at_the_depth_where_they_have_faded():
    scene = prepare_map(
        replace(
            EMPTY, road_edges=(line((180, -40, 0), (180, 40, 0)), line((201, -40, 5), (201, 40, 5)))
        )
    )
    image = draw_map(scene, PIN, at())
    assert image[72 + int(128 * 1.5 / 180)].any()
    assert not image[: 72 - 1].any()


def test_dashes_are_three_metres_on_and_nine_off():
    far = np.array([[20.0, 0, 128], [0, 20.0, 72], [0, 0, 1]])  # 2 px a metre at 10 m
    scene = prepare_map(marked((line((10, 30, 0), (10, -30, 0)), "dashed_white")))
    row = draw_map(scene, replace(PIN, K=far), at(z=0))[72, :, 0] > 0
    starts = np.flatnonzero(np.diff(row.astype(int)) == 1)
    assert np.diff(starts).tolist() == [24, 24, 24, 24]
    assert row.sum() == pytest.approx(5 * (3 * 2 + 2), abs=8)  # round caps lengthen each dash


def test_layers_have_their_colours():
    lane_map = replace(
        EMPTY,
        crosswalks=(line((8, -3, 0), (8, 3, 0), (12, 3, 0), (12, -3, 0), (8, -3, 0)),),
        stop_lines=(line((7, -3, 0), (7, 3, 0)),),
        poles=(line((10, 5, 0)),),
        signs=((se2(10, -5, np.pi, 2.5), Box(0.1, 0.8, 0.8)),),
    )
    image = draw_map(prepare_map(lane_map), BIG, at(z=2.5))
    for name in ("crosswalk", "stop_line", "pole", "sign"):
        assert lit(image, np.array(COLOURS[name]) * 0.94, 20).sum() > 3, name


@pytest.mark.slow
def test_road_users_go_from_the_front_colour_to_the_back_colour():
    side_on = draw_map(
        prepare_map(EMPTY),
        PIN,
        at(),
        (ActorBox(se2(10, 0, np.pi / 2, 0.8), CAR, "car"),),
    )
    row = side_on[78]  # heading left: front at the left
    inside = np.flatnonzero(row.any(axis=1))
    first = row[inside[3]]
    last = row[inside[-4]]
    assert_allclose(first, np.array([0, 46, 136]) * 0.955, atol=25)
    assert_allclose(last, np.array([126, 206, 255]) * 0.955, atol=25)
    assert (np.diff(row[inside[3:-3], 0].astype(int)) >= 0).all()


@pytest.mark.parametrize(
    ("label", "back"),
    [
        ("bus", (255, 192, 64)),
        ("motorcycle", (102, 208, 198)),
        ("pedestrian", (255, 124, 171)),
        ("llama", (166, 136, 125)),
    ],
)
def test_classes_have_their_colours(label, back):
    image = draw_map(prepare_map(EMPTY), PIN, at(), (ActorBox(se2(10, 0, 0, 0.8), CAR, label),))
    assert_allclose(
        image[78, 128], np.array(back) * (1 - 7.75 / 200), atol=3
    )  # its back, 7.75 m ahead


def test_nearer_road_user_hides_the_farther_and_the_line_behind():
    edge = line((30, -10, 1), (30, 10, 1))
    scene = prepare_map(replace(EMPTY, road_edges=(edge,)))
    far = ActorBox(se2(20, 0, 0, 0.8), CAR, "bus")
    near = ActorBox(se2(10, 0, 0, 0.8), CAR, "car")
    one = draw_map(scene, BIG, at(z=1), (far, near))
    two = draw_map(scene, BIG, at(z=1), (near, far))
    assert_array_equal(one, two)
    assert not lit(one[:, 600:680], COLOURS["road_boundary"]).any()
    assert lit(one, np.array(COLOURS["road_boundary"]) * 0.85).any()
    assert not lit(one[:, 620:660], np.array([255, 192, 64]) * 0.9).any()


def test_lines_on_a_crosswalk_stay_visible():
    ring = line((4, -3, 0), (4, 3, 0), (20, 3, 0), (20, -3, 0))
    scene = prepare_map(
        replace(EMPTY, crosswalks=(ring,), road_edges=(line((5, 0, 0), (19, 0, 0)),))
    )
    alone = prepare_map(replace(EMPTY, road_edges=(line((5, 0, 0), (19, 0, 0)),)))
    mine = lit(draw_map(alone, PIN, at()), np.array(COLOURS["road_boundary"]) * 0.93)
    assert mine.sum() > 30
    assert lit(draw_map(scene, PIN, at()), np.array(COLOURS["road_boundary"]) * 0.93)[mine].all()


# --- hard cases


def test_what_lies_behind_is_not_drawn():
    lane_map = replace(
        EMPTY,
        road_edges=(line((-50, -3, 0), (-1, -3, 0)),),
        crosswalks=(line((-9, -1, 0), (-9, 1, 0), (-5, 0, 0)),),
    )
    assert not draw_map(
        prepare_map(lane_map), PIN, at(), (ActorBox(se2(-6, 0, 0, 0.8), CAR, "car"),)
    ).any()


def test_line_that_crosses_the_near_plane_is_cut_there_exactly():
    """The part before the plane looks as if the rest had never been."""
    whole = prepare_map(replace(EMPTY, road_edges=(line((-30, 0.7, 0), (30, 0.7, 0)),)))
    part = prepare_map(replace(EMPTY, road_edges=(line((0.1, 0.7, 0), (30, 0.7, 0)),)))
    image = draw_map(whole, PIN, at())
    assert image.any()
    difference = np.abs(image.astype(int) - draw_map(part, PIN, at()))
    assert (difference > 2).mean() < 1e-4  # halving starts from other ends


@pytest.mark.parametrize("x", first_of([0.5, -1.0, 0.0, 2.0]))
def test_road_user_that_straddles_the_near_plane_is_drawn_where_it_is_ahead(x):
    box = ActorBox(se2(x, 1.6, 0.2, 0.8), CAR, "car")
    image = draw_map(prepare_map(EMPTY), SMALL, at(), (box,))
    assert image[:, :64].any()
    assert not image[:, 70:].any()


def test_camera_inside_a_box_sees_its_inside():
    image = draw_map(
        prepare_map(EMPTY), PIN, at(z=0.8), (ActorBox(se2(0, 0, 0, 0.8), CAR, "truck"),)
    )
    assert image.any(axis=2).all()


def test_box_larger_than_the_view_is_drawn_although_all_its_corners_are_outside():
    image = draw_map(
        prepare_map(EMPTY),
        PIN,
        at(z=10),
        (ActorBox(se2(30, 0, np.pi / 2, 10), Box(200, 2, 100), "truck"),),
    )
    assert image.any(axis=2).all()


def test_point_exactly_at_the_near_plane_and_lines_of_no_length():
    lane_map = replace(
        EMPTY,
        road_edges=(
            line((0.1, 0, 0), (0.1, 0, 0)),
            line((10, 0, 1), (10, 0, 1)),
            line((5, 5, 5)),
            np.zeros((0, 3)),
        ),
    )
    image = draw_map(prepare_map(lane_map), PIN, at())
    assert image[72 + int(128 * 0.5 / 10), 128].any()  # a dot is as large as its caps
    assert image.any(axis=2).sum() < 30


def test_utm_sized_coordinates_draw_the_same_picture():
    origin = np.array([512_345.0, 5_403_210.0, 230.0])
    edge = line((2, -1.5, 0), (90, -1.5, 0.3))
    ring = line((8, -1, 0), (8, 1, 0), (11, 1, 0), (11, -1, 0))
    box = se2(15, 2, 0.3, 0.8)
    near = draw_map(
        prepare_map(replace(EMPTY, road_edges=(edge,), crosswalks=(ring,))),
        PIN,
        at(),
        (ActorBox(box, CAR, "car"),),
    )
    moved = box.copy()
    moved[:3, 3] += origin
    pose = at()
    pose[:3, 3] += origin
    far = draw_map(
        prepare_map(replace(EMPTY, road_edges=(edge + origin,), crosswalks=(ring + origin,))),
        PIN,
        pose,
        (ActorBox(moved, CAR, "car"),),
    )
    assert np.abs(near.astype(int) - far).max(axis=2).max() <= 64  # a sample or two on an edge
    assert (np.abs(near.astype(int) - far).max(axis=2) > 1).mean() < 1e-3


# --- parts


def street():
    """A bend with all kinds of things close by and far away."""
    s = np.linspace(-20, 120, 15)
    bend = np.stack([s, 0.002 * s**2, 0.02 * s], axis=1)
    left = np.array([0.0, 4.0, 0.0])
    lane_map = replace(
        marked((bend, "double_yellow"), (bend + left / 2, "dashed_white")),
        road_edges=(bend + left, bend - left),
        crosswalks=(line((6, -3, 0.1), (6, 3, 0.1), (9, 3, 0.2), (8, 0, 0.1), (9, -3, 0.2)),),
        stop_lines=(line((5, -3, 0.1), (5, 0, 0.1)),),
        poles=(line((15, 6, 0)), line((30, -6, 0), (30, -6, 8))),
        signs=((se2(18, -5, 2.5, 3), Box(0.1, 1, 1)),),
    )
    places = (
        (12, 3, 0.2, 1, "car"),
        (12.5, 3.5, 1.2, 1.2, "bus"),
        (25, -2, 3, 1.5, "rider"),
        (1.5, -2, 0.1, 0.9, "car"),
    )
    boxes = tuple(ActorBox(se2(x, y, yaw, z), CAR, label) for x, y, yaw, z, label in places)
    return prepare_map(lane_map), boxes


@pytest.mark.parametrize(
    "rows", [slice(0, 1), slice(70, 71), slice(31, 97), slice(100, 144), slice(0, 144)]
)
def test_a_part_of_the_rows_is_that_part_of_the_picture(rows):
    scene, boxes = street()
    whole = draw_map(scene, PIN, at(), boxes)
    assert_array_equal(draw_map(scene, PIN, at(), boxes, rows=rows), whole[rows])


def test_a_gpu_draws_the_same_pixels():
    pytest.importorskip("triton", reason="Triton is not installed")
    from alpasim_plugin.fixers.semantic_map.on_device import draw_tiles

    (scene, boxes), camera = street(), replace(PIN, width=48, height=27)
    camera = replace(camera, K=np.diag([0.1875, 0.1875, 1]) @ PIN.K)
    views = (at(x=1.0), boxes, slice(3, 25)), (at(x=2.0), boxes[:1], slice(0, 22))
    seen = [(*seen_from(scene, camera, *view), rows) for *view, rows in views]
    for image, (*view, rows) in zip(draw_tiles(scene, "cpu", seen), views, strict=True):
        assert_array_equal(image, draw_map(scene, camera, *view, rows=rows))


def test_concave_area_stays_concave():
    ring = line((6, -3, 0), (6, 3, 0), (12, 3, 0), (7, 0, 0), (12, -3, 0))
    image = draw_map(prepare_map(replace(EMPTY, crosswalks=(ring,))), PIN, at(z=3.0))

    def pixel(x, y):
        return image[int(72 + 128 * 3.0 / x), int(128 - 128 * y / x)]

    assert pixel(6.4, 0.0).any()
    assert pixel(9.0, 2.4).any()
    assert not pixel(10.0, 0.0).any()
