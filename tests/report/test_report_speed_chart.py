"""Speed against error: the time is the mean, and names do not cover each other."""

from __future__ import annotations

import re
from types import SimpleNamespace

import matplotlib as mpl
import pytest

from evaluators.metrics import METRICS
from evaluators.report import charts

TIMES = {"clean": (42.0, 60.0), "3dgs": (25.0, 38.0)}
TIMES |= {"onefixer": (176.0, 900.0), "onefixer-m": (160.0, 300.0), "identity+3dgs": (26.0, 40.0)}
WORSE = {"3dgs": 0.08, "onefixer": 0.02, "onefixer-m": 0.021, "identity+3dgs": 0.079}


def run_with(times: dict[str, tuple[float, float]]) -> SimpleNamespace:
    """Make what the chart reads of a run; the median of a fixer of blocks is near zero."""
    speed = {name: {"ms_per_frame_p50": 1.0, "ms_per_frame_mean": mean, "ms_per_frame_p95": p95} for name, (mean, p95) in times.items()}
    entry = {"direction": "lower", "unit": "fraction", "margin": 0.02}
    paired = {n: {"collision_at_fault": entry | {"diff": d, "ci95": [d - 0.03, d + 0.03]}} for n, d in WORSE.items() if n in times}
    return SimpleNamespace(summary={"speed": speed, "paired": paired}, table=METRICS)


def test_a_fixer_that_is_free_on_most_frames_stands_where_its_mean_is(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    monkeypatch.setattr(charts, "_time_axis", lambda axes, ms: drawn.append((axes, ms)))
    charts.speed_against_error(run_with(TIMES), {name: i for i, name in enumerate(TIMES)})  # type: ignore[arg-type]
    (axes, _), *_ = drawn
    markers = {line.get_label(): line.get_xdata()[0] for line in axes.lines if line.get_label() in TIMES}
    assert markers == {name: mean for name, (mean, _) in TIMES.items()}


@pytest.mark.parametrize("times", [TIMES, dict.fromkeys(TIMES, (30.0, 35.0))], ids=["spread", "all alike"])
def test_no_name_covers_another(times: dict[str, tuple[float, float]], monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = []

    def measured(figure: mpl.figure.Figure) -> str:
        figure.canvas.draw()
        boxes.extend(text.get_window_extent() for text in figure.axes[0].texts)
        return "<svg/>"

    monkeypatch.setattr(charts, "themed_svg", measured)
    charts.speed_against_error(run_with(times), {name: i for i, name in enumerate(times)})  # type: ignore[arg-type]
    assert len(boxes) == len(times)
    for i, one in enumerate(boxes):
        for other in boxes[i + 1 :]:
            assert min(one.x1, other.x1) - max(one.x0, other.x0) < 1 or min(one.y1, other.y1) - max(one.y0, other.y0) < 2


def test_a_renderer_without_a_mean_is_left_out() -> None:
    run = run_with(TIMES)
    run.summary["speed"]["onefixer"]["ms_per_frame_mean"] = None
    (chart,) = charts.speed_against_error(run, {name: i for i, name in enumerate(TIMES)})  # type: ignore[arg-type]
    assert re.findall(r">onefixer<", chart.svg) == []
