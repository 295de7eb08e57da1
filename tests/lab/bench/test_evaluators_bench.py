"""The bench of the evaluators: its three ways agree, and it says so in numbers that can fail."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.lab.bench import evaluators as bench
from alpasim_plugin.lab.bench.aggregation import bench_table, compared, write_random_table
from alpasim_plugin.lab.bench.evaluators import bench_evaluators, contacts_per_step
from evaluators import aggregate
from evaluators.metrics.presets import PRESETS
from evaluators.metrics.reference import busy_road


def test_all_three_ways_agree_on_a_small_world_with_contacts_and_departures():
    contact, road = bench_evaluators(actors=(16,), steps=(50,), repeats=1)
    assert (contact.part, contact.actors, contact.steps, contact.reference_steps) == (
        "contact",
        16,
        50,
        50,
    )
    assert contact.hits > 0
    assert (contact.differ_per_step, contact.differ_reference) == (0, 0)
    assert contact.gap_error_m < 1e-12
    assert contact.ratio > 0  # how large is the machine's matter
    assert (road.part, road.differ_per_step, road.differ_reference) == ("road", 0, 0)
    assert 0 < road.hits < 50
    assert road.gap_error_m < 1e-9


def test_a_wrong_answer_is_counted(monkeypatch):
    def shifted(log, preset):
        sides, gap_m = contacts_per_step(log, preset)
        return [{**one, "a0": "rear"} for one in sides], gap_m + 1e-3

    monkeypatch.setattr(bench, "contacts_per_step", shifted)
    row = bench_evaluators(actors=(2,), steps=(20,), repeats=1, reference=False)[0]
    assert row.differ_per_step >= 19
    assert np.isclose(row.gap_error_m, 1e-3)
    assert row.differ_reference is None


def test_the_search_step_by_step_sees_what_touches():
    log, _ = busy_road(16, 50)
    sides, gap_m = contacts_per_step(log, PRESETS["paper"])
    assert [bool(one) for one in sides] == [gap == 0 for gap in gap_m]


@pytest.mark.slow
def test_a_table_of_many_rollouts_is_aggregated_right():
    row = bench_table(rollouts=2_000, scenes=50)
    assert (row.rollouts, row.scenes, row.count_errors) == (2_000, 50, 0)
    assert row.mean_error < 1e-12
    assert row.read_s + row.aggregate_s < 5


def test_a_wrong_mean_or_count_in_a_table_is_seen(tmp_path):
    path = tmp_path / "rollouts.parquet"
    write_random_table(path, 400, 10)
    found = aggregate(pq.read_table(path).to_pylist())
    assert compared(found, path) == (pytest.approx(0.0, abs=1e-12), 0)
    found["3dgs"]["offroad"] |= {"mean": found["3dgs"]["offroad"]["mean"] + 0.1, "n_rollouts": 3}
    error, wrong = compared(found, path)
    assert error > 0.1
    assert wrong == 1


@pytest.mark.slow
@pytest.mark.parametrize("scenes", [100, 1_000, 50_000])
def test_a_hundred_thousand_rollouts_take_less_than_ten_seconds_and_two_gigabytes(scenes):
    row = bench_table(rollouts=100_000, scenes=scenes)
    assert row.read_s + row.aggregate_s < 10.0
    assert row.peak_mb < 2_000
    assert row.count_errors == 0
    assert row.mean_error < 1e-9
