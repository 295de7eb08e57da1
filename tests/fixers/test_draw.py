from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Box
from alpasim_plugin.fixers.semantic_map import draw as conditioning
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import (
    ActorBox,
    Area,
    LaneLine,
    MapExtras,
    TrafficLight,
    prepare_map,
)
from alpasim_plugin.fixers.semantic_map.style import COLOURS, LUDUS, OPENGL
from tests.examples import examples, first_of
from tests.fixers.draw_reference import draw_map_reference, draw_reference
from tests.fixers.views import CAR, EMPTY, FISH, PIN, at, fixed_lines, line

CAMERAS = [PIN, FISH]
SMALL = [
    replace(PIN, width=128, height=72, K=np.diag([0.5, 0.5, 1]) @ PIN.K),
    FISH.resized(128, 72),
]
COARSE_RAD = 0.12  # bends by a tenth of a pixel at these sizes
PLAIN = replace(OPENGL, samples=1, ndc_widths=False)


def lit(image, colour, slack=40):
    return (np.abs(image.astype(int) - colour).max(axis=2) <= slack) & (image.max(axis=2) > 0)


# --- what is drawn


def test_empty_map_is_black():
    for camera in CAMERAS:
        image = draw_map(prepare_map(EMPTY), camera, at())
        assert image.shape == (144, 256, 3)
        assert image.dtype == np.uint8
        assert not image.any()


def test_line_lies_where_the_formula_puts_it_and_fades_with_depth():
    edge = line((5, -1, 0), (150, -1, 0))
    image = draw_map(prepare_map(replace(EMPTY, road_edges=(edge,)), style=PLAIN), PIN, at())
    for depth in (6.0, 10.0, 20.0, 50.0, 100.0):
        u, v = 128 + 128 * 1.0 / depth, 72 + 128 * 1.5 / depth
        fade, pixel_m = (
            1 - depth / 200,
            depth**2 / (128 * 1.5),
        )  # a pixel of height is this much of depth
        np.testing.assert_allclose(
            image[int(v), int(u)],
            np.array(COLOURS["road_boundary"]) * fade,
            atol=2 + 0.75 * pixel_m / 200 * 253,
        )


@pytest.mark.parametrize(
    ("ndc", "across_px", "along_px"), [(False, 12.0, 12.0), (True, 12.0, 12.0 * 720 / 1280)]
)
def test_widths_are_measured_as_the_style_says(ndc, across_px, along_px):
    """A vertical line is w pixels wide; in normalised coordinates a horizontal one is w H / W."""
    big = replace(
        PIN, width=1280, height=720, K=np.array([[640.0, 0, 640], [0, 640, 360], [0, 0, 1]])
    )
    style = replace(OPENGL, ndc_widths=ndc, pole_px=12.0)
    depth = 20.0
    upright = draw_map(
        prepare_map(replace(EMPTY, poles=(line((depth, 0, -5), (depth, 0, 5)),)), style=style),
        big,
        at(z=0),
    )
    flat = draw_map(
        prepare_map(replace(EMPTY, poles=(line((depth, -5, 0), (depth, 5, 0)),)), style=style),
        big,
        at(z=0),
    )
    fade = 1 - depth / 200
    full = (
        upright[360].max(axis=1).astype(float) / (183 * fade),
        flat[:, 640].max(axis=1).astype(float) / (183 * fade),
    )
    assert full[0].sum() == pytest.approx(across_px * fade, abs=0.6)
    assert full[1].sum() == pytest.approx(along_px * fade, abs=0.6)


def test_ludus_keeps_the_width_up_to_half_the_depth_range():
    thick = {}
    for depth in (20.0, 90.0, 150.0):
        scene = prepare_map(
            replace(EMPTY, road_edges=(line((depth, 0, -50), (depth, 0, 50)),)), style=LUDUS
        )
        row = draw_map(
            scene,
            replace(PIN, width=1280, K=np.array([[640.0, 0, 640], [0, 640, 72], [0, 0, 1]])),
            at(z=0),
        )[72]
        thick[depth] = row[:, 0].sum() / row[:, 0].max()
    assert thick[20.0] == pytest.approx(7.0, abs=0.6)
    assert thick[90.0] == pytest.approx(7.0, abs=0.6)
    assert thick[150.0] == pytest.approx(3.5, abs=0.6)


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
    seen = replace(
        PIN, K=np.array([[20.0, 0, 128], [0, 20.0, 72], [0, 0, 1]])
    )  # 2 px a metre at 10 m
    dashed = LaneLine(line((10, 30, 0), (10, -30, 0)), "white", ("long_dashed",))
    image = draw_map(
        prepare_map(EMPTY, fixed_lines(dashed), replace(PLAIN, line_px=10.0)), seen, at(z=0)
    )
    row = image[72, :, 0] > 0
    starts = np.flatnonzero(np.diff(row.astype(int)) == 1)
    assert np.diff(starts).tolist() == [24, 24, 24, 24]
    assert row.sum() == pytest.approx(
        5 * (3 * 2 + 2), abs=5
    )  # round caps lengthen each dash by half a width


def test_double_line_with_one_dashed_side_keeps_left_left():
    seen = replace(PIN, K=np.array([[200.0, 0, 128], [0, 200.0, 72], [0, 0, 1]]))
    double = LaneLine(line((4, 0, 0), (16, 0, 0)), "yellow", ("solid", "long_dashed"))
    style = replace(PLAIN, double_offset_m=0.3, line_px=10.0)
    image = draw_map(prepare_map(EMPTY, fixed_lines(double), style), seen, at(z=1.0))
    depth = 14.0  # in the gap of the dashed side
    v = int(72 + 200 / depth)
    left, right = int(128 - 200 * 0.3 / depth), int(128 + 200 * 0.3 / depth)
    assert image[v, left].any()
    assert not image[v, right + 1].any()


def test_layers_have_their_colours():
    lane_map = replace(
        EMPTY,
        crosswalks=(line((8, -3, 0), (8, 3, 0), (12, 3, 0), (12, -3, 0), (8, -3, 0)),),
        stop_lines=(line((7, -3, 0), (7, 3, 0)),),
        poles=(line((10, 5, 0)),),
        signs=((se2(10, -5, np.pi, 2.5), Box(0.1, 0.8, 0.8)),),
    )
    extras = MapExtras(
        areas=(
            Area(line((14, -3, 0), (14, 0, 0), (18, 0, 0), (18, -3, 0))),
            Area(line((14, 1, 0), (14, 3, 0), (18, 3, 0)), "road_island"),
        ),
        lights=(
            TrafficLight(se2(12, 2, 0, 4.0), Box(0.3, 0.5, 1.0), "red"),
            TrafficLight(se2(12, -2, 0, 4.0), Box(0.3, 0.5, 1.0)),
        ),
    )
    image = draw_map(prepare_map(lane_map, extras, replace(PLAIN, pole_px=15.0)), PIN, at(z=2.5))
    for name in (
        "crosswalk",
        "stop_line",
        "pole",
        "sign",
        "road_marking",
        "road_island",
        "light_red",
        "light_unknown",
    ):
        assert lit(image, np.array(COLOURS[name]) * 0.94, 20).sum() > 3, name


def test_concave_area_stays_concave():
    ring = line((6, -3, 0), (6, 3, 0), (12, 3, 0), (7, 0, 0), (12, -3, 0))
    image = draw_map(prepare_map(replace(EMPTY, crosswalks=(ring,)), style=PLAIN), PIN, at(z=3.0))

    def pixel(x, y):
        return image[int(72 + 128 * 3.0 / x), int(128 - 128 * y / x)]

    assert pixel(6.4, 0.0).any()
    assert pixel(9.0, 2.4).any()
    assert not pixel(10.0, 0.0).any()


@pytest.mark.slow
def test_road_users_go_from_the_front_colour_to_the_back_colour():
    side_on = draw_map(
        prepare_map(EMPTY, style=PLAIN),
        PIN,
        at(),
        (ActorBox(se2(10, 0, np.pi / 2, 0.8), CAR, "car"),),
    )
    row = side_on[78]  # heading left: front at the left
    inside = np.flatnonzero(row.any(axis=1))
    first, last = row[inside[3]], row[inside[-4]]
    np.testing.assert_allclose(first, np.array([0, 46, 136]) * 0.955, atol=25)
    np.testing.assert_allclose(last, np.array([126, 206, 255]) * 0.955, atol=25)
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
    image = draw_map(
        prepare_map(EMPTY, style=PLAIN), PIN, at(), (ActorBox(se2(10, 0, 0, 0.8), CAR, label),)
    )
    np.testing.assert_allclose(
        image[78, 128], np.array(back) * (1 - 7.75 / 200), atol=3
    )  # its back, 7.75 m ahead


def test_nearer_road_user_hides_the_farther_and_the_line_behind():
    edge = line((30, -10, 1), (30, 10, 1))
    scene = prepare_map(replace(EMPTY, road_edges=(edge,)), style=PLAIN)
    far, near = ActorBox(se2(20, 0, 0, 0.8), CAR, "bus"), ActorBox(se2(10, 0, 0, 0.8), CAR, "car")
    one, two = (
        draw_map(scene, PIN, at(z=1), (far, near)),
        draw_map(scene, PIN, at(z=1), (near, far)),
    )
    np.testing.assert_array_equal(one, two)
    assert not lit(one[:, 120:136], COLOURS["road_boundary"]).any()
    assert lit(one, np.array(COLOURS["road_boundary"]) * 0.85).any()
    assert not lit(one[:, 124:132], np.array([255, 192, 64]) * 0.9).any()


def test_lines_on_a_crosswalk_stay_visible():
    ring = line((4, -3, 0), (4, 3, 0), (20, 3, 0), (20, -3, 0))
    scene = prepare_map(
        replace(EMPTY, crosswalks=(ring,), road_edges=(line((5, 0, 0), (19, 0, 0)),)), style=PLAIN
    )
    alone = prepare_map(replace(EMPTY, road_edges=(line((5, 0, 0), (19, 0, 0)),)), style=PLAIN)
    mine = draw_map(alone, PIN, at()).any(axis=2)
    assert lit(draw_map(scene, PIN, at()), np.array(COLOURS["road_boundary"]) * 0.93)[mine].all()


# --- hard cases


@pytest.mark.parametrize("camera", CAMERAS, ids=["pinhole", "ftheta"])
def test_what_lies_behind_is_not_drawn(camera):
    lane_map = replace(
        EMPTY,
        road_edges=(line((-50, -3, 0), (-1, -3, 0)),),
        crosswalks=(line((-9, -1, 0), (-9, 1, 0), (-5, 0, 0)),),
    )
    assert not draw_map(
        prepare_map(lane_map), camera, at(), (ActorBox(se2(-6, 0, 0, 0.8), CAR, "car"),)
    ).any()


@pytest.mark.parametrize("camera", CAMERAS, ids=["pinhole", "ftheta"])
def test_line_that_crosses_the_near_plane_is_cut_there_exactly(camera):
    """The part before the plane looks as if the rest had never been."""
    whole = prepare_map(
        replace(EMPTY, road_edges=(line((-30, 0.7, 0), (30, 0.7, 0)),)), style=PLAIN
    )
    part = prepare_map(replace(EMPTY, road_edges=(line((0.1, 0.7, 0), (30, 0.7, 0)),)), style=PLAIN)
    image = draw_map(whole, camera, at())
    assert image.any()
    difference = np.abs(image.astype(int) - draw_map(part, camera, at()))
    assert (difference > 2).mean() < 1e-4  # halving starts from other ends


@pytest.mark.parametrize("camera", SMALL, ids=["pinhole", "ftheta"])
@pytest.mark.parametrize("x", first_of([0.5, -1.0, 0.0, 2.0]))
def test_road_user_that_straddles_the_near_plane_is_drawn_where_it_is_ahead(camera, x):
    box = ActorBox(se2(x, 1.6, 0.2, 0.8), CAR, "car")
    image = draw_map(prepare_map(EMPTY), camera, at(), (box,))
    assert image[:, :64].any()
    assert not image[:, 70:].any()
    twin = draw_map_reference(prepare_map(EMPTY), camera, at(), (box,), angle_rad=COARSE_RAD)
    assert (np.abs(image.astype(int) - twin).max(axis=2) > 24).mean() < 0.01


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
    image = draw_map(prepare_map(lane_map, style=PLAIN), PIN, at())
    assert image[72 + int(128 * 0.5 / 10), 128].any()  # a dot is as large as its caps
    assert image.any(axis=2).sum() < 30


def test_ftheta_beyond_the_largest_angle_goes_on_in_a_straight_line():
    """At 80 degrees the lens (69 degrees) still gives finite pixels, outside the picture, in the
    right direction.
    """
    sideways = line((1.0, -5.67, 0), (1.0, -5.67, 3))
    assert not draw_map(prepare_map(replace(EMPTY, poles=(sideways,))), FISH, at()).any()
    long = line((0.2, -5, 1.5), (60, -5, 1.5))
    image = draw_map(prepare_map(replace(EMPTY, road_edges=(long,)), style=PLAIN), FISH, at())
    assert image[72, 150:].any(axis=1).all()
    assert not image[:, :120].any()


@pytest.mark.parametrize("camera", CAMERAS, ids=["pinhole", "ftheta"])
def test_utm_sized_coordinates_draw_the_same_picture(camera):
    origin = np.array([512_345.0, 5_403_210.0, 230.0])
    edge, ring = (
        line((2, -1.5, 0), (90, -1.5, 0.3)),
        line((8, -1, 0), (8, 1, 0), (11, 1, 0), (11, -1, 0)),
    )
    box = se2(15, 2, 0.3, 0.8)
    near = draw_map(
        prepare_map(replace(EMPTY, road_edges=(edge,), crosswalks=(ring,))),
        camera,
        at(),
        (ActorBox(box, CAR, "car"),),
    )
    moved = box.copy()
    moved[:3, 3] += origin
    pose = at()
    pose[:3, 3] += origin
    far = draw_map(
        prepare_map(replace(EMPTY, road_edges=(edge + origin,), crosswalks=(ring + origin,))),
        camera,
        pose,
        (ActorBox(moved, CAR, "car"),),
    )
    assert np.abs(near.astype(int) - far).max(axis=2).max() <= 64  # a sample or two on an edge
    assert (np.abs(near.astype(int) - far).max(axis=2) > 1).mean() < 1e-3


def test_many_lines_do_not_overflow_the_buffers():
    lines = tuple(line((5 + 0.01 * k, -3, 0), (5 + 0.01 * k, 3, 0)) for k in range(9000))
    image = draw_map(prepare_map(replace(EMPTY, road_edges=lines), style=PLAIN), PIN, at())
    assert len(conditioning._buffers.strokes) > 9000
    assert image[100, 128].any()


# --- the twin


def street():
    """A bend with all kinds of things close by and far away."""
    s = np.linspace(-20, 120, 15)
    bend = np.stack([s, 0.002 * s**2, 0.02 * s], axis=1)
    left = np.array([0.0, 4.0, 0.0])
    lane_map = replace(
        EMPTY,
        road_edges=(bend + left, bend - left),
        crosswalks=(line((6, -3, 0.1), (6, 3, 0.1), (9, 3, 0.2), (8, 0, 0.1), (9, -3, 0.2)),),
        stop_lines=(line((5, -3, 0.1), (5, 0, 0.1)),),
        poles=(line((15, 6, 0)), line((30, -6, 0), (30, -6, 8))),
        signs=((se2(18, -5, 2.5, 3), Box(0.1, 1, 1)),),
    )
    extras = fixed_lines(
        LaneLine(bend, "yellow", ("solid", "long_dashed")),
        LaneLine(bend + left / 2, "white", ("short_dashed",)),
    )
    places = (
        (12, 3, 0.2, 1, "car"),
        (12.5, 3.5, 1.2, 1.2, "bus"),
        (25, -2, 3, 1.5, "rider"),
        (1.5, -2, 0.1, 0.9, "car"),
    )
    boxes = tuple(ActorBox(se2(x, y, yaw, z), CAR, label) for x, y, yaw, z, label in places)
    return prepare_map(lane_map, extras), boxes


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("camera", CAMERAS, ids=["pinhole", "ftheta"])
def test_raster_equals_the_plain_one_bit_by_bit(camera, samples):
    scene, boxes = street()
    scene = replace(scene, style=replace(scene.style, samples=samples))
    fast = draw_map(scene, camera, at(), boxes)
    lens, view, pose = conditioning.view_of(scene, camera, at())
    faces, edges = conditioning.actor_geometry(boxes, scene, pose)
    first, n, strokes = conditioning._strokes(scene.segments, edges, pose, lens, view)
    n_shapes, shapes = conditioning._shapes(scene.triangles, faces, pose, lens, view)
    plain = draw_reference(strokes[:n], first, shapes[:n_shapes], camera, scene.style)
    different = np.abs(plain.astype(int) - fast).max(axis=2) > 0
    assert different.sum() <= 2  # a sample within rounding of an edge
    assert (fast.max(axis=2) > 0).mean() > 0.1


@pytest.mark.parametrize("camera", first_of(CAMERAS), ids=["pinhole", "ftheta"])
def test_few_pieces_draw_what_dense_points_draw(camera):
    scene, boxes = street()
    fast, twin = (
        draw_map(scene, camera, at(), boxes),
        draw_map_reference(scene, camera, at(), boxes, angle_rad=COARSE_RAD),
    )
    difference = np.abs(twin.astype(int) - fast).max(axis=2)
    assert (difference > 16).mean() < 0.005
    assert (difference > 100).mean() < 0.001


@settings(max_examples=examples(25), deadline=None)
@given(
    a=st.tuples(*[st.floats(-30, 60)] * 2, st.floats(-3, 6)),
    b=st.tuples(*[st.floats(-30, 60)] * 2, st.floats(-3, 6)),
    fish=st.booleans(),
    yaw=st.floats(-3, 3),
)
@example(a=(0.0, -26.0, 2.0), b=(43.0, 31.0, -0.25), fish=True, yaw=0.75)
def test_any_line_is_drawn_like_its_dense_points(a, b, fish, yaw):
    camera = SMALL[fish]
    scene = prepare_map(replace(EMPTY, road_edges=(line(a, b),)), style=PLAIN)
    fast, twin = (
        draw_map(scene, camera, at(yaw=yaw)),
        draw_map_reference(scene, camera, at(yaw=yaw)),
    )
    only_one = (fast.max(axis=2) > 8) != (twin.max(axis=2) > 8)
    both = (fast.max(axis=2) > 8).sum() + 20
    assert only_one.sum() <= 0.15 * both  # rim pixels: a quarter of a pixel of bend
    same = ~only_one
    assert (np.abs(fast.astype(int) - twin).max(axis=2)[same] > 16).mean() < 0.002


@settings(max_examples=examples(15), deadline=None)
@given(x=st.floats(-4, 30), y=st.floats(-8, 8), yaw=st.floats(-3.1, 3.1), fish=st.booleans())
@pytest.mark.slow
def test_any_box_is_drawn_like_its_small_pieces(x, y, yaw, fish):
    camera = SMALL[fish]
    scene, boxes = prepare_map(EMPTY, style=PLAIN), (ActorBox(se2(x, y, yaw, 0.8), CAR, "car"),)
    fast, twin = (
        draw_map(scene, camera, at(), boxes),
        draw_map_reference(scene, camera, at(), boxes, angle_rad=COARSE_RAD),
    )
    assert (np.abs(fast.astype(int) - twin).max(axis=2) > 40).mean() < 0.01


def test_threads_do_not_change_the_picture():
    scene, boxes = street()
    np.testing.assert_array_equal(
        draw_map(scene, FISH, at(), boxes, threads=1), draw_map(scene, FISH, at(), boxes, threads=3)
    )


@pytest.mark.parametrize("camera", CAMERAS, ids=["pinhole", "ftheta"])
@pytest.mark.parametrize(
    "rows", [slice(0, 1), slice(70, 71), slice(31, 97), slice(100, 144), slice(0, 144)]
)
def test_a_part_of_the_rows_is_that_part_of_the_picture(camera, rows):
    scene, boxes = street()
    whole = draw_map(scene, camera, at(), boxes)
    np.testing.assert_array_equal(draw_map(scene, camera, at(), boxes, rows=rows), whole[rows])
