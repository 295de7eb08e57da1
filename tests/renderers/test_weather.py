"""Fog: its transmittance at known distances, what it does to images, and who is shown it."""

from __future__ import annotations

import numpy as np
import pytest

from alpasim_plugin import load_scenario, make_renderer
from alpasim_plugin.core.errors import InputError, RendererError
from alpasim_plugin.core.types import Frame
from alpasim_plugin.renderers import weather
from alpasim_plugin.renderers.gaussian import clear_cache
from alpasim_plugin.renderers.weather import FogRenderer, in_fog, transmittance
from alpasim_plugin.runs.gpu_check import frame_request

K = np.array([[100.0, 0, 50], [0, 100, 30], [0, 0, 1]])
AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


def depth_of_wall(distance_m):
    return np.full((60, 100), distance_m, np.float32)


@pytest.mark.parametrize("distance_m", [5.0, 20.0, 60.0, 150.0])
def test_transmittance_falls_by_the_distance_along_the_ray(distance_m):
    found = transmittance(depth_of_wall(distance_m), K, AHEAD, 120.0)
    for row, column in ((30, 50), (0, 0), (59, 99)):
        ray = np.array([(column + 0.5 - 50) / 100, (row + 0.5 - 30) / 100, 1.0])
        due = np.exp(-3.912 / 120.0 * distance_m * np.linalg.norm(ray))
        assert found[row, column] == pytest.approx(due, rel=0.02)


def test_fog_mixes_linear_light_and_hides_the_sky():
    dark = np.zeros((60, 100, 3), np.uint8)
    depth = depth_of_wall(50.0)
    depth[:20] = 0
    found = in_fog(dark, depth, K, AHEAD, 100.0)
    assert (found[:20] == weather.FOG_SRGB).all()
    through = transmittance(depth, K, AHEAD, 100.0)[40, 50]
    fog = ((np.array(weather.FOG_SRGB) / 255 + 0.055) / 1.055) ** 2.4
    due = 255 * (1.055 * (fog * (1 - through)) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(found[40, 50], due, atol=1.0)


def test_a_hole_in_the_ground_is_as_far_as_the_ground_around_it():
    depth = depth_of_wall(10.0)
    depth[45:50, 40:60] = 0
    found = transmittance(depth, K, AHEAD, 100.0)
    assert found[47, 50] == pytest.approx(found[44, 50], rel=0.02)
    assert not transmittance(depth_of_wall(0.0), K, AHEAD, 100.0).any()


@pytest.mark.parametrize("renderer", ["clean", "onefixer"])  # the fixer repairs what 3dgs shows
def test_every_renderer_shows_the_fog_and_a_fixer_keeps_it(renderer):
    short = ["timing.duration_us=1500000", "timing.warmup_us=200000"]
    fog = (short, [*short, "environment.fog_visibility_m=80"])
    scenarios = [load_scenario("smoke/curve", overrides=overrides) for overrides in fog]
    clear, foggy = (
        make_renderer(renderer, scenario)
        .render(frame_request(scenario, 256, 144))
        .rgb.astype(float)
        for scenario in scenarios
    )
    far, near = slice(60, 72), slice(-12, None)
    assert foggy[far].std() < 0.8 * clear[far].std()
    assert foggy[near].std() > 0.3 * clear[near].std()
    assert (foggy[:10].max(axis=2) >= weather.FOG_SRGB[2] - 40).mean() > 0.2  # no blue sky
    clear_cache()


def test_a_renderer_without_depth_cannot_be_put_into_fog():
    scenario = load_scenario("smoke/curve")
    request = frame_request(scenario, 32, 16)

    class Flat:
        lookahead = 0
        block = None
        has_history = False

        def render(self, request):
            return Frame(request.t_us, request.camera.name, np.zeros((16, 32, 3), np.uint8))

    with pytest.raises(RendererError):
        FogRenderer(Flat(), 100.0).render(request)


@pytest.mark.parametrize("visibility_m", ["0", "-5", "nan", "thick"])
def test_a_visibility_that_is_none_is_refused(visibility_m):
    with pytest.raises(InputError):
        load_scenario("smoke/curve", overrides=[f"environment.fog_visibility_m={visibility_m}"])
