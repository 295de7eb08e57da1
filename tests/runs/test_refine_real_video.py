"""Real driving videos through the fixer: a freeway at its own rate, a street with the map video of
the same camera beside it.
"""

import json
from fractions import Fraction

import cv2
import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.video import VideoReader, VideoWriter

FREEWAY = "udacity/solidWhiteRight.mp4"
STREET = "cosmos-transfer/posttrain/{}/ftheta_camera_front_wide_120fov/av_002b815b-7595-4d54-a9f4-4c62c83d3009_0.mp4"


def small(source, to, size, frames):
    """Copy the first frames at a smaller size, times and colours kept."""
    with (
        VideoReader(source) as video,
        VideoWriter(to, video.format.time_base, Fraction(25), video.format.colour) as out,
    ):
        for timed, _ in zip(video, range(frames), strict=False):
            out.write(
                np.asarray(cv2.resize(timed.image, size, interpolation=cv2.INTER_AREA)),
                timed.time,
                timed.duration,
            )
    return to


def refine(capsys, *arguments):
    untrained = ["--set", "fixer.weights.bundle=null", "--set", "fixer.holes=render"]
    assert run_command(["refine", *map(str, arguments), *untrained, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    return document


def test_a_street_with_its_map_video(shared_data, tmp_path, capsys):
    source = small(shared_data / STREET.format("videos"), tmp_path / "in.mp4", (128, 72), 13)
    maps = small(
        shared_data / STREET.format("control_input_hdmap_bbox"), tmp_path / "map.mp4", (128, 72), 13
    )
    options = ("--set", "fixer.untrained=random")  # an identity does not look at the map
    with_map = refine(capsys, source, "--sdmap", maps, "-o", tmp_path / "with.mp4", *options)
    without = refine(capsys, source, "-o", tmp_path / "without.mp4", *options)
    assert with_map["frames"] == without["frames"] == 13
    assert with_map["mean_levels"] != without["mean_levels"]


@pytest.mark.slow
def test_the_whole_freeway_at_its_own_size(shared_data, tmp_path, capsys):
    summary = refine(capsys, shared_data / FREEWAY, "-o", tmp_path / "out.mp4")
    assert (summary["frames"], summary["width"], summary["height"]) == (221, 960, 540)
    assert summary["events"] == {}
    with VideoReader(shared_data / FREEWAY) as before, VideoReader(tmp_path / "out.mp4") as after:
        assert [f.time * before.format.time_base for f in before] == [
            f.time * after.format.time_base for f in after
        ]
        assert before.format.colour == after.format.colour
