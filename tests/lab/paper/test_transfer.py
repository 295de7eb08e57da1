"""What the transfer measures of a clip, and its section."""

from __future__ import annotations

import numpy as np
import pytest

from alpasim_plugin.lab.paper.measured import Measured
from alpasim_plugin.lab.paper.published import published
from alpasim_plugin.lab.paper.transfer import (
    COMPARED,
    PHOTOGRAPHS,
    TRANSFER,
    clip_values,
    tenth,
    transfer_section,
)

SERIES = {
    "psnr_db": np.arange(50.0),
    "perceptual-syn": np.linspace(0, 0.49, 50),
    "warp_l1": np.zeros(49),
}


def test_a_clip_has_its_middle_and_last_tenth() -> None:
    found = clip_values(SERIES, 50, None)
    assert found["psnr_db"] == pytest.approx(24.5)
    assert found["perceptual-syn-mid"] == pytest.approx(np.mean([0.23, 0.24, 0.25, 0.26, 0.27]))
    assert found["perceptual-syn-last"] == pytest.approx(0.47)
    assert "warp_l1" not in found  # the row has it


def test_of_photographs_only_those_held_out_count() -> None:
    found = clip_values(SERIES, 50, range(2, 50, 5))
    assert found["psnr_db"] == pytest.approx(np.mean(range(2, 50, 5)))
    assert found["perceptual-syn-mid"] == pytest.approx(0.27)  # one of five
    assert "perceptual-syn-last" not in clip_values(SERIES, 50, [3])


@pytest.mark.parametrize("frames", [1, 9, 10, 61, 100, 900])
def test_tenths_lie_within_the_clip(frames: int) -> None:
    middle, last = tenth(frames, last=False), tenth(frames, last=True)
    assert len(middle) == len(last) == max(frames // 10, 1)
    assert 0 <= middle.start <= middle.stop <= frames == last.stop
    assert abs((middle.start + middle.stop) / 2 - frames / 2) <= 0.5


def test_the_section_has_photographs_where_they_were_measured() -> None:
    clips = {
        f"c{i}": {"psnr_db": 20.0 + i, "perceptual-syn": 0.2, "perceptual-syn-mid": 0.2}
        for i in range(3)
    }
    mine = Measured({"3dgs": clips, "V9": clips, "V9 zero shot": clips})
    text = transfer_section(published(), {TRANSFER: mine})
    assert "Photographs" not in text
    assert text.count("**V9** | paper") == 1
    assert "3 held-out scenes" in text
    both = transfer_section(published(), {TRANSFER: mine, PHOTOGRAPHS: mine})
    assert "| V9 zero shot | 21.00 ± " in both
    assert transfer_section(published(), {}) == ""


def test_every_row_of_the_papers_transfer_table_has_an_arm_here() -> None:
    assert set(published().tables["transfer"].rows) == set(COMPARED)
