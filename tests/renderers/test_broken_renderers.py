from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from alpasim_plugin.core.geometry import se3
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.parts import names as known
from alpasim_plugin.core.types import RenderRequest
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.renderers.broken import LATE_US, SHIFT_M
from alpasim_plugin.renderers.gaussian import clear_cache
from tests.gaussians.scene_maps import straight


@pytest.fixture(scope="module")
def scenario():
    yield straight(actors=())
    clear_cache()


LATE_FRAMES = 5  # a second of these requests, which follow the log's 5 Hz


def requests(scenario, n):
    out = []
    for i in range(5, 5 + n):
        T = (
            se3(scenario.ego_log.xyz[i], scenario.ego_log.quat[i])
            @ scenario.cameras[0].T_rig_camera
        )
        out.append(
            RenderRequest(int(scenario.ego_log.t_us[i]), scenario.cameras[0], np.stack([T, T]), {})
        )
    return out


def test_every_broken_renderer_differs_from_clean_and_keeps_the_contract(
    scenario,
):
    names = [name for name in known("renderer") if name.startswith("broken-")]
    assert len(names) == 6
    views = requests(scenario, LATE_FRAMES + 2)
    good = make_renderer("clean", scenario).render(views[-1])
    for name in names:
        broken = make_renderer(name, scenario)
        assert isinstance(broken, Renderer)
        for r in views:
            bad = broken.render(r)
        assert bad.t_us == good.t_us
        assert bad.rgb.shape == good.rgb.shape
        assert bad.rgb.dtype == np.uint8
        assert np.mean(np.abs(bad.rgb.astype(int) - good.rgb)) > 2, name


def test_frozen_repeats_the_first_picture_and_late_the_one_some_frames_ago(
    scenario,
):
    views = requests(scenario, LATE_FRAMES + 3)
    clean = [make_renderer("clean", scenario).render(r).rgb for r in views]
    frozen = make_renderer("broken-frozen", scenario)
    late = make_renderer("broken-late", scenario)
    for i, r in enumerate(views):
        assert_array_equal(frozen.render(r).rgb, clean[0])
        assert_array_equal(late.render(r).rgb, clean[max(0, i - LATE_FRAMES)])


def test_mirrored_swaps_left_and_right_and_shifted_sees_from_half_a_metre_to_the_right(
    scenario,
):
    r = requests(scenario, 1)[0]
    clean = make_renderer("clean", scenario)
    assert_array_equal(
        make_renderer("broken-mirrored", scenario).render(r).rgb, clean.render(r).rgb[:, ::-1]
    )
    beside = r.T_world_camera @ np.array(
        [[1.0, 0, 0, SHIFT_M], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    )
    found = make_renderer("broken-shifted", scenario).render(r)
    assert_array_equal(found.rgb, clean.render(replace(r, T_world_camera=beside)).rgb)
    assert SHIFT_M == 0.5


def test_late_shows_the_newest_picture_that_is_a_second_old_at_any_frame_rate(
    scenario,
):
    views = requests(scenario, 21)[::3]
    t_us = [r.t_us for r in views]
    assert LATE_US % (t_us[1] - t_us[0])  # a second falls between two frames
    clean = [make_renderer("clean", scenario).render(r).rgb for r in views]
    late = make_renderer("broken-late", scenario)
    for i, r in enumerate(views):
        due = max((j for j in range(i + 1) if t_us[j] <= t_us[i] - LATE_US), default=0)
        assert_array_equal(late.render(r).rgb, clean[due])
    assert due > 2
