"""The regime map: bins of holes, shift and length, and what a history is worth in each."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.lab.paper.regime import (
    AXES,
    HISTORIES,
    RegimeClip,
    as_measured,
    bins,
    paid,
    plot_regime,
    regime_section,
    room,
    under,
)

FRAMES = 40


def clips(arms: tuple[str, ...] = ("onefixer",), count: int = 6) -> list[RegimeClip]:
    """Return clips in whose later frames the truth as history is worth 1 dB; training on the own
    history always 0.5 dB.
    """
    rng = np.random.default_rng(0)
    out = []
    for i in range(count):
        level, late = 24 + rng.normal(size=FRAMES), np.arange(FRAMES) >= 16
        worth = {"own": 0.0, "oracle": late + 0.01 * rng.normal(size=FRAMES), "empty": -0.2}
        psnr = {
            under(arm, h): level + worth[h] + (0.5 if "V9" in arm else 0.0)
            for arm in arms
            for h in HISTORIES
        }
        out.append(
            RegimeClip(f"c{i}", np.full(FRAMES, 0.01), np.full(FRAMES, 0.1 if i % 2 else 2.0), psnr)
        )
    return out


def test_a_bin_has_what_its_frames_gain_and_is_left_out_with_few_clips() -> None:
    found = bins(clips(), room, crossed=False)
    length = {at[2]: one for at, one in found.items() if at[2] is not None}
    assert [length[i].gain_db.centre for i in range(3)] == pytest.approx([0, 0, 1], abs=0.02)
    assert length[2].shown
    assert {at for at in found if at[0] is not None} == {(1, None, None)}, (
        "all frames have holes of one per cent"
    )
    assert not [at for at in found if at[1] is not None], "three clips on each side of the path"
    assert not bins(clips(), room, crossed=True)
    assert len(bins(clips(count=12), room, crossed=True)) == 2 * 3


def test_what_was_paid_is_the_mean_over_seeds() -> None:
    assert not bins(clips(), paid, crossed=False)
    both = clips(("onefixer", "V9-still", "V3b-still", "V9-still, seed 1", "V3b-still, seed 1"))
    assert bins(both, paid, crossed=False)[None, None, 0].gain_db.centre == pytest.approx(0.5)
    assert as_measured(both).difference(
        "psnr_db", "V9-still", "V3b-still"
    ).difference == pytest.approx(0.5)


def test_the_section_has_both_tables_and_a_picture(tmp_path: Path) -> None:
    many = clips(count=12)
    text = regime_section(many, "regime.png")
    assert f"| {' | '.join(AXES)} | clips | room | paid |" in text
    assert "| from 16 | 12 | **+" in text
    assert "| 0.5 to 2 % | 0 to 0.5 m | from 16 | 6 | **+" in text
    assert "| onefixer | 23.98 | +0.599 ± " in text
    assert regime_section([], "") == ""
    plot_regime(many, tmp_path / "regime.png")
    assert cv2.imread(str(tmp_path / "regime.png")).std() > 5
