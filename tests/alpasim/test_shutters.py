"""The shutter of a request: when each pixel is exposed, through any lens, and that a served frame
shows it.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from alpasim_plugin.alpasim.server.assembly import Settings, assemble
from alpasim_plugin.alpasim.server.shutters import exposure_of
from alpasim_plugin.alpasim.server.sources import drawn_map
from alpasim_plugin.alpasim.server.status import CallTime
from alpasim_plugin.alpasim.server.views import camera_of, read_sides, read_view
from alpasim_plugin.cameras.lens import lens_of, lens_shares
from alpasim_plugin.cameras.shutter import bands
from alpasim_plugin.core.geometry import interpolate, se2
from alpasim_plugin.core.types import Exposure, RenderRequest
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import actor_boxes
from alpasim_plugin.gaussians.scene.log_views import actors_at
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.schema import wire_render_request
from alpasim_plugin.log.wire import sensorsim_pb2
from alpasim_plugin.runs.cameras import recorded_requests
from scenarios.load import load_scenario
from tests.alpasim.service_cases import pinhole
from tests.alpasim.wire_lenses import distorted, fisheye, ftheta
from tests.examples import first_of

SCENE = "smoke/lead_car"
W = 96
H = 54
DOWN = sensorsim_pb2.ROLLING_TOP_TO_BOTTOM
UP = sensorsim_pb2.ROLLING_BOTTOM_TO_TOP
RIGHT = sensorsim_pb2.ROLLING_LEFT_TO_RIGHT
LEFT = sensorsim_pb2.ROLLING_RIGHT_TO_LEFT


def ask(
    shutter_type=DOWN,
    turn_rad=0.03,
    ms=30,
    spec=None,
):
    """Return the request of a frame of the recorded drive, the rig turning while the shutter is
    open.
    """
    scenario = load_scenario(SCENE)
    t_us = scenario.start_us + 2_000_000
    open_us = t_us - 1000 * ms
    (request,) = recorded_requests(scenario, t_us)
    T_rig_camera = request.camera.T_rig_camera
    start, end = interpolate(scenario.ego_log, [open_us, t_us])
    request = replace(
        request,
        camera=replace(request.camera, shutter_us=1000 * ms),
        T_world_camera=np.stack([start @ T_rig_camera, end @ se2(0, 0, turn_rad) @ T_rig_camera]),
        exposure=Exposure(np.zeros((1, 1)), actors_at(scenario.actors, open_us)),
    )
    asked = wire_render_request(scenario.scene_id, request, "png")
    asked.resolution_w, asked.resolution_h = W, H
    asked.camera_intrinsics.CopyFrom(spec or pinhole(W, H, "front"))
    asked.camera_intrinsics.shutter_type = shutter_type
    return asked


def exposure(asked):
    view, (side, *_) = read_view(asked), sides_of_request(asked)
    objects = {name: pair[1] for name, pair in view.objects.items()}
    return exposure_of(asked.camera_intrinsics, view, side, objects)


def sides_of_request(asked):
    return read_sides(asked.camera_intrinsics, asked.resolution_w, asked.resolution_h)


@pytest.mark.parametrize("spec", first_of([ftheta(True), distorted(), fisheye(), ftheta(False)]))
@pytest.mark.parametrize("shutter_type", first_of([UP, RIGHT, DOWN, LEFT]))
def test_every_pixel_of_a_lens_is_exposed_at_the_time_of_its_row_or_column(spec, shutter_type):
    asked = ask(shutter_type, spec=spec)
    asked.resolution_w = 160
    asked.resolution_h = 90
    found, (lens, *_) = exposure(asked), sides_of_request(asked)
    assert lens.resample is not None
    assert found.share.shape == lens.cover[::-1]
    read = cv2.remap(
        found.share, lens.resample, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    rows, columns = np.mgrid[:90, :160]
    expected = rows / 89 if shutter_type in (DOWN, UP) else columns / 159
    expected = (1 - expected if shutter_type in (UP, LEFT) else expected)[lens.part]
    seen = np.ones_like(expected, dtype=bool) if lens.weight is None else lens.weight > 0
    assert not np.isnan(read[seen]).any()
    assert np.abs(read - expected)[seen].max() < 0.3 / 89


@pytest.mark.parametrize(
    ("shutter", "rolls"),
    [
        ({"shutter_type": DOWN}, True),
        ({"shutter_type": UP}, True),
        ({"shutter_type": sensorsim_pb2.GLOBAL}, False),
        ({"shutter_type": sensorsim_pb2.UNKNOWN}, False),
        ({"shutter_type": DOWN, "ms": 0}, False),
    ],
)
def test_what_rolls(shutter, rolls):
    asked = ask(**shutter)
    found = exposure(asked)
    assert (found is not None) == rolls
    if found is not None:
        assert (found.share[0, 0] < found.share[-1, 0]) == (
            asked.camera_intrinsics.shutter_type != UP
        )
        assert set(found.actors_start) == {o.track_id for o in asked.dynamic_objects}


def served(asked):
    made = assemble(Settings(renderer="clean", scenes=[SCENE]))
    return decode_image(made.service.frames.answers([asked], CallTime())[0])


def test_a_served_frame_is_the_renderers_own_with_that_exposure_and_one_pose_a_row():
    rolled = served(ask())
    still = served(ask(sensorsim_pb2.GLOBAL))
    assert (
        np.abs(rolled[: H // 2].astype(int) - still[: H // 2]).mean()
        > 3 * np.abs(rolled[-2:].astype(int) - still[-2:]).mean()
    )


def test_the_map_has_the_shutter_of_the_frame():
    made = assemble(Settings(renderer="onefixer+clean", scenes=[SCENE]))
    asked = ask()
    view = read_view(asked)
    entry = made.scenes.get(asked.scene_id)
    (lens,) = sides_of_request(asked)
    camera = lens.spec("front", np.eye(4))
    boxes = {name: pair[1] for name, pair in view.objects.items()}
    request = RenderRequest(view.t_us, camera, view.T_world_camera, boxes, exposure=exposure(asked))
    drawn = drawn_map(entry, request)
    still = drawn_map(entry, replace(request, exposure=None))
    assert still is not None
    assert (drawn != still).any()
    assert entry.scene_map is not None
    for band in bands(request):
        users = actor_boxes(band.actors, entry.scenario.actors)
        np.testing.assert_array_equal(
            drawn[band.rows],
            draw_map(entry.scene_map, camera, band.T_world_camera, users)[band.rows],
        )


def test_what_the_lens_does_not_see_is_exposed_never():
    lens = lens_of(camera_of(ftheta(False), 320, 180))
    share = lens_shares(camera_of(ftheta(False), 320, 180), lens, "rows", backwards=False)
    sees = ~np.isnan(share)
    used = np.zeros(lens.cover[::-1], dtype=bool)
    assert lens.resample is not None
    column, row = np.floor(lens.resample).astype(int).reshape(-1, 2).T
    for dx in (0, 1):
        for dy in (0, 1):
            used[
                np.clip(row + dy, 0, lens.cover[1] - 1), np.clip(column + dx, 0, lens.cover[0] - 1)
            ] = True
    assert sees[used].all()
    assert not sees.all()
