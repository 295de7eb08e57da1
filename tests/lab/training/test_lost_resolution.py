"""Lost resolution: detail goes, holes are transparent and black, nothing else changes, and the same
draw gives the same damage.
"""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.lab.training.lost_resolution import LostResolution, draw_lost_resolution


def test_a_draw_is_a_pure_function_of_its_stream_and_within_range():
    for seed in range(20):
        a, b = (draw_lost_resolution(np.random.default_rng(seed), 96, 128) for _ in range(2))
        assert_array_equal(a.opacity, b.opacity)
        assert (a.blur_px, a.cell_px) == (b.blur_px, b.cell_px)
        assert a.opacity.dtype == a.blurred.dtype == np.float32
        assert a.opacity.shape == a.blurred.shape == (96, 128)
        assert 0 <= a.opacity.min() <= a.opacity.max() <= 1
        assert 0 <= a.blurred.min() <= a.blurred.max() <= 1


def test_flat_opaque_frames_stay_and_detail_is_lost():
    lost = LostResolution(
        1.5, 3, np.full((48, 64), 0.5, dtype=np.float32), np.ones((48, 64), dtype=np.float32)
    )
    flat = np.full((2, 3, 48, 64), 0.25, dtype=np.float32)
    assert_allclose(lost.apply(flat), flat, atol=1e-6)
    noise = np.random.default_rng(0).uniform(-1, 1, (2, 3, 48, 64)).astype(np.float32)
    assert lost.apply(noise).std() < 0.5 * noise.std()


def test_black_shows_through_holes_by_their_transparency():
    opacity = np.ones((48, 64), dtype=np.float32)
    opacity[10:20, 10:20] = 0.25
    white = np.ones((1, 3, 48, 64), dtype=np.float32)
    shown = LostResolution(0.6, 2, np.ones((48, 64), dtype=np.float32), opacity).apply(white)
    assert_allclose((shown[0] + 1) / 2, np.broadcast_to(opacity, (3, 48, 64)), atol=1e-6)
