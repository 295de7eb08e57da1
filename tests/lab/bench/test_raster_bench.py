"""Run the bench small: its rows must hold what they claim."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from alpasim_plugin.gaussians import rasterize
from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference
from alpasim_plugin.gaussians.sample_scene import driving_camera, driving_like_scene
from alpasim_plugin.lab.bench.raster import bench_raster


def test_rows_pair_each_time_with_the_error_of_its_image():
    rows = bench_raster(sizes=[(2_000, 1, 64, 36)], repeats=3, threads=(1, 2))
    assert [row.threads for row in rows] == [1, 2]
    for row in rows:
        assert 0 < row.ms_best <= row.ms_p50 <= row.ms_p95
        assert row.visible > 1000
        assert row.pairs > row.visible
        assert row.max_error <= 1 / 255
        assert row.share_above_lsb == 0
        assert row.torch_ms > 0
        assert 0 < row.floor_ms < row.cpu_ms
    assert rows[0].max_error == rows[1].max_error


def test_six_cameras_see_all_around_and_their_work_is_that_of_each():
    (row,) = bench_raster(sizes=[(500, 6, 32, 18)], repeats=3, threads=(1,))
    scene, cameras = (
        driving_like_scene(500),
        [driving_camera(32, 18, k * np.pi / 3) for k in range(6)],
    )
    assert row.blends == sum(
        rasterize_reference(scene, camera).stats["blends"] for camera in cameras
    )
    assert row.visible == sum(
        rasterize(scene, camera, backend="cpu").stats["visible"] for camera in cameras
    )
    assert row.max_error <= 1 / 255
    centre = cameras[1].T_camera_world @ [np.cos(np.pi / 3), np.sin(np.pi / 3), 1.6, 1.0]
    assert centre[:3] == pytest.approx(
        [0, 0, 1], abs=1e-9
    )  # the second looks 60 degrees to the left


def test_scene_depends_on_its_seed_alone_and_covers_the_view():
    a = driving_like_scene(1000, 1)
    b = driving_like_scene(1000, 1)
    c = driving_like_scene(1000, 2)
    assert np.array_equal(a.means, b.means)
    assert not np.array_equal(a.means, c.means)
    assert rasterize(driving_like_scene(20_000), driving_camera(96, 54)).alpha.mean() > 0.9


@pytest.mark.slow
def test_kernels_are_compiled_once_and_then_cached(tmp_path):
    code = (
        "from alpasim_plugin.gaussians.sample_scene import driving_camera, driving_like_scene;"
        "from alpasim_plugin.gaussians import rasterize; rasterize(driving_like_scene(1000), driving_camera(64, 36))"
    )

    def start_s():
        begin = time.perf_counter()
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            check=True,
        )
        return time.perf_counter() - begin

    compiled_s, cached_s = start_s(), start_s()
    assert cached_s < 0.5 * compiled_s
