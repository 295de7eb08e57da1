"""A row of the quality table holds ColorVideoVDP of a few frames where the metric is at hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from alpasim_plugin.lab.bench.quality import JOD_EVERY, QualityClip, Variant, measure, run_variant
from alpasim_plugin.lab.video_metrics.facts import JOD


class Apart:
    """Ten less the mean difference in grey levels, so that the frames asked about can be told."""

    def jod(self, made: Any, truth: Any) -> Any:
        self.asked = len(made)
        return 10 - np.abs(made.astype(float) - truth).mean(axis=(1, 2, 3))


@pytest.mark.parametrize(("label", "wanted"), [("3dgs", 8.0), ("truth", None)])
def test_every_twentieth_frame_is_asked_about(label: str, wanted: float | None) -> None:
    truth = np.full((41, 16, 16, 3), 100, np.uint8)
    render = truth.copy()
    render[::JOD_EVERY] += 2
    opacity, t_us = np.full((41, 16, 16), 255, np.uint8), np.arange(41) * 100_000
    clip = QualityClip("one", {}, render, truth, opacity, np.zeros_like(truth), t_us)
    variant = Variant(label)
    vdp = Apart()
    row = measure(clip, variant, run_variant(clip, variant, None), 0, {}, vdp)  # type: ignore[arg-type]
    assert row["values"].get(JOD) == wanted
    assert JOD not in measure(clip, variant, run_variant(clip, variant, None), 0, {})["values"]
    assert getattr(vdp, "asked", 0) == (3 if wanted else 0)
