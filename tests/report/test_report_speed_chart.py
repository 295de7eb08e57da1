"""Speed against error: the time is the mean."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

from evaluators.metrics import METRICS
from evaluators.report import charts

TIMES = {"clean": (42.0, 60.0), "3dgs": (25.0, 38.0)}
TIMES |= {
    "onefixer": (176.0, 900.0),
    "onefixer-dit-s": (160.0, 300.0),
    "identity+3dgs": (26.0, 40.0),
}
WORSE = {"3dgs": 0.08, "onefixer": 0.02, "onefixer-dit-s": 0.021, "identity+3dgs": 0.079}


def run_with(times: dict[str, tuple[float, float]]) -> SimpleNamespace:
    """Make what the chart reads of a run; the median of a fixer of blocks is near zero."""
    speed = {
        name: {"ms_per_frame_p50": 1.0, "ms_per_frame_mean": mean, "ms_per_frame_p95": p95}
        for name, (mean, p95) in times.items()
    }
    entry = {"direction": "lower", "unit": "fraction", "margin": 0.02}
    paired = {
        n: {"collision_at_fault": entry | {"diff": d, "ci95": [d - 0.03, d + 0.03]}}
        for n, d in WORSE.items()
        if n in times
    }
    return SimpleNamespace(summary={"speed": speed, "paired": paired}, table=METRICS)


def test_a_fixer_that_is_free_on_most_frames_stands_where_its_mean_is() -> None:
    run = run_with(TIMES)
    (chart,) = charts.speed_against_error(run, {name: i for i, name in enumerate(TIMES)})  # type: ignore[arg-type]
    places = [float(x) for x in re.findall(r'<circle cx="([\d.]+)"', chart.picture)]
    means = [mean for mean, _ in TIMES.values()]
    assert np.corrcoef(places, means)[0, 1] == pytest.approx(1.0, abs=1e-6)


def test_a_renderer_without_a_mean_is_left_out() -> None:
    run = run_with(TIMES)
    run.summary["speed"]["onefixer"]["ms_per_frame_mean"] = None
    (chart,) = charts.speed_against_error(run, {name: i for i, name in enumerate(TIMES)})  # type: ignore[arg-type]
    assert chart.picture.count("<circle") == len(TIMES) - 1
