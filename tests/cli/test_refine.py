"""``simrun refine`` as a user meets it."""

import json
from fractions import Fraction

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.video import VideoReader, VideoWriter


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "in.mp4"
    with VideoWriter(path, Fraction(1001, 30000), Fraction(30000, 1001)) as video:
        for i in range(7):
            video.write(np.full((36, 64, 3), 30 * i, dtype=np.uint8), i)
    return path


def test_a_video_is_refined_and_the_summary_says_what_was_done(source, capsys):
    out = source.with_name("out.mp4")
    side = source.with_name("side.mp4")
    assert (
        run_command(
            ["refine", str(source), "-o", str(out), "--fixer", "identity", "--compare", str(side)]
        )
        == 0
    )
    captured = capsys.readouterr()
    assert "7 of 64x36 at 29.97 frames per second" in captured.out
    assert "equal, mean 0.00 and at most 0 grey levels" in captured.out
    assert "UNTRAINED" in captured.out
    assert "UNTRAINED" in captured.err
    with VideoReader(out) as video:
        assert video.format.rate == Fraction(30000, 1001)
    with VideoReader(side) as video:
        assert (video.format.width, video.format.height) == (128, 36)


def test_json_is_one_document_with_every_number(source, capsys):
    command = [
        "refine",
        str(source),
        "-o",
        str(source.with_name("out.mp4")),
        "--fixer",
        "identity",
        "--json",
    ]
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
    assert "exists already" in json.loads(capsys.readouterr().out)["error"]["message"]
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
def test_bad_options_are_four_part_errors(source, options, mention, capsys):
    assert (
        run_command(["refine", str(source), "-o", str(source.with_name("out.mp4")), *options]) == 2
    )
    error = capsys.readouterr().err
    assert mention in error
    assert error.startswith("error: ")
    assert not source.with_name("out.mp4").exists()


def pictures(folder, count=3, height=36, channels=3):
    folder.mkdir()
    for i in range(count):
        shape = (height, 64, channels) if channels > 1 else (height, 64)
        noise = np.random.default_rng(i).integers(0, 256, shape, dtype=np.uint8)
        assert cv2.imwrite(str(folder / f"frame_{i:02d}.png"), noise)
    return folder


def test_folders_of_pictures_pass_without_a_codec(tmp_path, capsys):
    source = pictures(tmp_path / "in")
    alpha = pictures(tmp_path / "alpha", channels=1)
    out = tmp_path / "out"
    side = tmp_path / "side"
    command = [
        "refine",
        str(source),
        "-o",
        str(out),
        "--fixer",
        "identity",
        "--opacity",
        str(alpha),
        "--compare",
        str(side),
    ]
    assert run_command(command) == 0
    assert "equal" in capsys.readouterr().out
    assert sorted(file.name for file in out.iterdir()) == [f"frame_{i:02d}.png" for i in range(3)]
    for i in range(3):
        name = f"frame_{i:02d}.png"
        assert np.array_equal(
            cv2.imread(str(out / name)), cv2.imread(str(source / name))
        )  # to the last bit
        assert cv2.imread(str(side / name)).shape == (36, 128, 3)
    assert run_command(command) == 2
    assert "exists already" in capsys.readouterr().err
    assert run_command([*command, "--overwrite"]) == 0


def test_folders_that_make_no_clip_are_refused_and_nothing_is_left(tmp_path, capsys, source):
    good = pictures(tmp_path / "good")
    mixed = pictures(tmp_path / "mixed")
    empty = tmp_path / "empty"
    empty.mkdir()
    assert cv2.imwrite(str(mixed / "frame_01.png"), np.zeros((20, 64, 3), dtype=np.uint8))
    broken = pictures(tmp_path / "broken")
    (broken / "frame_02.png").write_bytes(b"no picture")
    deep = tmp_path / "deep"
    deep.mkdir()
    assert cv2.imwrite(str(deep / "a.png"), np.zeros((36, 64, 3), dtype=np.uint16))
    cases = [
        ([str(empty)], "no .png files"),
        ([str(mixed)], "frame_01.png is 64x20, the first is 64x36"),
        ([str(deep)], "16 bits"),
        ([str(broken)], "frame_02.png"),
        ([str(good), "--opacity", str(source)], "the opacity is a video, the input a folder"),
        ([str(pictures(tmp_path / "clear", channels=4))], "4 channels"),
    ]
    for arguments, mention in cases:
        assert (
            run_command(["refine", *arguments, "-o", str(tmp_path / "out"), "--fixer", "identity"])
            == 2
        )
        assert mention in capsys.readouterr().err
        assert not (tmp_path / "out").exists()


INVERTS = """
from dataclasses import replace

class Inverts:
    trained, label = True, "inverts, trained"

    def reset(self, seed):
        pass

    def step(self, block, maps):
        self.seen = getattr(self, "seen", 0) + len(block)
        return [replace(frame, rgb=255 - frame.rgb) if self.seen > 2 else frame for frame in block]
"""


def test_a_fixer_that_does_not_know_the_video_does_no_damage_and_is_named(tmp_path, capsys):
    (tmp_path / "fixers_of_a_user.py").write_text(INVERTS)
    source = pictures(tmp_path / "in", count=5)
    out = tmp_path / "out"
    command = [
        "refine",
        str(source),
        "-o",
        str(out),
        "--fixer",
        f"{tmp_path}/fixers_of_a_user.py:Inverts",
    ]
    assert run_command(command) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert "inverts, trained changes this video too much for a repair: PSNR" in told
    assert "3 of 5 frames of the result are the input's own" in told
    for file in sorted(source.iterdir()):
        assert_array_equal(cv2.imread(str(out / file.name)), cv2.imread(str(file)))
    assert run_command([*command, "--overwrite", "--anyway"]) == 0
    assert "the fixer changed this video by much (PSNR" in capsys.readouterr().err
    last = cv2.imread(str(source / "frame_04.png"))
    assert_array_equal(cv2.imread(str(out / "frame_04.png")), 255 - last)
