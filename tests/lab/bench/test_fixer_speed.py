"""Measuring a fixer: whole blocks, stages that add up, memory, and weights that make every layer
count.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import torch

from alpasim_plugin.block_fixers.pipeline import TIMED, StageClock
from alpasim_plugin.block_fixers.stand_in import save_stand_in
from alpasim_plugin.fixers import make_fixer
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.bench.fixer_speed import measure
from tests.block_fixers.fixer_cases import small_settings as settings
from tests.lab.bench.small_clip import driving_clip


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "stand-in.safetensors"
    save_stand_in(path, settings())
    return path


@pytest.mark.parametrize(
    ("frames", "blocks"), [(4, []), (5, [5]), (12, [5]), (13, [5, 8]), (22, [5, 8, 8])]
)
def test_only_whole_blocks_are_given_out(frames: int, blocks: list[int]) -> None:
    clip = driving_clip(frames)
    given = list(clip.blocks(lambda index: 5 if index == 0 else 8))
    assert [len(part) for part, _ in given] == blocks
    assert [frame.t_us for part, _ in given for frame in part] == clip.t_us[: sum(blocks)].tolist()
    assert all(
        np.array_equal(maps, clip.maps[i : i + 1])
        for i, maps in enumerate([m[None] for _, ms in given for m in ms])
    )


def test_a_stage_that_is_entered_twice_adds_up() -> None:
    clock = StageClock()
    for _ in range(2):
        with clock("dit"):
            time.sleep(0.01)
    with clock("encode"):
        pass
    taken = clock.take()
    assert 20 <= taken["dit"] < 500
    assert taken["encode"] < 10
    assert clock.take() == {}


def test_a_measured_run_gives_the_images_of_an_unmeasured_one_and_a_time_per_block(
    stand_in: Path,
) -> None:
    clip, chosen = (
        driving_clip(13, 48, 32),
        settings(f"weights.bundle={stand_in}", "history=finalise"),
    )
    timing = measure(chosen, clip, "scene", seed=3, passes=2)
    fixer = make_fixer(chosen.name, chosen, scene_id="scene", seed=3)
    plain = [
        frame.rgb
        for frames, maps in clip.blocks(fixer.blocks.frames)
        for frame in fixer.step(frames, maps)
    ]
    assert np.array_equal(timing.images, np.stack(plain))
    assert len(timing.all_in) == 2  # one block of steady state, two passes
    assert {name: len(ms) for name, ms in timing.stages.items()} == dict.fromkeys(TIMED, 2)
    assert all(ms > 0 for series in timing.stages.values() for ms in series)
    assert timing.first_ms > 0
    assert timing.load_ms > 0
    if Path("/proc/self/status").exists():
        assert timing.peak_mb is not None
        assert timing.peak_mb > 0


def test_stand_in_weights_follow_their_seed_and_say_that_they_are_untrained(
    stand_in: Path, tmp_path: Path
) -> None:
    save_stand_in(tmp_path / "same.safetensors", settings())
    save_stand_in(tmp_path / "other.safetensors", settings(), seed=1)
    same, first = load_weights(tmp_path / "same.safetensors"), load_weights(stand_in)
    assert same.keys() == first.keys()
    assert all(torch.equal(same[key], first[key]) for key in first)
    other = load_weights(tmp_path / "other.safetensors")
    assert not torch.equal(
        other["dit.final_layer.linear.weight"], first["dit.final_layer.linear.weight"]
    )
    fixer = make_fixer(
        "onefixer-dit-tiny", settings(f"weights.bundle={stand_in}"), scene_id="scene"
    )
    assert not fixer.trained
    assert "random" in fixer.label


def test_stand_in_weights_change_pictures_about_as_a_repair_would(stand_in: Path) -> None:
    clip = driving_clip(5, 48, 32)
    moved = measure(settings(f"weights.bundle={stand_in}"), clip, "scene", passes=1).images
    still = measure(settings("untrained=identity"), clip, "scene", passes=1).images
    change = np.abs(moved.astype(int) - still).mean()
    assert 1 < change < 40
    opaque = clip.alpha == 1
    assert np.abs(still.astype(int) - clip.rgb)[opaque].mean() < 0.5
