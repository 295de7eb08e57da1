"""Run the bench small: its rows must hold what they claim."""

from __future__ import annotations

import numpy as np
import pytest

from alpasim_plugin.bench.raster import bench_raster, driving_camera, driving_like_scene, format_rows, start_times_ms


def test_rows_pair_each_time_with_the_error_of_its_image():
    rows = bench_raster(sizes=[(2_000, 64, 36)], repeats=3, threads=(1, 2))
    assert [row.threads for row in rows] == [1, 2]
    for row in rows:
        assert 0 < row.ms_best <= row.ms_p50 <= row.ms_p95
        assert row.visible > 1000
        assert row.pairs > row.visible
        assert row.max_error <= 1 / 255
        assert row.share_above_lsb == 0
        assert row.torch_ms > 0
    assert rows[0].max_error == rows[1].max_error
    table = format_rows(rows)
    assert table.count("\n") == 3
    assert "| 2000 | 64x36 | 2 |" in table


def test_error_that_was_not_measured_is_none_and_prints_as_a_dash():
    row = bench_raster(sizes=[(500, 32, 18)], repeats=1, threads=(1,), with_error=False)[0]
    assert row.max_error is None
    assert row.share_above_lsb is None
    assert "| - | - |" in format_rows([row])


def test_scene_depends_on_its_seed_alone_and_covers_the_view():
    a, b, c = driving_like_scene(1000, 1), driving_like_scene(1000, 1), driving_like_scene(1000, 2)
    assert np.array_equal(a.means, b.means)
    assert not np.array_equal(a.means, c.means)
    from alpasim_plugin.gaussians import rasterize

    assert rasterize(driving_like_scene(20_000), driving_camera(96, 54)).alpha.mean() > 0.9


@pytest.mark.slow
def test_kernels_are_compiled_once_and_then_cached():
    cold_ms, cached_ms = start_times_ms()
    assert cached_ms < 0.5 * cold_ms
