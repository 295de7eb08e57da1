from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.metrics import METRICS
from evaluators.opening import Run, read_run
from evaluators.report.charts import _line, forest, speed_against_error
from evaluators.report.strata import strata, strata_chart, stratum_rows
from tests.report.make_run import Plan, make_run

STEP_US = 100_000


def run_of(
    folder: Path,
    rollouts: dict[str, dict[str, list[float]]],
    flags: dict[str, dict[str, float]] | None = None,
) -> Run:
    """Write ``steps.parquet`` of hand-made rollouts, one a scene."""
    rows = []
    for scene, series in rollouts.items():
        key = {"renderer": "clean", "policy": "p", "scene": scene, "seed": 0}
        for metric, values in series.items():
            for k, value in enumerate(values):
                valid = np.isfinite(value)
                row = {
                    "t_us": k * STEP_US,
                    "metric": metric,
                    "value": value if valid else None,
                    "valid": bool(valid),
                    "reason": "",
                }
                rows.append(key | row)
    pq.write_table(pa.Table.from_pylist(rows), folder / "steps.parquet")
    made = tuple(
        Rollout("clean", "p", scene, 0, "ok", metrics=(flags or {}).get(scene, {}))
        for scene in rollouts
    )
    return Run(folder, {"renderers": ["clean"]}, {}, made, ())


def test_steps_are_counted_in_the_range_they_lie_in(tmp_path: Path) -> None:
    offset = [0.0, 0.24, -0.26, 0.49, -0.99, 1.0, 3.0, np.nan]
    (found,) = strata(
        run_of(tmp_path, {"a": {"lateral_bias_m": offset, "eval_relevant": [1.0] * 8}})
    )
    seconds = {s.label: round(s.bins[0].seconds, 6) for s in found.strata}
    assert seconds == {
        "below 0.25\u00a0m": 0.2,
        "0.25 to 0.5\u00a0m": 0.2,
        "0.5 to 1\u00a0m": 0.1,
        "1 to 2\u00a0m": 0.1,
        "2\u00a0m and more": 0.1,
        "not beside the path": 0.1,
    }


def test_warm_up_and_what_follows_an_event_do_not_count_and_the_event_counts_where_it_began(
    tmp_path: Path,
) -> None:
    series = {
        "lateral_bias_m": [0.0, 0.0, 0.0, 0.3, 0.6, 0.6, 0.6],
        "eval_relevant": [0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0],
        "offroad": [1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0],
    }
    (found,) = strata(run_of(tmp_path, {"a": series}, {"a": {"offroad": 1.0}}))
    assert {
        s.label: (round(s.bins[0].seconds, 6), s.bins[0].events["offroad"]) for s in found.strata
    } == {
        "below 0.25\u00a0m": (0.1, 0),
        "0.25 to 0.5\u00a0m": (0.1, 0),
        "0.5 to 1\u00a0m": (0.1, 1),
    }


def test_opacity_is_split_at_the_runs_own_quartiles_and_cameras_are_averaged(
    tmp_path: Path,
) -> None:
    n = 41
    opacity = np.linspace(0.6, 1.0, n)
    run = run_of(
        tmp_path,
        {
            "a": {
                "lateral_bias_m": [0.0] * n,
                "opacity_mean": opacity.tolist(),
                "eval_relevant": [1.0] * n,
            }
        },
    )
    _, found = strata(run)
    assert sorted(round(s.bins[0].seconds, 6) for s in found.strata) == [1.0, 1.0, 1.0, 1.1]
    table = pq.read_table(tmp_path / "steps.parquet").to_pylist()
    second = [
        row | {"value": row["value"] - 0.2} for row in table if row["metric"] == "opacity_mean"
    ]  # another camera of the same times
    pq.write_table(pa.Table.from_pylist(table + second), tmp_path / "steps.parquet")
    _, both = strata(run)
    assert [s.label for s in both.strata] != [s.label for s in found.strata]
    assert both.strata[0].label == "below 0.6"  # the quartile of (a + (a - 0.2)) / 2


def test_means_are_over_scenes_and_have_an_interval_from_three_scenes_on(tmp_path: Path) -> None:
    def drive(value: float, n: int) -> dict[str, list[float]]:
        return {
            "lateral_bias_m": [0.1] * n,
            "eval_relevant": [1.0] * n,
            "plan_deviation": [value] * n,
        }

    two = strata(run_of(tmp_path, {"a": drive(0.1, 10), "b": drive(0.4, 30)}))[0].strata[0].bins[0]
    assert two.means["plan_deviation"] == (pytest.approx(0.25), None, None)
    three = (
        strata(run_of(tmp_path, {"a": drive(0.1, 10), "b": drive(0.4, 30), "c": drive(0.1, 20)}))[0]
        .strata[0]
        .bins[0]
    )
    mean, low, high = three.means["plan_deviation"]
    assert mean == pytest.approx(0.2)
    assert low == 0.0  # the t interval reaches below zero
    assert high is not None
    assert high > 0.4


def test_few_steps_give_a_dash_with_its_reason(tmp_path: Path) -> None:
    run = run_of(
        tmp_path,
        {
            "a": {
                "lateral_bias_m": [0.1] * 9,
                "eval_relevant": [1.0] * 9,
                "plan_deviation": [0.1] * 9,
            }
        },
    )
    row = stratum_rows(strata(run)[0])[0]
    assert row.cells[3].missing
    assert row.cells[3].note == "fewer than 10 steps here have it"


def test_a_run_without_steps_has_no_strata(tmp_path: Path) -> None:
    assert (
        strata(
            Run(tmp_path, {"renderers": ["clean"]}, {}, (Rollout("clean", "p", "a", 0, "ok"),), ())
        )
        == []
    )


def test_charts_compare_renderers_only_where_there_are_two(usual_run: Path, tmp_path: Path) -> None:
    run = read_run(usual_run)
    variants = {variant: i for i, variant in enumerate(run.variants)}
    assert [chart.title for chart in forest(run, variants)] == [
        f"{kind}, against {base}"
        for base in ("clean", "3dgs")
        for kind in ("Rates and shares", "Distances")
    ]
    assert {chart.title for chart in speed_against_error(run, variants)} >= {"lateral distance"}
    alone = read_run(make_run(tmp_path, Plan(renderers=("clean",), seeds=(0,), steps=30)))
    assert forest(alone, {"clean": 0}) == []
    assert speed_against_error(alone, {"clean": 0}) == []


def test_the_forest_turns_metrics_so_that_right_is_worse() -> None:
    entry = {"diff": 0.1, "ci95": [0.05, 0.15], "unit": "", "margin": 0.02}
    pairs = {"progress": entry | {"direction": "higher"}, "offroad": entry | {"direction": "lower"}}
    run = Run(Path(), {"renderers": ["clean", "3dgs"]}, {"paired": {"3dgs": pairs}}, (), ())
    (chart,) = forest(run, {"3dgs": 1})
    assert "worse than the baseline" in chart.svg
    _, better = _line(METRICS["progress"], 1, pairs["progress"])  # type: ignore[misc]
    _, worse = _line(METRICS["offroad"], 1, pairs["offroad"])  # type: ignore[misc]
    assert (better.centre, better.low, better.high, better.margin) == pytest.approx(
        (-10.0, -15.0, -5.0, 2.0)
    )
    assert (worse.centre, worse.low, worse.high) == pytest.approx((10.0, 5.0, 15.0))


def test_chart_labels_keep_their_digits(usual_run: Path) -> None:
    one = strata(read_run(usual_run))[1]
    chart = strata_chart(one)
    assert chart is not None
    assert one.strata[0].label.replace("below ", "") in chart.svg
