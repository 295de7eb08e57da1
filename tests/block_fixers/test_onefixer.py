"""The streaming session: rollouts, blocks, cameras, previews."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError, RendererError
from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.fixers import make_fixer
from tests.block_fixers.fixer_cases import (
    busy_settings,
    fixer,
    record_videos,
    run_blocks,
    small_settings,
)
from tests.fixers.clip_cases import SIZE, maps_of, moving_picture, pixels

pytestmark = pytest.mark.slow

FRAMES = moving_picture(29)
MAPS = maps_of(FRAMES)


@pytest.fixture(scope="module")
def busy(weights):
    return busy_settings(weights)


@pytest.fixture(scope="module")
def alone(busy):
    """What a rollout of its own makes of the clip."""
    return pixels(run_blocks(fixer(busy), FRAMES, MAPS))


def test_a_session_keeps_both_contracts(busy):
    session = fixer(busy)
    assert isinstance(session, Fixer)
    assert isinstance(session, Fixer)
    out = session.step(FRAMES[:5], MAPS[:5])
    assert [(frame.t_us, frame.camera, frame.rgb.dtype, frame.rgb.shape) for frame in out] == [
        (frame.t_us, frame.camera, np.uint8, (*SIZE, 3)) for frame in FRAMES[:5]
    ]
    assert (
        np.abs(pixels(list(out)).astype(int) - pixels(FRAMES[:5])).mean() > 2
    )  # these weights do something


def test_reset_reproduces_a_rollout_bit_by_bit(busy, alone):
    session = fixer(busy, seed=3)
    other_seed = pixels(run_blocks(session, FRAMES, MAPS))
    session.reset(0)
    assert np.array_equal(pixels(run_blocks(session, FRAMES, MAPS)), alone)
    assert not np.array_equal(other_seed, alone)


def test_noise_follows_scene_seed_and_camera_and_nothing_else(busy, alone):
    assert np.array_equal(pixels(run_blocks(fixer(busy), FRAMES, MAPS)), alone)
    assert not np.array_equal(
        pixels(run_blocks(fixer(busy, scene_id="elsewhere"), FRAMES, MAPS)), alone
    )
    renamed = [replace(frame, camera="rear") for frame in FRAMES]
    assert not np.array_equal(pixels(run_blocks(fixer(busy), renamed, MAPS)), alone)


def test_two_rollouts_interleaved_never_mix(busy, alone):
    frames = moving_picture(29, key="other")
    maps = maps_of(frames)
    other = pixels(run_blocks(fixer(busy, seed=1), frames, maps))
    first = fixer(busy)
    second = fixer(busy, seed=1)
    a = []
    b = []
    for start, end in ((0, 5), (5, 13), (13, 21), (21, 29)):
        a += first.step(FRAMES[start:end], MAPS[start:end])
        second.preview(frames[start:end], maps[start:end])
        b += second.step(frames[start:end], maps[start:end])
    assert np.array_equal(pixels(a), alone)
    assert np.array_equal(pixels(b), other)


@pytest.mark.parametrize("history", ["last-forward", "finalise"])
def test_previews_of_guessed_frames_leave_no_trace(weights, history):
    settings = busy_settings(weights, f"history={history}", "window=4")
    alone = pixels(run_blocks(fixer(settings), FRAMES, MAPS))
    guesses = moving_picture(29, key="guess")
    session = fixer(settings)
    out = []
    for start, end in ((0, 5), (5, 13), (13, 21), (21, 29)):
        for shown in (1, 3):  # poses known so far, then poses guessed
            known = [*FRAMES[start : start + shown], *guesses[start + shown : end]]
            session.preview(known, MAPS[start:end])
        session.preview(FRAMES[start : start + 2], MAPS[start : start + 2])
        out += session.step(FRAMES[start:end], MAPS[start:end])
    assert np.array_equal(pixels(out), alone)


def test_a_step_equal_to_the_last_preview_is_not_computed_again(busy, alone):
    session = fixer(busy)
    videos = record_videos(session)
    out = []
    for start, end in ((0, 5), (5, 13)):
        previewed = session.preview(FRAMES[start:end], MAPS[start:end])
        repeated = session.preview(FRAMES[start:end], MAPS[start:end])
        out += session.step(FRAMES[start:end], MAPS[start:end])
        assert np.array_equal(pixels(list(previewed)), pixels(out[start:]))
        assert np.array_equal(pixels(list(repeated)), pixels(out[start:]))
    assert len(videos) == 2
    assert np.array_equal(pixels(out), alone[:13])
    changed = replace(FRAMES[13], alpha=np.full(SIZE, 0.25, dtype=np.float32))
    session.preview(FRAMES[13:21], MAPS[13:21])
    session.step([changed, *FRAMES[14:21]], MAPS[13:21])
    assert len(videos) == 4, "an opacity alone makes another block"


def test_cameras_in_one_batch_come_out_as_each_alone(busy):
    left = moving_picture(21, key="left", camera="left")
    right = moving_picture(21, key="right", camera="right", holes=False)
    maps = {"left": maps_of(left), "right": maps_of(right)}
    videos = {}
    images = {}
    for name, frames in (("left", left), ("right", right)):
        session = fixer(busy)
        seen = record_videos(session)
        images[name] = pixels(run_blocks(session, frames, maps[name]))
        videos[name] = torch.cat(seen, dim=2)
    session = fixer(busy)
    seen = record_videos(session)
    out = []
    for start, end in ((0, 5), (5, 13), (13, 21)):
        mixed = [
            frame for pair in zip(right[start:end], left[start:end], strict=True) for frame in pair
        ]
        mixed_maps = [
            m
            for pair in zip(maps["right"][start:end], maps["left"][start:end], strict=True)
            for m in pair
        ]
        order = np.argsort([0 if i % 3 else 1 for i in range(len(mixed))], kind="stable")
        answer = session.step([mixed[i] for i in order], [mixed_maps[i] for i in order])
        assert [(f.camera, f.t_us) for f in answer] == [
            (mixed[i].camera, mixed[i].t_us) for i in order
        ]
        out += sorted(answer, key=lambda f: f.t_us)
    together = torch.cat(seen, dim=2)
    for b, name in enumerate(("left", "right")):
        assert (together[b] - videos[name][0]).abs().max() < 1e-5
        mine = pixels([frame for frame in out if frame.camera == name])
        assert np.abs(mine.astype(int) - images[name]).max() <= 1


# --- untrained


def test_an_untrained_fixer_says_so_and_hands_an_opaque_render_through():
    session = make_fixer("onefixer-dit-tiny", small_settings(), scene_id="scene")
    assert not session.trained
    assert session.label == "onefixer-dit-tiny, untrained (identity)"
    frames = moving_picture(21, holes=False)
    out = pixels(run_blocks(session, frames, MAPS))
    assert np.array_equal(out, pixels(frames))


# --- blocks that are refused


def refused(session, block, maps):
    with pytest.raises(InputError):
        session.step(block, maps)


def test_blocks_that_do_not_continue_the_rollout_are_refused(busy):
    session = fixer(busy)
    first = pixels(list(session.step(FRAMES[:5], MAPS[:5])))
    refused(session, [replace(f, camera="rear") for f in FRAMES[5:13]], MAPS[5:13])
    refused(
        session, moving_picture(13, size=(48, 48))[5:], maps_of(moving_picture(8, size=(48, 48)))
    )
    refused(session, FRAMES[5:14], MAPS[5:14])
    out = session.step(FRAMES[5:13], MAPS[5:13])
    again = fixer(busy)
    assert np.array_equal(pixels(list(again.step(FRAMES[:5], MAPS[:5]))), first)
    assert np.array_equal(pixels(list(again.step(FRAMES[5:13], MAPS[5:13]))), pixels(list(out))), (
        "refusals leave no trace"
    )


def test_blocks_that_are_none_are_refused(busy):
    session = fixer(busy)
    refused(session, [], [])
    refused(session, FRAMES[:5], MAPS[:4])
    refused(session, [*FRAMES[:2], replace(FRAMES[2], camera="rear")], [])
    refused(session, [FRAMES[0], FRAMES[0]], [])
    refused(session, [replace(FRAMES[0], rgb=FRAMES[0].rgb.astype(np.float32))], [])
    refused(session, [replace(FRAMES[0], alpha=np.ones((8, 8), dtype=np.float32))], [])
    refused(session, FRAMES[:1], [np.zeros((8, 8, 3), dtype=np.uint8)])


@pytest.mark.parametrize("value", [np.nan, 1.2, -0.1, np.inf])
def test_an_opacity_that_is_none_is_the_renderers_fault(busy, value):
    alpha = np.ones(SIZE, dtype=np.float32)
    alpha[3, 4] = value
    with pytest.raises(RendererError):
        fixer(busy).step([replace(FRAMES[0], alpha=alpha)], MAPS[:1])
