"""Time per frame, by stage, from what the loop measured."""

import pytest

from alpasim_plugin.runs.summary import speed
from evaluators.results import StageSpeed
from tests.run_records import manifest


def test_time_is_counted_where_it_was_spent():
    draft = {"render": [9.0, 6.0, 2.0, 2.0, 6.0, 2.0], "fix": [30.0, 12.0, 0.0, 0.0, 12.0, 0.0]}
    told = speed([manifest({"frames": 6, "first_call_frames": 1, "stage_ms": draft})])
    assert told.first_frame_ms == 39.0
    assert told.ms_per_frame_p50 == 2.0
    assert told.ms_per_frame_mean == pytest.approx(42.0 / 5)
    assert told.stages["fix"] == StageSpeed(
        p50_ms=12.0, p95_ms=12.0, share=round(24 / 42, 4), per_frame_ms=4.8
    )


def test_every_frame_of_the_first_call_is_kept_apart_from_the_others():
    times = {"render": [100.0, 70.0, 2.0, 4.0], "policy": [0.0, 50.0, 1.0, 1.0]}
    timing = speed([manifest({"frames": 4, "first_call_frames": 2, "stage_ms": times})])
    assert timing.first_frame_ms == 220.0
    assert (timing.ms_per_frame_mean, timing.ms_per_frame_p50) == (4.0, 4.0)
    assert timing.ms_per_frame_p95 <= 5.0


def test_the_frames_of_a_block_share_its_time_and_the_first_block_stands_apart():
    blocks = {"render": [100.0] * 5 + [3.0] * 8, "policy": [50.0, 8.0]}
    told = speed([manifest({"frames": 13, "first_call_frames": 5, "stage_ms": blocks})])
    assert told.stages["render"].p50_ms == 3.0
    assert told.stages["render"].per_frame_ms == 3.0
    assert told.stages["policy"].p50_ms == 8.0
