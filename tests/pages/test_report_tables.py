import re
from dataclasses import replace

from evaluators.pages.fixers import pool_text
from evaluators.pages.html import render_report
from evaluators.pages.tables import metric_rows, pair_rows
from evaluators.pages.terminal import metric_lines
from evaluators.results import Difference, Mean
from evaluators.statistics.numbers import DASH
from evaluators.statistics.opening import NO_SUMMARY, read_run


def entry(mean, **more):
    facts = {
        "mean": mean,
        "ci95": 0.0192,
        "ci95_clustered": (0.01, 0.05),
        "n_rollouts": 300,
        "n_scenes": 60,
        "unit": "",
        "direction": "lower",
    }
    return Mean(**facts | more)


def means_of(**metrics):
    return replace(NO_SUMMARY, metrics=metrics)


def test_rate_is_percent_with_its_count_and_one_interval():
    (row,) = metric_rows(replace(NO_SUMMARY, metrics={"3dgs": {"offroad": entry(7 / 300)}}))
    (cell,) = row.cells
    assert (cell.text, row.unit, row.arrow) == ("2.3", "%", "\u2193")
    assert cell.detail == "7/300 (1.0 to 5.0\u202f%)"
    assert "300\u00a0rollouts, 60\u00a0scenes" in cell.note


def test_missing_mean_is_a_dash_with_its_reason_never_zero():
    summary = means_of(
        a={"offroad": entry(None, reason="valid in none of 4 rollouts")},
        b={"lateral_distance_m": entry(0.0, unit="m")},
    )
    offroad, distance = metric_rows(summary, {("a", "offroad"): "the map has no edges"})
    assert offroad.cells[0].text == DASH
    assert offroad.cells[0].note == "the map has no edges"
    assert offroad.cells[1].text == DASH
    assert offroad.cells[1].note == "not computed for this renderer"
    assert distance.cells[0].missing
    assert distance.cells[1].text == "0.000"


def test_one_rollout_has_a_mean_and_says_why_it_has_no_interval():
    one = entry(
        0.4,
        unit="m",
        ci95=None,
        ci95_clustered=None,
        n_rollouts=1,
        n_scenes=1,
        ci95_reason="one rollout has no spread",
    )
    (row,) = metric_rows(means_of(a={"lateral_distance_m": one}))
    assert row.cells[0].text == "0.400"
    assert row.cells[0].detail == DASH
    assert "no interval over scenes" in row.cells[0].note


def test_no_event_says_which_rates_are_excluded_and_which_not():
    none = entry(0.0, ci95=0.0, ci95_clustered=(0.0, 0.7076), n_rollouts=3, n_scenes=3)
    (row,) = metric_rows(means_of(a={"offroad": none}))
    assert row.cells[0].detail == "0/3 (0.0 to 70.8\u202f%)"
    assert "no event in 3: only rates above 70.8 % are excluded" in row.cells[0].note


def test_pair_without_shared_cells_keeps_its_reason():
    pair = Difference(
        baseline="clean",
        unit="",
        direction="lower",
        margin=0.02,
        n_cells=0,
        n_scenes=0,
        n_missing=3,
        reason="no shared cell",
    )
    (row,) = pair_rows([("3dgs", {"offroad": pair})])
    assert row.diff.missing
    assert row.p_value.note == "no shared cell"
    assert row.verdict == "undecided"


def test_speed_and_what_numbers_leave_out_are_on_the_page(usual_run):
    run = read_run(usual_run)
    assert pool_text(run.summary.pool).startswith(
        "2\u00a0workers with 1\u00a0thread each, 41.2 camera frames/s in total"
    )
    page = render_report(run)
    stages = re.findall(r'<tr><th scope="row">(\w+)</th>', page[page.index('id="table-stages"') :])
    assert stages[:5] == ["render", "policy", "log", "control", "actors"]
    ledger = page[page.index('id="table-ledger"') : page.index('id="provenance"')]
    assert "0.0 to 8.3\u00a0%" in ledger
    assert '<span class="detail">renderer 1</span>' in ledger


def test_the_terminal_prints_means_intervals_and_counts_and_breaks_no_name(
    usual_run,
):
    lines = metric_lines(read_run(usual_run).summary)
    assert sum(line.startswith("  ") for line in lines) == 14 * 6
    assert "offroad (%, lower is better)" in lines
    assert "lateral_distance_m (lower is better)" in lines
    offroad = lines[lines.index("offroad (%, lower is better)") + 1]
    assert re.fullmatch(
        r"  clean/lane-camera\s+[\d.]+  \d+/12 \([\d.]+ to [\d.]+\u202f%\)", offroad
    )
    assert metric_lines(NO_SUMMARY) == []
