"""The steps of a drive through a reconstruction that lie beyond what was compared with photographs."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from alpasim_plugin.core.types import MeasuredRange
from evaluators.metrics.score import score
from evaluators.pages.measured import measured_cautions
from evaluators.results import Failures, Mean, Summary
from evaluators.statistics.cause import beyond_sentences
from tests.evaluators.eval_build import TWO_LANES, by_name, rollout, scene, track

NAME = "beyond_measured_share"
PATH = track(np.arange(11.0), 0.0)


def beyond(ego, measured, preset="strict"):
    log = rollout(ego, log=PATH)
    where = replace(scene(TWO_LANES, log), measured=measured)
    return by_name(score(log, where, preset)).get(NAME)


def test_a_built_scene_and_presets_that_copy_tables_have_no_such_metric():
    assert beyond(PATH, None) is None
    assert beyond(PATH, MeasuredRange(0.5, 0.0, 9), "alpasim") is None


@pytest.mark.parametrize(
    ("aside_m", "measured_m", "is_beyond"),
    [
        (0.2, 0.0, False),  # counts as on the path
        (0.3, 0.0, True),
        (0.5, 0.54, False),
        (-0.5, 0.54, False),
        (0.6, 0.54, True),
        (-0.6, 0.54, True),
    ],
)
def test_a_step_beside_the_path_is_beyond_from_the_farthest_camera_on(
    aside_m, measured_m, is_beyond
):
    series = beyond(track(np.arange(11.0), aside_m), MeasuredRange(measured_m, 0.0, 9))
    assert series.value.tolist() == [float(is_beyond)] * 11
    assert series.valid.all()


@pytest.mark.parametrize(
    ("turned_deg", "measured_deg", "is_beyond"),
    [(4.0, 0.0, False), (6.0, 0.0, True), (-6.0, 0.0, True), (40.0, 45.0, False)],
)
def test_a_turned_car_is_beyond_from_five_degrees_on(turned_deg, measured_deg, is_beyond):
    ego = track(np.arange(11.0), 0.0, yaw=np.radians(turned_deg))
    # The box centre, which is what is compared, lies ahead of the rear axle that turns.
    series = beyond(ego, MeasuredRange(5.0, measured_deg, 9))
    assert series.value.tolist() == [float(is_beyond)] * 11


def test_who_drives_past_the_end_of_the_recording_is_beyond():
    ego = track(np.arange(0.0, 22.0, 2.0), 0.0)
    series = beyond(ego, MeasuredRange(0.0, 0.0, 9))
    assert series.value.tolist() == [0.0] * 6 + [1.0] * 5


def test_where_nothing_was_compared_every_step_is_beyond():
    assert beyond(PATH, MeasuredRange(0.0, 0.0, 0)).value.tolist() == [1.0] * 11


def test_a_recording_that_stands_in_between_has_one_heading_there():
    x = np.array([0.0, 1.0, 2.0, 2.0, 2.0, 3.0, 4.0])
    log = rollout(track(x, 0.0), log=track(x, 0.0))
    where = replace(scene(TWO_LANES, log), measured=MeasuredRange(0.0, 0.0, 9))
    assert by_name(score(log, where))[NAME].value.tolist() == [0.0] * 7


def summary_of(share):
    mean = Mean(
        mean=share,
        ci95=None,
        ci95_clustered=None,
        n_rollouts=3,
        n_scenes=3,
        unit="",
        direction="lower",
    )
    return Summary("strict", {"3dgs": {NAME: mean}}, {}, {}, {}, Failures(3, 0, {}))


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.31, "3dgs: 31 % of its steps"), (0.002, "3dgs: less than 1 % of its steps")],
)
def test_the_first_screen_says_the_share(share, text):
    (caution,) = measured_cautions(summary_of(share))
    assert caution.startswith(text)


@pytest.mark.parametrize("share", [0.0, None])
def test_the_first_screen_says_nothing_where_nothing_is_beyond(share):
    assert measured_cautions(summary_of(share)) == []


def steps(flags):
    t_us = [100_000 * number for number in range(len(flags))]
    columns = {
        "metric": [NAME] * len(flags),
        "t_us": t_us,
        "value": flags,
        "valid": [True] * len(flags),
    }
    others = {"metric": ["progress"], "t_us": [0], "value": [1.0], "valid": [True]}
    other_rows = pa.table(others)
    return pa.concat_tables([other_rows, pa.table(columns, schema=other_rows.schema)])


@pytest.mark.parametrize(
    ("flags", "failed_us", "since_s"),
    [
        ([0.0, 1.0, 0.0, 1.0, 1.0, 0.0], 440_000, "0.1"),
        ([1.0, 1.0, 1.0], 200_000, "0.2"),
        ([0.0, 0.0, 1.0], 200_000, "0.0"),
    ],
)
def test_a_cause_says_since_when_nothing_was_compared(flags, failed_us, since_s):
    (sentence,) = beyond_sentences(steps(flags), failed_us)
    assert f"the last {since_s} s before" in sentence


def test_a_cause_says_nothing_where_the_failure_lies_within():
    assert beyond_sentences(steps([1.0, 1.0, 0.0]), 250_000) == []
    assert beyond_sentences(steps([]), 250_000) == []
