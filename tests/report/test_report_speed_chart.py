"""Speed against error: the time is the mean, and names do not cover each other."""

from __future__ import annotations

import re
from types import SimpleNamespace

import pytest
from matplotlib.textpath import TextPath

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


def test_a_fixer_that_is_free_on_most_frames_stands_where_its_mean_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = []
    monkeypatch.setattr(charts, "_time_axis", lambda axes, ms: drawn.append((axes, ms)))
    charts.speed_against_error(run_with(TIMES), {name: i for i, name in enumerate(TIMES)})  # type: ignore[arg-type]
    (axes, _), *_ = drawn
    assert [float(x[0]) for kind, (x, *_) in axes._drawn if kind == "points"] == [
        mean for mean, _ in TIMES.values()
    ]


@pytest.mark.parametrize(
    "times", [TIMES, dict.fromkeys(TIMES, (30.0, 35.0))], ids=["spread", "all alike"]
)
def test_no_name_covers_another(times: dict[str, tuple[float, float]]) -> None:
    run = run_with(times)
    (chart,) = charts.speed_against_error(run, {name: i for i, name in enumerate(times)})  # type: ignore[arg-type]
    named = re.findall(
        r'<text x="([\d.]+)" y="([\d.]+)" style="fill:var\(--variant[^>]*>([^<]+)<', chart.svg
    )
    assert sorted(name for *_, name in named) == sorted(times)
    boxes = []
    for x, y, name in named:
        box = TextPath(
            (0, 0), name, size=charts.FONT_PT
        ).get_extents()  # the letters of another font than the chart reckons with
        boxes.append((float(x), float(x) + box.width, float(y) - box.height, float(y)))
    for i, one in enumerate(boxes):
        assert one[1] < charts.SIZE_PT[0] + 10
        for other in boxes[i + 1 :]:
            assert (
                min(one[1], other[1]) - max(one[0], other[0]) < 1
                or min(one[3], other[3]) - max(one[2], other[2]) < 2
            )


def test_a_renderer_without_a_mean_is_left_out() -> None:
    run = run_with(TIMES)
    run.summary["speed"]["onefixer"]["ms_per_frame_mean"] = None
    (chart,) = charts.speed_against_error(run, {name: i for i, name in enumerate(TIMES)})  # type: ignore[arg-type]
    assert re.findall(r">onefixer<", chart.svg) == []
