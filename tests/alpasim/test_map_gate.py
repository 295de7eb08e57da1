"""The truth gate: a map whose lines are painted beside where it has them is off; a picture without
paint is no evidence.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from alpasim_plugin.alpasim.server.assembly import Settings, assemble
from alpasim_plugin.alpasim.server.map_gate import (
    DOUBT,
    FITS,
    Pieces,
    agreement,
    beside,
    contradiction,
    line_pixels,
    top_hat,
)
from alpasim_plugin.alpasim.server.sources import MAP_OFF
from alpasim_plugin.alpasim.server.status import CallTime
from alpasim_plugin.core.geometry import interpolate, se2
from alpasim_plugin.core.types import Box, CameraSpec, LaneMap, Marking
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import ActorBox, prepare_map
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.schema import wire_pose
from alpasim_plugin.log.wire import sensorsim_pb2
from scenarios.load import load_scenario
from tests.alpasim.service_cases import pinhole
from tests.camera_builders import ahead

AHEAD = ahead()
SPEC = CameraSpec("front", 480, 270, np.array([[240.0, 0, 240], [0, 240.0, 135], [0, 0, 1]]), AHEAD)


def road(aside_m=0.0, dashed=False):
    """A straight road along x with three lines; the middle of its right lane is y = 0."""
    mark_types = ("solid_white", "dashed_white" if dashed else "solid_yellow", "solid_white")
    lines = [
        np.array([[-10.0, y + aside_m, 0.0], [150.0, y + aside_m, 0.0]])
        for y in (5.25, 1.75, -1.75)
    ]
    return LaneMap(
        {},
        markings=tuple(Marking(line, paint) for line, paint in zip(lines, mark_types, strict=True)),
    )  # type: ignore[arg-type]


def prepared(aside_m=0.0, **options):
    return prepare_map(road(aside_m, **options))


def photograph(contrast=90, noise=6.0, aside_m=0.0, **options):
    """A grey road with the paint of `road`, as thin as paint is, and a textured roadside."""
    scene = prepared(aside_m, **options)
    scene.segments.style[:, 0] = 5.0  # the width in pixels
    thin = draw_map(scene, SPEC, AHEAD)
    out = (
        80
        + np.random.default_rng(0).normal(0, noise, (270, 480, 1))
        + (thin.max(axis=2, keepdims=True) > 60) * contrast
    )
    out[:130] = 60 + 100 * np.random.default_rng(1).random((130, 480, 1))
    return np.repeat(np.clip(out, 0, 255), 3, axis=2).astype(np.uint8)


def judged(rgb, scene_map, T=AHEAD):
    return contradiction(scene_map, SPEC, T, (), rgb)


@pytest.mark.parametrize("dashed", [False, True])
@pytest.mark.parametrize("contrast", [25, 90])
def test_the_right_map_stays_on(dashed, contrast):
    assert judged(photograph(contrast, dashed=dashed), prepared(dashed=dashed)) is None


@pytest.mark.parametrize("aside_m", [1.75, -1.75, 0.9, -2.2])
def test_a_map_that_is_aside_is_off_and_the_answer_says_where_the_paint_is(aside_m):
    found = judged(photograph(), prepared(aside_m))
    assert found.unmoved < DOUBT
    assert found.best >= FITS
    assert found.offset_m == pytest.approx(-aside_m, abs=0.01)


def test_a_picture_without_paint_is_no_evidence():
    for rgb in (
        photograph(contrast=0),
        photograph(contrast=0, noise=40.0),
        np.zeros((270, 480, 3), dtype=np.uint8),
    ):
        assert judged(rgb, prepared()) is None
        assert judged(rgb, prepared(1.75)) is None


def test_a_map_without_lines_or_with_few_in_view_is_not_judged():
    assert judged(photograph(), prepare_map(LaneMap({}))) is None
    assert (
        judged(photograph(), prepared(), se2(0, 0, np.pi) @ AHEAD @ np.diag([1.0, 1, 1, 1])) is None
    )
    small = replace(SPEC, width=48, height=27, K=np.diag([0.1, 0.1, 1]) @ SPEC.K)
    tiny = cv2.resize(photograph(), (48, 27), interpolation=cv2.INTER_AREA)
    assert contradiction(prepared(1.75), small, AHEAD, (), tiny) is None


def test_a_road_user_hides_lines_from_the_comparison():
    bus = ActorBox(se2(8.0, 0.0, 0.0, 1.6), Box(6.0, 14.0, 3.2), "bus")
    striped = photograph(contrast=0)
    lines = line_pixels(draw_map(prepared(1.75), SPEC, AHEAD)) & (np.arange(270)[:, None] > 150)
    striped[np.roll(lines, 30, axis=1)] = (
        200  # the lines of the map, beside where it has them, painted on the bus
    )
    assert contradiction(prepared(1.75), SPEC, AHEAD, (bus,), striped) is None


def test_paint_that_stays_where_the_recording_shows_it_is_no_evidence():
    """A poor reconstruction seen from a metre beside the path: its lines are aside by that metre.
    Others still are evidence.
    """
    unmoved = photograph(aside_m=0.9)
    assert judged(unmoved, prepared()).offset_m == pytest.approx(0.9)
    assert contradiction(prepared(), SPEC, AHEAD, (), unmoved, camera_offset_m=1.0) is None
    assert (
        contradiction(prepared(), SPEC, AHEAD, (), photograph(aside_m=1.75), camera_offset_m=1.0)
        is not None
    )
    path = np.array([[0.0, 0.0], [50.0, 0.0]])
    assert beside(path, se2(4.0, 1.0, 0.1), se2(4.0, 1.0, 0.1) @ AHEAD) == pytest.approx(
        np.cos(0.1)
    )
    assert beside(path, se2(4.0, -1.0, 0.0), se2(0, 0, np.pi) @ AHEAD) == pytest.approx(1.0), (
        "of a camera that looks back"
    )


def test_chance_is_one_half_and_pieces_at_the_edge_have_one_side():
    paint = top_hat(np.random.default_rng(2).integers(0, 255, (200, 300, 3), dtype=np.uint8))
    rows = np.arange(200)
    ones = np.ones(200, dtype=np.int64)
    found = agreement(Pieces(rows, 100 * ones, 104 * ones), paint)
    assert found == pytest.approx(0.5, abs=0.05)
    assert agreement(Pieces(rows, 296 * ones, 300 * ones), paint) is not None
    assert agreement(Pieces(rows[:9], ones[:9], 4 * ones[:9]), paint) is None


def ask(size=(240, 136)):
    scenario = load_scenario("smoke/straight")
    t_us = scenario.start_us + 1_000_000
    pose = wire_pose(
        interpolate(scenario.ego_log, t_us) @ scenario.cameras[0].T_rig_camera, "a test"
    )
    lens = pinhole(*size, "front")
    lens.opencv_pinhole_param.focal_length_x = lens.opencv_pinhole_param.focal_length_y = 130
    return sensorsim_pb2.RGBRenderRequest(
        scene_id=scenario.scene_id,
        resolution_w=size[0],
        resolution_h=size[1],
        camera_intrinsics=lens,
        frame_start_us=t_us - 30_000,
        frame_end_us=t_us,
        image_format=sensorsim_pb2.PNG,
        sensor_pose=sensorsim_pb2.PosePair(start_pose=pose, end_pose=pose),
    )


@pytest.mark.parametrize(("aside_m", "is_off"), [(0.0, False), (1.75, True)])
def test_a_server_drops_a_wrong_map_and_says_so(aside_m, is_off, overrides, caplog):
    def served(*more, moved_m=aside_m):
        made = assemble(
            Settings(
                renderer="onefixer+clean",
                scenes=["smoke/straight"],
                overrides=[*overrides, *more],
            )
        )
        entry = made.scenes.get(ask().scene_id)
        asked = ask()
        if entry.scene_map is not None:
            lines = replace(
                entry.scene_map, origin=entry.scene_map.origin + np.array([0.0, moved_m, 0.0])
            )
            made.scenes._loaded[asked.scene_id] = replace(entry, scene_map=lines)
        return decode_image(
            made.service.frames.answers([asked], CallTime())[0]
        ), made.service.frames.events[MAP_OFF]

    image, events = served()
    assert events == is_off
    told = [record.message for record in caplog.records if "the map is off" in record.message]
    assert len(told) == is_off
    without, _ = served("uses_map=false")
    assert np.array_equal(image, without) == is_off
    if is_off:
        assert "camera 'front'" in told[0]
        assert "m right of where the map has it" in told[0]
