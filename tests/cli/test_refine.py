"""``simrun refine`` as a user meets it."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.video_reader import VideoReader
from alpasim_plugin.log.video_writer import VideoWriter


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "in.mp4"
    with VideoWriter(path, Fraction(1001, 30000), Fraction(30000, 1001)) as video:
        for i in range(7):
            video.write(np.full((36, 64, 3), 30 * i, np.uint8), i)
    return path


def test_a_video_is_refined_and_the_summary_says_what_was_done(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, side = source.with_name("out.mp4"), source.with_name("side.mp4")
    assert run_command(["refine", str(source), "-o", str(out), "--fixer", "identity", "--compare", str(side)]) == 0
    captured = capsys.readouterr()
    assert "7 of 64x36 at 29.97 frames per second" in captured.out
    assert "equal, mean 0.00 and at most 0 grey levels" in captured.out
    assert "UNTRAINED" in captured.out
    assert "UNTRAINED" in captured.err
    with VideoReader(out) as video:
        assert video.format.rate == Fraction(30000, 1001)
    with VideoReader(side) as video:
        assert (video.format.width, video.format.height) == (128, 36)


def test_json_is_one_document_with_every_number(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["refine", str(source), "-o", str(source.with_name("out.mp4")), "--fixer", "identity", "--json"]
    assert run_command(command) == 0
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert document["frames"] == 7
    assert document["trained"] is False
    assert document["psnr_db"] is None
    assert document["mean_levels"] == 0
    assert document["events"] == {}
    assert captured.err == ""
    assert run_command(command) == 2
    assert "exists already" in json.loads(capsys.readouterr().out)["error"]["found"]
    assert run_command([*command, "--overwrite"]) == 0


@pytest.mark.parametrize(
    ("options", "mention"),
    [
        (["--fixer", "identiy"], "did you mean 'identity'"),
        (["--fixer", "identity", "--set", "window=4"], "write --set fixer.key=value"),
        (["--fixer", "identity", "--set", "fixer.windw=4"], "windw"),
        (["--fixer", "identity", "--opacity", "none.mp4"], "none.mp4"),
    ],
)
def test_bad_options_are_four_part_errors(source: Path, options: list[str], mention: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["refine", str(source), "-o", str(source.with_name("out.mp4")), *options]) == 2
    error = capsys.readouterr().err
    assert mention in error
    assert error.startswith("error: ")
    assert not source.with_name("out.mp4").exists()
