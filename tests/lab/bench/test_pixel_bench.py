"""The bench of the per-frame generator: every setting against float32, and cameras in a batch as
one alone.
"""

from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.bench.fixer_rows import BenchOptions, Row
from alpasim_plugin.lab.bench.fixer_table import cells, markdown
from alpasim_plugin.lab.bench.pixel_fixer import CASES, bench_clip
from tests.lab.bench.small_clip import driving_clip

SMALL = ("weights.bundle=null", "holes=noise", "generator.widths=[8,8,8]", "untrained=random")


def test_rows_have_times_and_errors_that_mean_something() -> None:
    settings = fixer_settings("onefixer", SMALL)
    assert isinstance(settings, PixelFixerSettings)
    seen: list[Row] = []
    rows = bench_clip(
        BenchOptions("onefixer", SMALL, threads=1, passes=1),
        settings,
        driving_clip(5, 64, 48),
        seen.append,
        own_process=False,
    )
    assert rows == seen
    assert [row.name for row in rows] == [case.name for case in CASES]
    made = {row.name: row for row in rows}
    assert made["float32"].rounding == (0.0, 0, None)
    assert all(row.problem == "" and row.frames == 5 and row.ms["all-in"][0] > 0 for row in rows)
    half, holes = made["bfloat16"].rounding, made["render in the holes"]
    assert half is not None
    assert half[1] <= 2  # grey levels
    assert holes.rounding is not None
    assert holes.rounding[1] == 0
    assert holes.model is not None
    assert holes.model[1] > 0
    together = made["three in a batch"].rounding
    assert together is not None
    assert together[1] <= 1
    assert cells(made["float32"])[0] == "precision: float32"
    assert "cameras: three in a batch" in markdown(rows)
