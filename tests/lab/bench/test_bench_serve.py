"""The load bench: its numbers come from real calls, and a soak stays within its memory."""

from __future__ import annotations

import pytest

from alpasim_plugin.alpasim.server.assembly import Settings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.serve import bench_serve, soak
from alpasim_plugin.lab.cli.bench_serve import parse_counts


def test_answers_under_load_equal_those_alone(overrides: list[str]) -> None:
    rows = bench_serve(Settings(overrides=overrides, threads=1), [1, 3], 6, (48, 32))
    assert [(row.rollouts, row.unequal) for row in rows] == [(1, 0), (3, 0)]
    assert all(
        0 < row.p50_ms <= row.p95_ms <= row.p99_ms and row.requests_per_s > 0 for row in rows
    )


@pytest.mark.slow
def test_a_soak_keeps_to_its_memory(overrides: list[str]) -> None:
    row = soak(Settings(overrides=overrides, threads=1, history_bytes=1 << 20), 160, (48, 32))
    assert (row.failed, row.frames) == (0, 160)
    assert 0 < row.history_max_mb <= 1.0


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_ten_thousand_frames_at_constant_memory(overrides: list[str]) -> None:
    row = soak(Settings(overrides=overrides, threads=1, history_bytes=8 << 20), 10_000, (48, 32))
    assert (row.failed, row.frames) == (0, 10_000)
    assert row.history_max_mb <= 8.0
    assert row.resident_last_mb < row.resident_first_mb + 16
    assert row.files_grown <= 2
    assert row.threads_grown <= 2


def test_numbers_of_rollouts_are_checked() -> None:
    assert parse_counts("1, 4,16") == [1, 4, 16]
    for text in ("1,x", "0", "", "1000"):
        with pytest.raises(InputError, match="no numbers from 1 to 256"):
            parse_counts(text)
