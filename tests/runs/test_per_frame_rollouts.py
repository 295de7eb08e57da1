"""Closed loop behind a per-frame fixer: every frame is of its true pose, fixed once, and equal to
fixing the same frames afterwards.
"""

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from alpasim_plugin import run_rollout
from alpasim_plugin.core.types import Latency
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.loop import PerFrameRenderer
from alpasim_plugin.fixers.pixel_fixer import PixelFixer
from tests.runs.fixed_drives import Zigzag, assert_same_pictures, drive, rendered
from tests.runs.grey_renderer import Grey

SMALL = ("weights.bundle=null", "generator.widths=[8,8,8]", "untrained=random", "uses_map=false")


def network():
    return PixelFixer(fixer_settings("onefixer", SMALL), "straight-road", threads=1)


def offline(frames):
    fixer = network()
    return [out for frame in frames for out in fixer.step([frame], ())]


def test_a_drive_sees_every_frame_fixed_once_at_its_true_pose(straight_road):
    scenario = replace(straight_road, end_us=1_200_000)
    run = drive(scenario, Zigzag, network)  # type: ignore[arg-type]
    session = run.session
    assert isinstance(session, PerFrameRenderer)
    assert session.lookahead == 0
    assert not any(request.ahead for request in run.requests)
    expected = {
        "label": session.fixer.label,
        "trained": False,
        "mode": "frame",
        "frames": len(run.frames),
    }
    assert session.facts() == expected
    assert_same_pictures(run.frames, offline(rendered(scenario, run.requests)))
    assert_same_pictures(run.policy.seen, run.frames[: len(run.policy.seen)])
    assert session.stage_ms["fix"] > 0


def test_the_fixers_time_delays_plans_where_latency_says_so(straight_road):
    class Slow(Grey):
        stage_ms = MappingProxyType({"fix": 150.0})  # longer than the camera's period

    def path(latency):
        scenario = replace(straight_road, end_us=1_500_000, latency=latency)
        return run_rollout(scenario, Slow(), Zigzag(scenario)).log().ego.xyz

    assert not np.array_equal(path(Latency("measured", fixer=True)), path(Latency("measured")))
