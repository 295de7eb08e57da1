"""Warp L1 on videos whose motion is known (values of the checks: docs/lab/video-metrics.md)."""

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.video_metrics.warp import backward_flow, late_window, warp_l1

RNG = stream("video", 0, "warp")


def texture(height, width):
    noise = cv2.GaussianBlur(RNG.standard_normal((height, width, 3)), (0, 0), 3.0)
    return np.clip(127 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)


def test_picture_that_moves_three_pixels_is_followed():
    wide = texture(120, 200)
    video = np.stack(
        [wide[:, 3 * i : 3 * i + 160] for i in range(3)]
    )  # what is seen moves left: it was 3 px to the right
    flow = backward_flow(*(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in (video[1], video[0])))
    inner = flow[20:-20, 20:-20].reshape(-1, 2)
    assert np.median(inner, axis=0) == pytest.approx([3.0, 0.0], abs=0.05)
    found = warp_l1(video)
    plain = np.abs(np.diff(video.astype(float), axis=0)).sum(-1).mean() / 765
    assert found.shape == (2,)
    assert np.all(found < 0.05 * plain)


def test_video_that_stands_still_has_no_error():
    still = np.repeat(texture(64, 96)[None], 3, axis=0)
    grey = cv2.cvtColor(still[0], cv2.COLOR_RGB2GRAY)
    assert np.abs(backward_flow(grey, grey))[8:-8, 8:-8].max() < 0.03  # Farneback wavers at the rim
    assert np.all(warp_l1(still) < 3e-4)


@pytest.mark.parametrize(
    ("pairs", "first"), [(197, 131), (899, 599), (90, 60), (89, 59), (30, 0), (5, 0)]
)
def test_late_window_is_the_last_third_but_at_least_thirty(pairs, first):
    assert len(range(pairs)[late_window(pairs)]) == pairs - first


def test_one_frame_has_no_motion_to_follow():
    with pytest.raises(EvaluatorError):
        warp_l1(texture(32, 32)[None])
