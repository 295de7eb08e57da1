"""Claims as comparisons: power before, verdict afterwards, and what the shipped files say."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.paper import tables
from alpasim_plugin.lab.paper.claims import (
    Claim,
    Design,
    Expected,
    claims,
    clip_test,
    decide,
    expected,
    mean_test_power,
    scenes_for_sign_test,
    sign_test_power,
    verdict_of,
)
from alpasim_plugin.lab.paper.config import RAW, system_of
from alpasim_plugin.lab.paper.printed import printed
from alpasim_plugin.lab.paper.records import ClosedLoop, Quality, read_drive_spreads
from alpasim_plugin.lab.training.recipes.registry import RECIPES
from alpasim_plugin.lab.video_metrics.facts import FACTS, SET_TITLES
from evaluators.metrics import METRICS
from evaluators.results import Difference

SCENES = [f"scene-{i}" for i in range(12)]


def record(**rows):
    """Return a record of one metric; a row is its values by scene."""
    return Quality(
        {row: {"psnr_db": dict(zip(SCENES, values, strict=False))} for row, values in rows.items()},
        {},
    )


def simulated_power(spread, margin, scenes, tests, draws=4000):
    """Return how often the reference's sign test of drawn differences is shown."""
    rng = stream("", 0, "tests/power")
    ups = np.sum(rng.normal(margin, spread, (draws, scenes)) > 0, axis=1)
    shown = [
        stats.binomtest(int(up), scenes).pvalue < 0.05 / tests and up > scenes / 2 for up in ups
    ]
    return np.mean(shown)


@pytest.mark.parametrize(
    ("spread", "margin", "scenes", "tests"),
    [(1.0, 0.5, 30, 1), (1.0, 0.5, 30, 8), (0.02, 0.02, 24, 3), (5.0, 0.1, 12, 1)],
)
def test_the_power_is_how_often_the_test_shows_such_a_difference(spread, margin, scenes, tests):
    chance = sign_test_power(spread, margin, scenes, tests)
    assert chance == pytest.approx(simulated_power(spread, margin, scenes, tests), abs=0.03)


def test_power_of_extreme_cases():
    assert sign_test_power(0.0, 0.1, 5, 1) == 0.0  # five scenes cannot reach 5 %
    assert sign_test_power(0.0, 0.1, 6, 1) == 1.0
    assert sign_test_power(0.0, 0.1, 8, 8) == 0.0  # 2 / 2^8 is above 5 % / 8
    assert mean_test_power(0.0, 0.1, 1, 1) == 1.0
    assert scenes_for_sign_test(3, 3, 0, 1) is None


def test_scenes_that_tie_are_scenes_too():
    """With half of the scenes tied, the number that is said shows the difference in four of five."""
    wanted = scenes_for_sign_test(16, 4, 20, 1)
    rng = stream("", 2, "tests/ties")
    signs = rng.choice([1, -1, 0], p=[0.4, 0.1, 0.5], size=(2000, wanted))
    ups, downs = (signs > 0).sum(axis=1), (signs < 0).sum(axis=1)
    shown = [
        stats.binomtest(int(up), int(up + down)).pvalue < 0.05 and up > down
        for up, down in zip(ups, downs, strict=True)
    ]
    assert np.mean(shown) == pytest.approx(0.8, abs=0.08)


def claim(**more):
    facts = {"better": ("V9",), "than": ("V1",), "metrics": ("psnr_db",), **more}
    return Claim(number=1, place="", text="", **facts)


def test_weak_claims_are_left_out_and_say_their_power():
    rng = stream("", 1, "tests/pilot")
    pilot = record(a=rng.normal(0, 0.1, 12), b=rng.normal(0, 0.1, 12))
    design = Design(frozenset({"V9", "V1"}), 24, frozenset(), 0)
    strong = expected(claim(), design, pilot, {}, 0.5)
    assert strong.left_out == ""
    assert strong.power > 0.9
    noisy = record(a=rng.normal(0, 5, 12), b=rng.normal(0, 5, 12))
    weak = expected(claim(), design, noisy, {}, 0.5)
    assert weak.power < 0.5
    assert weak.left_out == f"its power is {100 * weak.power:.0f} %"
    absent = expected(claim(than=("V2",)), design, pilot, {}, 0.5)
    assert absent.left_out == "not among the rows: V2"
    unmeasured = expected(claim(metrics=("dists",)), design, pilot, {}, 0.5)
    assert unmeasured.left_out == "the pilot says no spread of dists"
    assert decide(weak, pilot, ClosedLoop()).verdict is None


def test_claims_about_times_count_the_scenes_of_the_times():
    pilot = Quality(
        {
            "a": {"ms_per_frame": {"x": 1.0, "y": 2.0, "z": 3.0}},
            "b": {"ms_per_frame": {"x": 1.0, "y": 2.1, "z": 2.9}},
        },
        {},
    )
    about_times = claim(metrics=("ms_per_frame",))
    design = Design(frozenset({"V9", "V1"}), 30, frozenset(), 0)
    assert expected(about_times, design, pilot, {}, 0.5).left_out == "times are not measured"
    timed = replace(design, times_scenes=12)
    got = expected(about_times, timed, pilot, {}, 0.5)
    assert got.power == pytest.approx(sign_test_power(0.1, 1.0, 12, 1))


def test_times_come_from_where_all_rows_were_measured_side_by_side():
    hurried = Quality({"V9": {"ms_per_frame": {"x": 1.0}, "psnr_db": {"x": 20.0}}}, {})
    assert hurried.with_times_of(None).by_scene == {"V9": {"psnr_db": {"x": 20.0}}}
    side_by_side = Quality({"V9": {"ms_per_frame": {"x": 9.0}, "psnr_db": {"x": 1.0}}}, {})
    merged = hurried.with_times_of(side_by_side).by_scene["V9"]
    assert merged == {"psnr_db": {"x": 20.0}, "ms_per_frame": {"x": 9.0}}


def test_a_claim_about_drives_needs_a_spread_of_drives(tmp_path):
    path = tmp_path / "compare.json"
    entries = {"route_distance_m": {"spread": 0.3}, "collision_at_fault": {"spread": 0.0}}
    path.write_text(json.dumps({"paired": {"onefixer": entries}}))
    spreads = read_drive_spreads(path)
    assert spreads == {"route_distance_m": 0.3}  # no event says nothing of other scenes
    design = Design(frozenset(), 0, frozenset({"V9", RAW}), 60)
    on_the_road = claim(drive=True, than=(RAW,), metrics=("route_distance_m",))
    got = expected(on_the_road, design, record(), spreads, 0.5)
    assert got.power == pytest.approx(mean_test_power(0.3, 0.1, 60, 1))
    unhurt = claim(drive=True, than=(RAW,), metrics=("collision_percent",))
    got = expected(unhurt, design, record(), spreads, 0.5)
    assert got.left_out == "the pilot says no spread of collision_percent"
    path.write_text("{}")
    with pytest.raises(InputError, match="no paired differences"):
        read_drive_spreads(path)


def test_a_claim_holds_fails_or_stays_open_by_the_signs_of_its_scenes():
    base = np.linspace(20.0, 25.0, 12)
    alternating = base + 0.2 * (-1.0) ** np.arange(12)
    quality = record(V9=base + 0.5, V1=base, V2=base + 0.9, V4=alternating + 0.5)
    verdicts = {
        other: decide(Expected(claim(than=(other,)), 1.0, ""), quality, ClosedLoop()).verdict
        for other in ("V1", "V2", "V4")
    }
    assert verdicts == {"V1": "holds", "V2": "does not hold", "V4": "undecided"}
    both = decide(Expected(claim(than=("V1", "V2")), 1.0, ""), quality, ClosedLoop())
    assert both.verdict == "does not hold"


def test_a_match_grants_the_margin_and_no_more():
    base = np.linspace(20.0, 25.0, 12)
    margin = claims().margins["psnr_db"]
    quality = record(V9=base, near=base + 0.5 * margin, far=base + 1.5 * margin)
    near, far = (clip_test(quality, "V9", other, "psnr_db", True, 1) for other in ("near", "far"))
    assert (near.sign, far.sign) == (1, -1)
    assert near.gain == pytest.approx(-0.5 * margin)
    assert clip_test(quality, "V9", "near", "psnr_db", False, 1).sign == -1


def test_lower_is_better_where_the_paper_says_so():
    values = dict.fromkeys(SCENES, 0.1)
    more = dict.fromkeys(SCENES, 0.2)
    quality = Quality({"V9": {"perceptual-syn": values}, "V2": {"perceptual-syn": more}}, {})
    test = clip_test(quality, "V9", "V2", "lpips", False, 1)
    assert (test.sign, test.metric) == (1, "perceptual-syn")


def test_holms_correction_is_over_the_claims_own_comparisons():
    base = np.zeros(12)
    almost = np.where(np.arange(12) < 10, 1.0, -1.0)  # 10 of 12: p = 0.039
    quality = record(V9=almost, V1=base)
    test = clip_test(quality, "V9", "V1", "psnr_db", False, 1)
    assert verdict_of([test]) == "holds"
    assert verdict_of([test, test]) == "undecided"


def test_a_drive_is_judged_by_the_runs_own_test():
    entry = Difference("3dgs", "", "lower", 0.03, 60, 12, diff=-0.1, p_value=0.01, spread=0.2)
    drive = ClosedLoop({}, {"V9": {"offroad": entry}})
    expectation = Expected(claim(drive=True, than=(RAW,), metrics=("offroad_percent",)), 1.0, "")
    assert decide(expectation, record(), drive).verdict == "holds"
    reverse = Expected(
        claim(drive=True, better=(RAW,), than=("V9",), metrics=("offroad_percent",)), 1.0, ""
    )
    assert decide(reverse, record(), drive).verdict == "does not hold"


def test_all_43_claims_name_rows_and_metrics_that_exist():
    every = claims()
    assert [item.number for item in every.claims] == list(range(1, 44))
    rows = {row for item in every.claims for row in item.rows} - {RAW}
    assert {system_of(row) for row in rows} <= set(RECIPES)
    for item in every.claims:
        assert set(item.metrics) <= set(every.margins) <= set(printed().metrics)


def test_what_stands_in_place_of_the_papers_metrics_can_be_computed():
    ours = {name for facts in printed().metrics.values() for name in facts.ours}
    assert [
        name for name in ours if name not in {*FACTS, *SET_TITLES} and name not in METRICS
    ] == []
    for table in printed().tables.values():
        assert set(table.metrics) <= set(printed().metrics)


@pytest.mark.parametrize(
    ("metric", "value", "text"), [("fvd", 5830.0, "5.83"), ("fvmd", 674.0, "67.4")]
)
def test_distances_of_sets_are_printed_in_the_papers_scale(metric, value, text):
    cell = {"value": value, "metric": metric, "interval": None, "about": {}}
    assert tables._ours(cell, printed().metrics[metric]).startswith(text)
