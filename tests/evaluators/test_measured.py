"""The steps of a drive through a reconstruction that lie beyond what was compared with photographs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

from alpasim_plugin.core.types import MeasuredRange, PlanRange
from evaluators.metrics.measured import NOT_LOOKED_FOR, OTHER_PARTS, OTHER_SCENE
from evaluators.metrics.score import score
from evaluators.pages.measured import measured_cautions
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


def looked_for(near_to_m, **others):
    return PlanRange("onefixer", "p", near_to_m, **others)


def on_built(ego, entry, renderer="onefixer (trained, 1a2b)", preset="strict", digests=None):
    info = {"versions": {"sensorsim": renderer, "egodriver": "p"}, "digests": digests or {}}
    log = replace(rollout(ego, log=PATH), info=info)
    where = replace(scene(TWO_LANES, log), plan_ranges=(entry,))
    return by_name(score(log, where, preset)).get(NAME)


@pytest.mark.parametrize(
    ("near_to_m", "aside_m", "is_beyond"),
    [(0.5, 0.4, 0.0), (0.5, -0.6, 1.0), (0.0, 0.2, 0.0), (None, 0.0, 1.0)],
)
def test_a_built_scene_is_compared_up_to_where_plans_are_near(near_to_m, aside_m, is_beyond):
    series = on_built(track(np.arange(11.0), aside_m), looked_for(near_to_m))
    assert series.value.tolist() == [is_beyond] * 11


def test_what_clean_shows_of_a_built_scene_is_the_truth_everywhere():
    ego = track(np.arange(11.0), 3.0)
    assert on_built(ego, looked_for(0.5), "clean").value.tolist() == [0.0] * 11


@pytest.mark.parametrize(
    ("entry", "renderer", "reason"),
    [
        (looked_for(0.5), "3dgs", NOT_LOOKED_FOR),
        (looked_for(0.5), "onefixer[references=0] (trained)", NOT_LOOKED_FOR),
        (looked_for(0.5, is_current=False), "onefixer", OTHER_SCENE),
    ],
)
def test_a_range_that_is_not_known_is_no_zero(entry, renderer, reason):
    series = on_built(PATH, entry, renderer)
    assert not series.valid.any()
    assert np.isnan(series.value).all()
    assert series.reason == reason


@pytest.mark.parametrize("service", ["sensorsim", "egodriver"])
def test_a_range_does_not_hold_for_other_weights(service):
    digests = {"sensorsim": "sha256-1", "egodriver": "sha256-2"}
    entry = looked_for(0.5, renderer_digest="sha256-1", policy_digest="sha256-2")
    assert on_built(PATH, entry, digests=digests).valid.all()
    for other in ({**digests, service: "sha256-3"}, {**digests, service: ""}, {}):
        series = on_built(PATH, entry, digests=other)
        assert not series.valid.any()
        assert series.reason == OTHER_PARTS


def test_a_part_without_a_digest_is_known_by_its_name():
    entry = looked_for(0.5, renderer_digest=None, policy_digest=None)
    assert on_built(PATH, entry, digests={"sensorsim": "of its own server"}).valid.all()


def test_a_log_that_does_not_name_its_renderer_has_no_range():
    log = rollout(PATH, log=PATH)
    where = replace(scene(TWO_LANES, log), plan_ranges=(looked_for(0.5),))
    assert by_name(score(log, where))[NAME].reason == NOT_LOOKED_FOR


def run_of(share, scenes, reasons=()):
    mean = SimpleNamespace(mean=share)
    invalid = {NAME: SimpleNamespace(reasons=dict(reasons))}
    summary = SimpleNamespace(
        metrics={"3dgs": {NAME: mean}}, censoring={"3dgs": SimpleNamespace(invalid=invalid)}
    )
    rollouts = [
        SimpleNamespace(scene=name, renderer="3dgs", policy="p", metrics={NAME: share})
        for name in scenes
    ]
    return SimpleNamespace(
        summary=summary, rollouts_of=lambda variant: rollouts, scene_data=scenes.get
    )


def photographed(lateral_m, n_photographs=9):
    measured = {"lateral_m": lateral_m, "turn_deg": 0.0, "n_photographs": n_photographs}
    return {"measured": measured, "plan_ranges": []}


def built(near_to_m):
    entry = {"renderer": "3dgs", "policy": "p", "near_to_m": near_to_m}
    return {"measured": None, "plan_ranges": [entry]}


@pytest.mark.parametrize(
    ("share", "scenes", "text"),
    [
        (0.31, {"a": photographed(0.6)}, "3dgs: 31 % of its steps lie beyond 0.6 m beside"),
        (0.002, {"a": photographed(0.0)}, "3dgs: less than 1 % of its steps lie beyond 0.25 m"),
        (1.0, {"a": photographed(0.0, 0)}, "3dgs: 100 % of its steps lie beyond 0 m beside"),
        (0.5, {"a": photographed(0.54), "b": photographed(1.2)}, "lie beyond 0.54 to 1.2 m beside"),
        (0.5, {"a": built(0.75)}, "lie beyond 0.75 m beside"),
        (0.5, {"a": None}, "lie too far beside the recorded path"),
    ],
)
def test_the_first_screen_says_the_share_and_the_distance(share, scenes, text):
    (caution,) = measured_cautions(run_of(share, scenes))
    assert text in caution
    is_built = any(content and content["plan_ranges"] for content in scenes.values())
    assert ("near those behind clean" in caution) is is_built


def test_the_first_screen_says_what_is_not_known():
    reasons = {OTHER_SCENE: 2, "no row": 1}
    (caution,) = measured_cautions(run_of(None, {"a": built(0.5)}, reasons))
    assert caution.startswith("3dgs, 2\u00a0rollouts: the scene is another one")


@pytest.mark.parametrize("share", [0.0, None])
def test_the_first_screen_says_nothing_where_nothing_is_beyond(share):
    assert measured_cautions(run_of(share, {"a": photographed(0.6)})) == []


def steps(flags):
    t_us = [100_000 * number for number in range(len(flags))]
    columns = {
        "metric": [NAME] * len(flags),
        "t_us": t_us,
        "value": flags,
        "valid": [flag is not None for flag in flags],
        "reason": ["" if flag is not None else "not looked for" for flag in flags],
    }
    others = {"metric": ["progress"], "t_us": [0], "value": [1.0], "valid": [True], "reason": [""]}
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
    (sentence,) = beyond_sentences(steps(flags), failed_us, "where nothing was")
    assert f"the last {since_s} s before" in sentence


def test_a_cause_says_nothing_where_the_failure_lies_within():
    assert beyond_sentences(steps([1.0, 1.0, 0.0]), 250_000, "") == []
    assert beyond_sentences(steps([]), 250_000, "") == []


def test_a_cause_says_where_the_range_is_not_known():
    (sentence,) = beyond_sentences(steps([None, None]), 250_000, "")
    assert "not known: not looked for" in sentence
