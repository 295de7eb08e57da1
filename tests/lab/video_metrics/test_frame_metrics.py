"""PSNR and SSIM of frames against slow float64 reference implementations, and at their edges."""

import numpy as np
import pytest
from scipy.signal import convolve2d

from alpasim_plugin.core import image_metrics
from alpasim_plugin.core.image_metrics import CAP_DB
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.video_metrics.frames import psnr_db, ssim

RNG = stream("video", 0, "frames")
TRUTH = RNG.integers(0, 256, (3, 20, 27, 3)).astype(np.uint8)
SMOOTH = np.stack([np.add.outer(np.arange(24) * 4, np.arange(31) * 3)] * 3, axis=-1)[None].astype(
    np.uint8
)


def slow_ssim(a, b):
    """One frame, float64, one channel and one 2-D convolution after the other."""
    x = np.arange(-5, 6)
    row = np.exp(-(x**2) / (2 * 1.5**2))
    window = np.outer(row, row) / row.sum() ** 2
    values = []
    for c in range(3):
        p, q = a[..., c] / 255.0, b[..., c] / 255.0

        def mean(image):
            return convolve2d(image, window, mode="same", boundary="fill", fillvalue=0)

        mp, mq = mean(p), mean(q)
        vp = mean(p * p) - mp**2
        vq = mean(q * q) - mq**2
        cov = mean(p * q) - mp * mq
        values.append(
            (2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4))
        )
    return float(np.mean(values))


@pytest.mark.parametrize("noise", [1, 10, 60])
def test_ssim_equals_the_slow_one(noise):
    made = np.clip(
        SMOOTH.astype(int) + RNG.integers(-noise, noise + 1, SMOOTH.shape), 0, 255
    ).astype(np.uint8)
    assert ssim(made, SMOOTH)[0] == pytest.approx(slow_ssim(made[0], SMOOTH[0]), abs=2e-5)


def test_ssim_of_black_against_white_and_of_flat_frames():
    black, white = np.zeros((1, 16, 16, 3), np.uint8), np.full((1, 16, 16, 3), 255, np.uint8)
    assert ssim(black, white)[0] == pytest.approx(slow_ssim(black[0], white[0]), abs=2e-5)
    assert ssim(black, black)[0] == pytest.approx(1.0, abs=1e-6)


def test_psnr_of_a_known_error_and_of_identical_frames():
    made = TRUTH.copy()
    made[1] = np.where(made[1] > 127, made[1] - 10, made[1] + 10)
    found = psnr_db(made, TRUTH)
    assert found[1] == pytest.approx(20 * np.log10(255 / 10))
    assert list(found[[0, 2]]) == [CAP_DB, CAP_DB]


@pytest.mark.parametrize(("low", "peak"), [(0, 255.0), (0, 1.0), (-1, 2.0)])
def test_the_range_of_values_does_not_change_psnr(low, peak):
    a = np.full((2, 2, 3), low, np.float32)
    assert image_metrics.psnr_db(a, a + np.float32(peak / 255), peak) == pytest.approx(
        20 * np.log10(255), abs=1e-4
    )


def test_ssim_of_floats_equals_that_of_their_eight_bits():
    a, b = TRUTH[0], TRUTH[1]
    assert image_metrics.ssim(a / np.float32(255), b / np.float32(255), peak=1.0) == pytest.approx(
        image_metrics.ssim(a, b), abs=1e-6
    )
