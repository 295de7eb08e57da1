"""A rolling shutter against the definition, row by row, where it is hardest: a turning rig, a
passing car.
"""

from dataclasses import replace
from functools import cache, partial
from itertools import pairwise

import numpy as np
import pytest

from alpasim_plugin.cameras.shutter import at_share, bands_of, rolling
from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Behaviour, Exposure, RenderRequest
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.renderers.gaussian import clear_cache, scene_of
from alpasim_plugin.renderers.rolling import camera_at, draw_requests
from tests.gaussians.scene_maps import parked, straight, with_camera

SHUTTER_S = 0.03
STANDS = se2(20.0, -1.8, 0.0)


def plain_draw_request(request, draw):
    """Return the same as `draw_requests`, by the definition: for each time of exposure the whole
    picture, of which its pixels are taken.
    """
    spec = request.camera
    share = np.broadcast_to(request.exposure.share, (spec.height, spec.width))
    shape = (spec.height, spec.width)
    out = RasterOutput(
        np.zeros((*shape, 3), dtype=np.float32),
        np.ones(shape, dtype=np.float32),
        np.zeros(shape, dtype=np.float32),
    )
    for time in np.unique(share[~np.isnan(share)]):
        T, actors = at_share(request, float(time))
        (part,) = draw([(camera_at(request, T), actors)])
        mine = share == time
        for whole, drawn in ((out.rgb, part.rgb), (out.alpha, part.alpha), (out.depth, part.depth)):
            whole[mine] = drawn[mine]
    return out


@pytest.fixture(scope="module")
def scenario():
    car = replace(parked("car", 27.0, 1.8), is_static=False, behaviour=Behaviour())
    yield straight(actors=(car,))
    clear_cache()


@pytest.fixture(scope="module")
def draw(scenario):
    def drawn(views):
        outs = scene_of(scenario).render_all(views, 1)
        return [out.covered(np.ones((1, 1), dtype=np.float32)) for out in outs]

    return drawn


def case(scenario, speed_mps=0.0, turn_rad_s=0.0, car_mps=0.0):
    """A frame of a moving rig beside a car that drives along x."""
    spec = scenario.cameras[0]
    start = STANDS
    end = STANDS @ se2(speed_mps * SHUTTER_S, 0.0, turn_rad_s * SHUTTER_S)
    car = [se2(27.0 + car_mps * t, 1.8, 0.0, 0.75) for t in (-SHUTTER_S, 0.0)]
    exposure = Exposure(rolling(spec.width, spec.height, "rows", backwards=False), {"car": car[0]})
    T = np.stack([start @ spec.T_rig_camera, end @ spec.T_rig_camera])
    return RenderRequest(30_000, spec, T, {"car": car[1]}, exposure=exposure)


def by_pixel(request):
    """Return a request whose exposure does not say that whole rows are exposed at once, as that of a
    pinhole which covers a lens.
    """
    shape = request.camera.height, request.camera.width
    share = np.broadcast_to(request.exposure.share, shape).copy()
    return replace(request, exposure=replace(request.exposure, share=share))


def psnr(a, b):
    return float(-10 * np.log10(max(float(np.mean((a.rgb.astype(float) - b.rgb) ** 2)), 1e-12)))


@pytest.fixture(scope="module")
def truth_of(scenario, draw):
    """Return a function from the name of a hard case to its frame by the definition."""
    return cache(lambda name: plain_draw_request(case(scenario, **HARD[name]), draw))


HARD = {
    "driving": {"speed_mps": 15.0},
    "turning": {"speed_mps": 8.0, "turn_rad_s": 0.7},
    "turning on the spot": {"turn_rad_s": -1.5},
    "passing car": {"car_mps": -30.0},
    "all": {"speed_mps": 15.0, "turn_rad_s": 0.3, "car_mps": -30.0},
}


@pytest.mark.parametrize("in_bands", [False, True], ids=["by row", "in bands"])
@pytest.mark.parametrize(
    "name",
    [
        "all",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("turning on the spot", "driving", "turning", "passing car")
        ),
    ],
)
def test_a_rolling_frame_is_that_of_its_rows_where_the_end_pose_is_far_off(
    scenario,
    draw,
    truth_of,
    name,
    in_bands,
):
    request = case(scenario, **HARD[name])
    truth = truth_of(name)
    rolled = draw_requests([by_pixel(request) if in_bands else request], draw)[0]
    (at_end,) = draw_requests([replace(request, exposure=None)], draw)
    assert psnr(rolled, truth) > 34
    assert psnr(rolled, truth) > psnr(at_end, truth) + 8
    assert np.abs(rolled.rgb - truth.rgb).mean() < 1.5 / 255
    assert np.quantile(np.abs(rolled.rgb - truth.rgb), 0.999) < 0.2
    both = (rolled.alpha > 0.5) & (truth.depth > 0)
    assert np.median(np.abs(rolled.depth - truth.depth)[both]) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("along", "backwards"), [("rows", True), ("columns", False)])
def test_shutters_that_roll_another_way_do_so_on_the_cpu_too(scenario, draw, along, backwards):
    request = case(with_camera(scenario, 128, 72), **HARD["all"])
    assert request.exposure is not None
    share = rolling(request.camera.width, request.camera.height, along, backwards)
    request = replace(request, exposure=replace(request.exposure, share=share))
    truth = plain_draw_request(request, draw)
    assert psnr(*draw_requests([request], draw), truth) > 32


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("along", ["rows", "columns"])
def test_a_pixel_is_drawn_at_the_time_of_its_row_or_column(scenario, along, backwards):
    request = case(with_camera(scenario, 12, 5), **HARD["all"])
    assert request.exposure is not None
    share = rolling(12, 5, along, backwards)
    views = []
    draw_requests(
        [replace(request, exposure=replace(request.exposure, share=share))],
        lambda asked: views.extend(asked) or scene_of(scenario).render_all(asked, 1),
    )
    ((camera, _),) = views
    per_column, per_row, offset = camera.rolling.time
    columns, rows = np.meshgrid(np.arange(12) + 0.5, np.arange(5) + 0.5)
    times = per_column * columns + per_row * rows + offset
    np.testing.assert_allclose(times, np.broadcast_to(share - 0.5, (5, 12)), atol=1e-6)


def test_the_error_falls_as_bands_grow_in_number_and_ends_at_rounding(
    scenario,
    draw,
    truth_of,
    monkeypatch,
):
    request = case(scenario, **HARD["all"])
    truth = truth_of("all")
    errors = []
    for count in (1, 4, 16, request.camera.height):
        monkeypatch.setattr(
            "alpasim_plugin.renderers.rolling.bands",
            partial(lambda r, n: list(bands_of(r, n)), n=count),
        )
        errors.append(psnr(*draw_requests([by_pixel(request)], draw), truth))
    assert all(later > earlier + 6 for earlier, later in pairwise(errors)), errors
    assert (
        errors[-1] > 90
    )  # windows begin at other places than the picture, so sums round otherwise


def test_a_rig_that_stands_shows_what_a_global_shutter_does(scenario, draw):
    request = case(scenario)
    both = draw_requests([request, replace(request, exposure=None)], draw)
    np.testing.assert_array_equal(*(one.rgb for one in both))


def test_a_window_shows_what_the_whole_picture_does(scenario, draw):
    """Splats that reach into a window from far outside of it keep their shape."""
    spec = scenario.cameras[0]
    camera = PinholeCamera.from_pose(spec.width, spec.height, spec.K, STANDS @ spec.T_rig_camera)
    rows = slice(100, 107)
    columns = slice(60, 200)
    whole, part = draw([(camera, {}), (camera.window(rows, columns), {})])
    assert np.abs(part.rgb - whole.rgb[rows, columns]).max() < 2e-3
    assert (
        camera.window(rows, columns).window(slice(0, 2), slice(3, 9)).slope_limits()
        == camera.slope_limits()
    )


@pytest.mark.parametrize("name", ["clean", "3dgs"])
def test_renderers_roll_when_the_request_does(scenario, name):
    renderer = make_renderer(name, scenario)
    request = case(scenario, **HARD["all"])
    rolled = renderer.render(request)
    still = renderer.render(replace(request, exposure=None))
    assert (rolled.rgb != still.rgb).mean() > 0.2
    assert (
        np.abs(rolled.rgb[-1].astype(int) - still.rgb[-1]).mean()
        < np.abs(rolled.rgb[80].astype(int) - still.rgb[80]).mean()
    )
    assert rolled.depth.shape == rolled.rgb.shape[:2]
    assert renderer.render(request).rgb.tobytes() == rolled.rgb.tobytes()
