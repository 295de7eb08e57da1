"""PSNR and SSIM of frames at their edges; tests/gaussians/fit compares SSIM with a plain one."""

import numpy as np
import pytest

from alpasim_plugin.core import image_metrics
from alpasim_plugin.core.image_metrics import CAP_DB
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.video_metrics.frames import psnr_db, ssim

RNG = stream("video", 0, "frames")
TRUTH = RNG.integers(0, 256, (3, 20, 27, 3)).astype(np.uint8)


def test_ssim_of_black_against_white_and_of_flat_frames():
    black = np.zeros((1, 16, 16, 3), dtype=np.uint8)
    white = np.full((1, 16, 16, 3), 255, dtype=np.uint8)
    assert ssim(black, white)[0] < 1e-3
    assert ssim(black, black)[0] == pytest.approx(1.0, abs=1e-6)


def test_psnr_of_a_known_error_and_of_identical_frames():
    made = TRUTH.copy()
    made[1] = np.where(made[1] > 127, made[1] - 10, made[1] + 10)
    found = psnr_db(made, TRUTH)
    assert found[1] == pytest.approx(20 * np.log10(255 / 10))
    assert list(found[[0, 2]]) == [CAP_DB, CAP_DB]


@pytest.mark.parametrize(("low", "peak"), [(0, 255.0), (0, 1.0), (-1, 2.0)])
def test_the_range_of_values_does_not_change_psnr(low, peak):
    a = np.full((2, 2, 3), low, dtype=np.float32)
    assert image_metrics.psnr_db(a, a + np.float32(peak / 255), peak) == pytest.approx(
        20 * np.log10(255), abs=1e-4
    )


def test_ssim_of_floats_equals_that_of_their_eight_bits():
    a = TRUTH[0]
    b = TRUTH[1]
    assert image_metrics.ssim(a / np.float32(255), b / np.float32(255), peak=1.0) == pytest.approx(
        image_metrics.ssim(a, b), abs=1e-6
    )
