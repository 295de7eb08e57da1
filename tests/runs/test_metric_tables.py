"""What a run says about its metrics travels with its folder: words may change between two runs, the
quantity may not.
"""

import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.run_folder.checksums import state_files
from alpasim_plugin.log.run_folder.manifests import (
    read_run_json,
    write_run_json,
)
from alpasim_plugin.runs.summary import aggregate_runs
from evaluators import resolve_evaluators
from evaluators.metrics import table_of
from evaluators.statistics.opening import read_run

PLUGIN = """
from alpasim_plugin.core.types import MetricInfo
from evaluators import series


class Height:
    metrics = {"height_m": MetricInfo("UNIT", "lower", "max", "HELP", label="ride height", margin=0.3, limits=(0.0, None))}

    def __call__(self, rollout, scene):
        return [series("height_m", rollout.ego.t_us, 1.5)]
"""
# Series that stand for one quantity on purpose, and why.
ALIKE = {
    frozenset(
        ("dist_to_gt_trajectory", "route_distance_m")
    ): "AlpaSim's name reduced by max, the paper's by mean",
    frozenset(
        ("dist_to_gt_trajectory", "lateral_distance_m")
    ): "they part beyond the ends of the recorded path",
    frozenset(
        ("lateral_distance_m", "route_distance_m")
    ): "they part beyond the ends of the recorded path",
    frozenset(
        ("min_distance_to_lane_boundary_m", "offroad_margin_m")
    ): "they part off the road, where AlpaSim's name is zero",
    frozenset(
        ("dist_traveled_m", "ego_x_m")
    ): "the recorded path leads east for most of this drive",
}
LEAST_STEPS = 20
# standard deviation of what one series leaves unexplained of the other, as a share of the other's
SAME = 0.25
ONLY = ("--images", "none", "--no-report", "--workers", "1", "smoke/curve")


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Drive a rollout with a metric of a plug-in, and make runs of it whose plug-in says something
    else about the metric.
    """
    root = tmp_path_factory.mktemp("runs")
    for name, unit, text in (
        ("first", "m", "height"),
        ("words", "m", "height of the roof"),
        ("unit", "ft", "height"),
    ):
        plugin = root / f"{name}.py"
        plugin.write_text(PLUGIN.replace("UNIT", unit).replace("HELP", text))
        if name == "first":
            command = [
                "run",
                "--renderer",
                "clean",
                "--policy",
                "log-replay",
                *ONLY,
                "--evaluator",
                f"{plugin}:Height",
            ]
            assert (
                run_command(
                    [
                        *command,
                        "--out",
                        str(root / name),
                        "--set",
                        "timing.duration_us=1000000",
                        "--json",
                    ]
                )
                == 0
            )
            continue
        shutil.copytree(root / "first", root / name)
        table = table_of(resolve_evaluators([f"{plugin}:Height"]))
        write_run_json(root / name, replace(read_run_json(root / "first"), metrics=dict(table)))
        state_files(root / name, ["run.json"])
    return root


def test_the_same_metric_in_other_words_can_be_compared_and_aggregated(places, capsys):
    first = str(places / "first")
    words = str(places / "words")
    assert run_command(["compare", first, words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["paired"]["clean"]["height_m"]["diff"] == 0.0
    joined = aggregate_runs([Path(first), Path(words)])
    assert joined.metrics["clean"]["height_m"].mean == 1.5
    assert read_run(first).table["height_m"].help == "height"
    assert read_run(words).table["height_m"].help == "height of the roof"


def test_another_unit_under_the_same_name_is_refused(places, capsys):
    first = str(places / "first")
    unit = str(places / "unit")
    assert run_command(["compare", first, unit]) == 2
    assert "metric 'height_m'" in capsys.readouterr().err


def test_what_a_plugin_says_about_its_metric_reaches_the_numbers(places, capsys):
    run = read_run(places / "first")
    assert run_command(["compare", str(run.folder), str(places / "words"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["paired"]["clean"]["height_m"]["margin"] == 0.3
    assert (run.table["height_m"].words, run.table["height_m"].value_range) == (
        "ride height",
        (0.0, np.inf),
    )
    assert run_command(["list", "metrics"]) == 0
    assert "height_m" not in capsys.readouterr().out  # nothing of a run stays behind in the process


@pytest.mark.slow
def test_no_two_series_of_a_run_measure_the_same_quantity_under_two_names(tmp_path):
    root = tmp_path / "run"
    assert (
        run_command(
            [
                "run",
                "--renderer",
                "clean",
                "--policy",
                "lane-camera",
                *ONLY,
                "--out",
                str(root),
                "--set",
                "timing.duration_us=8000000",
                "--json",
            ]
        )
        == 0
    )
    series = {}
    for row in pq.read_table(root / "steps.parquet").to_pylist():
        if row["valid"]:
            series.setdefault(row["metric"], {})[row["t_us"]] = row["value"]
    assert "lateral_bias_m" in series
    alike = {
        frozenset(pair)
        for pair in itertools.combinations(series, 2)
        if _is_same(*(series[name] for name in pair))
    }
    assert alike == set(ALIKE), "give one quantity one name, or say here why it has two"


def _is_same(one, other):
    """Tell whether two series are equal up to a constant or the sign, on the times that both
    have.
    """
    times = sorted(set(one) & set(other))
    a, b = (np.array([values[t] for t in times]) for values in (one, other))
    if len(times) < LEAST_STEPS or min(a.std(), b.std()) < 1e-9:
        return False
    return bool(min((a - b).std(), (a + b).std()) < SAME * max(a.std(), b.std()))
