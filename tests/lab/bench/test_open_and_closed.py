"""What of the open loop goes with what of the closed loop, on worlds made by hand and on a drive."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from alpasim_plugin.core.parts import resolve
from alpasim_plugin.lab.bench.open_and_closed import (
    OUTCOMES,
    PREDICTORS,
    apart_m,
    correlation_rows,
    measure_scene,
)
from alpasim_plugin.lab.bench.real import Judges
from alpasim_plugin.runs.renderer import make_renderer
from scenarios.load import load_scenario

RENDERERS = ("3dgs", "onefixer")


def world(n_scenes, gap, psnr, apart):
    """Return units of scenes; what is measured is a function of the number of the unit."""
    numbers = range(len(RENDERERS) * n_scenes)
    return [
        {
            "scene": f"s{number // len(RENDERERS)}",
            "policy": "p",
            "renderer": RENDERERS[number % len(RENDERERS)],
            "lateral_2s_m": gap(number),
            "along_2s_m": 1.0,
            "brakes_in_one": 0.0,
            "psnr_db": psnr(number),
            "perceptual_syn": gap(number),
            "cvvdp_jod": None,
            "drive_apart_m": apart(number),
            "outcome_changed": 0.0,
        }
        for number in numbers
    ]


def row_of(rows, predictor, outcome="drive_apart_m"):
    (row,) = [row for row in rows if (row["predictor"], row["outcome"]) == (predictor, outcome)]
    return row


def test_each_policy_outcome_and_predictor_has_a_row():
    units = world(7, float, float, float)
    units += [{**unit, "policy": "q"} for unit in units]
    rows = correlation_rows(units)
    assert len(rows) == 2 * len(PREDICTORS) * len(OUTCOMES)
    assert {row["scenes"] for row in rows if row["predictor"] != "cvvdp_jod"} == {7}


def test_a_gap_that_orders_the_drives_beats_a_psnr_that_does_not():
    rng = np.random.default_rng(0)
    noise = rng.permutation(40)
    rows = correlation_rows(world(20, float, lambda number: float(noise[number]), np.exp))
    gap = row_of(rows, "lateral_2s_m")
    assert gap["spearman"] == 1.0
    assert gap["minus_psnr"] == pytest.approx(1.0, abs=0.4)
    assert gap["minus_psnr_ci95"][0] > 0.0
    low, high = row_of(rows, "psnr_db")["spearman_ci95"]
    assert low < 0.0 < high


def test_a_higher_psnr_counts_as_a_better_image():
    rows = correlation_rows(world(8, float, lambda number: -float(number), float))
    assert row_of(rows, "psnr_db")["spearman"] == 1.0
    assert row_of(rows, "lateral_2s_m")["minus_psnr"] == 0.0
    assert row_of(rows, "psnr_db")["minus_psnr"] is None


def test_what_is_equal_everywhere_or_was_not_measured_has_no_coefficient():
    rows = correlation_rows(world(8, float, float, float))
    assert row_of(rows, "along_2s_m")["spearman"] is None
    assert row_of(rows, "lateral_2s_m", "outcome_changed")["spearman"] is None
    assert row_of(rows, "lateral_2s_m", "outcome_changed")["changed"] == 0
    jod = row_of(rows, "cvvdp_jod")
    assert (jod["spearman"], jod["scenes"], jod["units"]) == (None, 0, 0)


def test_few_scenes_have_a_coefficient_and_no_interval():
    rng = np.random.default_rng(1)
    noise = rng.normal(size=10)
    rows = correlation_rows(world(5, float, float, lambda number: number + 3 * noise[number]))
    row = row_of(rows, "lateral_2s_m")
    assert 0.0 < row["spearman"] < 1.0
    assert row["spearman_ci95"] is None


def test_drives_are_compared_at_the_times_that_both_have():
    def drive(t_us, x_m):
        xyz = np.array([[x, 0.0, 5.0 * x] for x in x_m])
        return SimpleNamespace(ego=SimpleNamespace(t_us=np.array(t_us), xyz=xyz))

    short = drive([0, 100], [0.0, 1.0])
    long = drive([0, 100, 200], [0.0, 4.0, 90.0])
    assert apart_m(short, long) == apart_m(long, short) == pytest.approx(1.5)
    assert apart_m(short, short) == 0.0


class Level:
    """Judge images by their mean level."""

    def distance(self, a, b):
        return (a - b).mean(dim=(1, 2, 3)).abs()


@pytest.mark.slow
def test_a_renderer_that_equals_the_truth_moves_neither_plans_nor_drives():
    scenario = load_scenario("smoke/curve")
    makers = {
        name: partial(make_renderer, renderer, scenario, 0)
        for name, renderer in (("clean", "clean"), ("same", "clean"), ("shifted", "broken-shifted"))
    }
    policies = [resolve("policy", "lane-camera")]
    rows = measure_scene(scenario, makers, policies, Judges(Level(), None), 0)
    same, other = rows
    assert [row["renderer"] for row in rows] == ["same", "shifted"]
    assert same["lateral_2s_m"] == same["along_2s_m"] == same["drive_apart_m"] == 0.0
    assert same["psnr_db"] == 100.0
    assert same["outcome_changed"] == 0.0
    assert other["lateral_2s_m"] > 0.0
    assert other["drive_apart_m"] > 0.05
    assert other["psnr_db"] < 40.0
