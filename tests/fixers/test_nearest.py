"""The control without a network shows references where they hold, the nearest first, and the render
elsewhere.
"""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Frame
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.fixers.warp import INCONSISTENT, VALID


def reference(grey, holds):
    image = np.full((1, 4, 4), grey, dtype=np.uint8)
    image[..., 3] = holds
    return image


def test_the_nearest_lies_on_top_and_what_is_doubted_is_not_shown():
    fixer = make_fixer("nearest", scene_id="s")
    references = (
        reference(1, [VALID, 0, 0, INCONSISTENT]),
        reference(2, [VALID, VALID, 0, INCONSISTENT]),
    )
    (out,) = fixer.step(
        [Frame(0, "front", np.full((1, 4, 3), 9, dtype=np.uint8), references=references)], []
    )
    assert out.rgb[0, :, 0].tolist() == [1, 2, 9, 9]
    assert out.references == ()


def test_it_has_no_blocks_and_needs_a_reference():
    for wrong in ("mode=chunk", "references=0"):
        with pytest.raises(InputError):
            fixer_settings("nearest", [wrong])
