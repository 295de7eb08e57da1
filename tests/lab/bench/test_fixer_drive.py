"""The bench's drives: what went into the fixer, what the policy saw, and what it cost, in both
modes of the loop.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.block_fixers.whole_clip import whole_clip
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.lab.bench.fixer_drive import DriveSample, drive
from tests.block_fixers.fixer_cases import SMALL_DIT, small_settings

SCENE = "smoke/straight"
SIZE = (64, 48)


def drive_small(mode: str, frames: int = 13, *overrides: str) -> DriveSample:
    settings = small_settings("untrained=identity", f"mode={mode}", *overrides)
    return drive(SCENE, frames, SIZE, settings, "bench", renderer="clean", threads=1)


def check(sample: DriveSample, frames: int) -> None:
    assert (
        sample.shown.shape == sample.clip.rgb.shape == (len(sample.clip.t_us), SIZE[1], SIZE[0], 3)
    )
    assert len(sample.clip.t_us) >= frames
    assert (np.diff(sample.clip.t_us) == 100_000).all()
    assert sample.clip.maps.any()
    assert len(sample.ms) == (len(sample.clip.t_us) - 5) / 8
    assert {"encode", "dit", "decode", "cache write"} <= set(sample.stages)
    for series in sample.stages.values():
        assert len(series) == len(sample.ms)
    assert all(
        sum(parts) < total
        for parts, total in zip(zip(*sample.stages.values(), strict=True), sample.ms, strict=True)
    )


@pytest.mark.slow
def test_a_drive_in_chunks_shows_the_whole_clips_pictures() -> None:
    sample = drive_small("chunk")
    check(sample, 13)
    exact = whole_clip(small_settings("untrained=identity"), sample.clip, "bench", 0)
    assert np.abs(sample.shown.astype(int) - exact).max() <= 1


@pytest.mark.slow
def test_a_speculative_drive_without_tolerance_shows_them_too_and_hits_less() -> None:
    sample = drive_small("speculative", 13, "tolerance_m=0", "tolerance_deg=0")
    check(sample, 13)
    loose = drive_small("speculative", 13, "tolerance_m=10", "tolerance_deg=90")
    assert loose.facts["hits"] == loose.facts["predicted"] > sample.facts["hits"]
    assert loose.facts["redrafts"] == 0 < sample.facts["redrafts"]


@pytest.mark.slow
def test_nothing_fixed_shows_what_was_rendered() -> None:
    sample = drive(
        SCENE,
        5,
        SIZE,
        fixer_settings("identity", ["mode=chunk", "uses_map=true"]),
        "bench",
        renderer="clean",
        threads=1,
    )
    assert np.array_equal(sample.shown, sample.clip.rgb)
    assert sample.stages == {}


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_bench_prints_a_row_for_every_setting_and_writes_table_and_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = [text for key in SMALL_DIT for text in ("--set", f"fixer.{key}")]
    chosen = ["--quick", "--sizes", "64x48", "--threads", "1", "--only", "precision,mode", *small]
    command = ["bench", "fixer", *chosen, "--out", str(tmp_path / "out"), "--json"]
    assert run_command(command) == 0
    document = json.loads(capsys.readouterr().out)
    rows = {f"{row['group']}: {row['name']}": row for row in document["rows"]}
    assert {row["group"] for row in rows.values()} == {"precision", "mode"}
    assert not any(row["problem"] for row in rows.values())
    assert rows["mode: speculative"]["hit_rate"] > 0
    assert rows["mode: chunk"]["hit_rate"] is None
    assert rows["precision: float32"]["peak_mb"] > 10
    assert (
        rows["precision: float32"]["rounding"][0]
        < 1e-3
        < rows["precision: bfloat16"]["rounding"][0]
    )
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "table.md",
        "rows.json",
        "plot.png",
    }


@pytest.mark.parametrize(
    ("options", "mention"),
    [
        (["--sizes", "256"], "WIDTHxHEIGHT"),
        (["--only", "precison"], "known: precision"),
        (["--set", "window=3"], "fixer.key=value"),
        (["--set", "fixer.windw=3"], "windw"),
        (["--fixer", "identity"], "identity"),
    ],
)
def test_bad_options_of_the_bench_are_four_part_errors(
    options: list[str], mention: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["bench", "fixer", *options]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert mention in error
