"""Numbers that a refined stream adds up to."""

import numpy as np
import pytest

from alpasim_plugin.core.types import Frame
from alpasim_plugin.fixers import make_fixer
from alpasim_plugin.fixers.refine import Difference, StreamStats, refine_frames


def test_difference_over_several_images_equals_the_textbook_formula_over_all_of_them():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 256, (2, 5, 9, 7, 3), dtype=np.uint8)
    a[2] = b[2]
    difference = Difference()
    for x, y in zip(a, b, strict=True):
        difference.add(x, y)
    d = a.astype(np.float64) - b
    assert difference.psnr_db == pytest.approx(10 * np.log10(255**2 / np.mean(d**2)), rel=1e-12)
    assert difference.mean_levels == pytest.approx(np.abs(d).mean(), rel=1e-12)
    assert difference.max_levels == np.abs(d).max()


def test_blocks_are_made_as_they_are_asked_for():
    taken = []

    def frames():
        for i in range(30):
            taken.append(i)
            yield Frame(i, "video", np.zeros((16, 16, 3), dtype=np.uint8)), None

    tally = StreamStats()
    for block in refine_frames(frames(), make_fixer("identity", scene_id="video")):  # type: ignore[arg-type]
        tally.add(block)
        assert len(taken) == tally.frames
    assert tally.frames == 30
    assert len(tally.ms_per_frame) == 5
