"""Run the bench small: its rows must hold what they claim."""

from __future__ import annotations

from alpasim_plugin.lab.bench import raster_gradient as gradient_bench
from alpasim_plugin.lab.bench.raster_gradient import bench_gradients


def test_rows_pair_each_time_with_the_error_of_its_gradients(monkeypatch):
    monkeypatch.setattr(gradient_bench, "_REFERENCE_LIMIT", 300 * 32 * 18)
    rows = bench_gradients(sizes=[(300, 32, 18), (500, 32, 18)], repeats=2)
    assert [(row.n, row.threads) for row in rows] == [(300, 1), (300, 2), (500, 1), (500, 2)]
    for row in rows:
        assert 0 < row.ms_best <= row.ms_p50
        assert row.visible > 150
    assert 0 < rows[0].error == rows[1].error < 1e-3
    assert rows[2].error is None
    assert rows[2].reference_ms is None
