"""Recorded videos as sequences: two parts that do not meet, and damage that holes, blurs and moves
along.
"""

import cv2
import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.training.video_damage import SplatDamage, damage_video
from alpasim_plugin.lab.training.video_pairs import (
    HELD_OUT,
    TRAIN,
    VideoRecipe,
    make_video_pairs,
    split_frames,
)
from alpasim_plugin.log.video import read_mp4, write_mp4

MILD = SplatDamage(2.5, 0.75, 0.3, 0.0, 0.0, 0.0, 0, 60.0, 0.0)


def moving(frames, step_px=2, height=48, width=80):
    """Return a smooth pattern that moves to the left."""
    rng = np.random.default_rng(0)
    wide = cv2.resize(
        rng.random((8, 40, 3)).astype(np.float32),
        (width * 4, height),
        interpolation=cv2.INTER_CUBIC,
    )
    wide = np.clip(wide * 255, 0, 255).astype(np.uint8)
    return np.stack([wide[:, i * step_px : i * step_px + width] for i in range(frames)])


def damaged(frames, damage, seed=0):
    images, opacities = zip(*damage_video(frames, damage, np.random.default_rng(seed)), strict=True)
    return np.stack(images), np.stack(opacities)


def test_damage_is_that_of_a_poor_reconstruction():
    frames = moving(6)
    images, opacity = damaged(frames, MILD)
    errors_db = [psnr_db(a, b) for a, b in zip(images, frames, strict=True)]
    assert min(errors_db) > 14
    assert max(errors_db) < 32
    assert opacity.mean() > 200
    coarse, _ = damaged(frames, SplatDamage(6.0, 0.75, 0.3, 0.0, 0.0, 0.0, 0, 60.0, 0.0))
    assert psnr_db(coarse[0], frames[0]) < errors_db[0]


def test_holes_are_where_opacity_is_low_and_show_what_is_behind():
    bright = np.full((4, 48, 80, 3), 200, dtype=np.uint8)
    holed = SplatDamage(2.5, 0.75, 0.2, 0.0, 0.0, 0.25, 0, 60.0, 0.0)
    for seed in range(12):
        images, opacity = damaged(bright, holed, seed)
        if images[0].min() < 60:  # black is behind, not the colour above
            break
    assert 0.05 < (opacity < 128).mean() < 0.4
    assert (opacity < 40).any()
    error = 200 - images.astype(float).mean(axis=-1)
    assert error[opacity < 60].mean() > 130
    assert error[opacity > 240].mean() < 20
    whole = damaged(bright, MILD)[1]
    assert (whole < 128).mean() < 0.02


def test_parts_of_a_video_do_not_meet():
    for count in (20, 30, 221):
        parts = split_frames(count, VideoRecipe())
        assert parts[TRAIN].stop < parts[HELD_OUT].start
        assert parts[HELD_OUT].stop == count
    with pytest.raises(InputError):
        split_frames(1, VideoRecipe())


def test_command_writes_both_parts_once_with_the_frames_of_the_video(tmp_path):
    source = tmp_path / "drive.mp4"
    out = tmp_path / "video"
    write_mp4(source, moving(20), 10)
    command = [
        "train",
        "pairs",
        str(source),
        "--out",
        str(out),
        "--size",
        "64x32",
        "--variants",
        "2",
    ]
    assert run_command(command) == 0
    frames = read_mp4(source).frames
    for split, first, count in ((TRAIN, 0, 14), (HELD_OUT, 15, 5)):
        sequences = PairDataset(out, split).sequences
        assert len(sequences) == 2
        inputs = [s.clip.rgb_input[0] for s in sequences]
        assert not np.array_equal(*inputs)
        for sequence in sequences:
            clip = sequence.clip
            assert clip.rgb_gt.shape == (count, 32, 64, 3)
            wanted = cv2.resize(frames[first], (64, 38), interpolation=cv2.INTER_AREA)[3:35]
            np.testing.assert_array_equal(clip.rgb_gt[0], wanted)
            assert not clip.sdmap.any()
            assert np.isnan(clip.T_world_camera).all()
            assert sequence.info["first_frame"] == first
    made = (out / TRAIN / sequences[0].name / "sequence.json").stat().st_mtime_ns
    assert run_command(command) == 0
    assert (out / TRAIN / sequences[0].name / "sequence.json").stat().st_mtime_ns == made
    assert list(make_video_pairs(source, out, VideoRecipe((64, 32)))) == [
        (folder, False)
        for folder in sorted([*(out / TRAIN).iterdir()]) + sorted([*(out / HELD_OUT).iterdir()])
    ]
