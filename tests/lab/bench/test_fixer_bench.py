"""The fixer's bench: the right reference for each row, errors that mean something, settings that
cannot be run, tables and plots.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.block_fixers.stand_in import save_stand_in
from alpasim_plugin.fixers import guard
from alpasim_plugin.lab.bench import fixer as bench
from alpasim_plugin.lab.bench.fixer import BenchOptions, Row, bench_clip, cases, difference
from alpasim_plugin.lab.bench.fixer_table import HEAD, markdown, plot, put_between_marks
from tests.block_fixers.fixer_cases import SMALL_DIT, small_settings
from tests.lab.bench.small_clip import driving_clip

FRAMES = 29  # 8 latents: more than windows of 4 and 6
SIZE = (48, 32)
GROUPS = ("precision", "window")


@pytest.fixture(scope="module")
def rows() -> dict[str, Row]:
    options = BenchOptions(overrides=SMALL_DIT, passes=1, threads=1, only=GROUPS)
    seen: list[Row] = []
    made = bench_clip(options, driving_clip(FRAMES, *SIZE), seen.append, own_process=False)
    assert seen == made
    return {f"{row.group}: {row.name}": row for row in made}


def mean_error(error: tuple[float, int, float | None] | None) -> float:
    assert error is not None
    return error[0]


@pytest.mark.slow
def test_every_setting_of_the_groups_is_measured_at_every_stage(rows: dict[str, Row]) -> None:
    assert list(rows) == [f"{case.group}: {case.name}" for case in cases(8) if case.group in GROUPS]
    for row in rows.values():
        assert row.problem == ""
        assert row.frames == FRAMES
        assert set(row.ms) == {"encode", "dit", "decode", "cache write", "all-in", "cpu"}
        assert all(0 < p50 <= p95 for p50, p95 in row.ms.values())


@pytest.mark.slow
def test_streaming_in_float32_is_the_whole_clip_up_to_rounding(rows: dict[str, Row]) -> None:
    for name, row in rows.items():
        if "float16" not in name:
            assert mean_error(row.rounding) < 1e-3, name
            assert row.rounding is not None
            assert row.rounding[1] <= 1, name  # a value that lies between two grey levels


@pytest.mark.slow
def test_less_precision_is_more_error_and_still_small(rows: dict[str, Row]) -> None:
    error = {
        name: mean_error(rows[f"precision: {name}"].rounding)
        for name in ("float32", "float16", "bfloat16")
    }
    assert error["float32"] < error["float16"] < error["bfloat16"] < 2


@pytest.mark.slow
def test_an_identity_hides_what_precision_costs(rows: dict[str, Row]) -> None:
    assert mean_error(rows["precision: bfloat16, identity"].rounding) < mean_error(
        rows["precision: bfloat16"].rounding
    )


@pytest.mark.slow
def test_a_narrow_window_is_another_model_but_the_whole_one_is_the_base(
    rows: dict[str, Row],
) -> None:
    error = {
        name: mean_error(rows[f"window: {name}"].model)
        for name in ("4 latents", "6 latents", "all")
    }
    assert error["all"] < 1e-3
    assert error["4 latents"] > 10 * error["all"]
    assert error["4 latents"] >= error["6 latents"] > error["all"]


@pytest.mark.slow
def test_other_weights_are_not_compared_with_the_base(rows: dict[str, Row]) -> None:
    assert rows["precision: float32, identity"].model is None
    assert rows["precision: float32, identity"].weights == "identity"
    assert rows["precision: float32"].weights == "stand-in"


def test_a_setting_that_given_weights_cannot_run_says_why(tmp_path: Path) -> None:
    save_stand_in(tmp_path / "w.safetensors", small_settings())
    options = BenchOptions(
        overrides=(*SMALL_DIT, f"weights.bundle={tmp_path / 'w.safetensors'}"),
        passes=1,
        threads=1,
        only=("decoder",),
        quick=True,
    )
    made = {
        f"{row.group}: {row.name}": row
        for row in bench_clip(options, driving_clip(13, *SIZE), own_process=False)
    }
    assert "decoder.kind" in made["decoder: latent only"].problem
    assert made["decoder: latent and render"].weights == "given"
    assert made["decoder: latent and render"].problem == ""
    text = markdown(list(made.values()))
    assert "not measured: " in text


@pytest.mark.slow
def test_a_row_measured_in_its_own_process_gives_the_same_pictures() -> None:
    options = BenchOptions(overrides=SMALL_DIT, passes=1, quick=True, threads=1)
    chosen = small_settings("untrained=random")
    here, apart = (
        bench.measured(options, chosen, driving_clip(13, *SIZE), own_process)
        for own_process in (False, True)
    )
    assert np.array_equal(here.images, apart.images)


def test_frames_that_the_guard_replaced_are_counted_and_left_out_of_the_errors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(guard, "LIMIT", 0.5)  # now an ordinary picture is out of range
    options = BenchOptions(
        overrides=(*SMALL_DIT, "untrained=random"),
        passes=1,
        quick=True,
        threads=1,
        only=("decoder",),
    )
    row = bench_clip(options, driving_clip(5, *SIZE), own_process=False)[0]
    assert row.guarded == row.frames == 5
    assert row.rounding is None
    assert "guard: 5 of 5" in markdown([row])


def test_difference_names_the_largest_and_the_mean() -> None:
    a = np.zeros((2, 4, 4, 3), np.uint8)
    b = a.copy()
    b[1, 0, 0, 0] = 96
    off = difference(a, b)
    assert off is not None
    mean, largest, psnr = off
    assert (mean, largest) == (1.0, 96)
    assert psnr == pytest.approx(10 * np.log10(255**2 * 96 / 96**2))
    assert difference(a, a) == (0.0, 0, None)
    assert difference(a[:0], a[:0]) is None


@pytest.mark.slow
def test_the_table_has_a_line_per_row_and_the_plot_is_a_picture(
    rows: dict[str, Row], tmp_path: Path
) -> None:
    lines = [line for line in markdown(list(rows.values())).splitlines() if line.startswith("| ")]
    assert len(lines) == len(rows) + 1
    assert {line.count("|") for line in lines} == {len(HEAD) + 1}
    plot(list(rows.values()), tmp_path / "plot.png")
    image = cv2.imread(str(tmp_path / "plot.png"))
    assert image is not None
    assert image.std() > 5


def test_only_what_lies_between_the_marks_is_replaced() -> None:
    page = "a\n<!-- bench: table -->\nold\n<!-- bench: end of table -->\nb\n"
    assert put_between_marks(page, "table", "new\n") == page.replace("old", "new")
    with pytest.raises(ValueError, match="no marks"):
        put_between_marks("nothing", "table", "new")
