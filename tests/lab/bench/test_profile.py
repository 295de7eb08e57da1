"""Profiles name functions of ours, with the time of the libraries that they call."""

from __future__ import annotations

import cProfile
import pstats
import time

import numpy as np
import pytest

from alpasim_plugin.lab.bench import profile as module
from alpasim_plugin.lab.bench.profile import profile, shares


def sorts() -> None:
    np.sort(np.random.Generator(np.random.Philox(1)).random(300_000))


def adds() -> None:
    sum(range(1000))


def test_time_in_a_library_counts_for_the_function_that_called_it(monkeypatch):
    monkeypatch.setattr(module, "OURS", (__file__,))
    profiler = cProfile.Profile(time.process_time)

    def both() -> None:
        sorts()
        adds()

    profiler.runcall(both)
    rows = shares("test", pstats.Stats(profiler), 1)
    assert rows[0].where == "bench/test_profile.sorts"
    assert rows[0].share > 0.5
    assert sum(row.share for row in rows) == pytest.approx(1.0)


def test_the_profile_of_the_rasteriser_names_its_kernels(monkeypatch):
    small = module.driving_like_scene(2000)
    monkeypatch.setattr(module, "driving_like_scene", lambda n: small)
    rows = profile("raster", 2)
    assert {"project_parts", "raster_tiles", "depth_order", "fill_tiles", "outside kernels"} <= {
        row.where for row in rows
    }
    assert sum(row.share for row in rows) == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "where"),
    [("loop", "rasterize_cpu"), ("evaluators", "contact.find_contacts"), ("aggregation", "")],
)
def test_the_profile_of_a_part_names_its_own_functions(part, where):
    rows = profile(part, 1)
    assert any(where in row.where for row in rows[:12])
    assert sum(row.share for row in rows) == pytest.approx(1.0)
