"""Streaming, cached, folded, block by block: the same as the whole clip in one piece."""

import numpy as np
import pytest
import torch

from alpasim_plugin.block_fixers.clips import to_clip
from alpasim_plugin.block_fixers.networks import load_networks
from alpasim_plugin.block_fixers.onefixer import latent_noise
from alpasim_plugin.fixers.views import group_views
from tests.block_fixers.fixer_cases import Recorded, busy_settings, fixer, record_videos, run_blocks
from tests.block_fixers.whole_clip import refine_clip, whole_clip
from tests.examples import first_of
from tests.fixers.clip_cases import maps_of, moving_picture, pixels

CASES = [
    ("steps=[1000,450]", "history=finalise"),
    ("window=4", "sink=1"),
    (),
    ("block_latents=1", "window=3"),
    ("history=finalise",),
    ("steps=[1000,500]",),
    ("window=1",),  # smaller than a block
    ("window=30",),  # never full
    ("block_latents=3", "window=3"),
    ("decoder.kind=latent",),
    ("uses_map=false",),
    ("opacity_input=true",),
    ("opacity_input=true", "history=finalise", "steps=[1000,500]"),
    ("uses_map=false", "no_map=black"),
    ("render_input=true", "holes=everywhere"),
]


@pytest.fixture(scope="module")
def others():
    """What the cases so far came to: were two alike, a test could not tell one choice from
    another.
    """
    return []


@pytest.mark.parametrize("overrides", first_of(CASES, 2), ids=",".join)
def test_blocks_equal_the_whole_clip(weights, others, overrides):
    settings = busy_settings(weights, *overrides)
    frames = moving_picture(29)
    maps = maps_of(frames)
    session = fixer(settings)
    seen = record_videos(session)
    out = pixels(run_blocks(session, frames, maps))
    assert overrides == ("fold=false",) or all(
        np.abs(out.astype(int) - other).max() > 1 for other in others
    )
    others.append(out)

    streamed = torch.cat(seen, dim=2)
    (views,) = group_views(frames, maps if settings.uses_map else [], streamed.shape[2])
    clip = to_clip(views, streamed.shape[2])
    noise = latent_noise(
        "scene",
        0,
        views.cameras,
        session.pipeline.draws,
        range((streamed.shape[2] - 1) // 4 + 1),
        (16, 4, 6),
    )
    exact = load_networks(settings.model_copy(update={"fold": False}))
    whole = refine_clip(exact, settings, clip.rgb, clip.alpha, clip.maps, noise)
    assert (streamed - whole).abs().max() < 1e-5


@pytest.mark.parametrize("count", [1, 6, 13])
def test_any_number_of_frames_and_any_size(weights, count):
    settings = busy_settings(weights)
    frames = moving_picture(count, size=(29, 50))
    maps = maps_of(frames)
    out = pixels(run_blocks(fixer(settings), frames, maps))
    assert out.shape == (count, 29, 50, 3)
    assert (
        np.abs(out.astype(int) - whole_clip(settings, Recorded(frames, maps), "scene", 0)).max()
        <= 1
    )


def test_a_short_block_is_the_block_with_its_last_frame_repeated(weights):
    settings = busy_settings(weights)
    frames = moving_picture(5)
    maps = maps_of(frames)
    short = fixer(settings).step(frames[:2], maps[:2])
    still = [frames[0], *([frames[1]] * 4)]
    times = [
        frame.__class__(frame.t_us + i, frame.camera, frame.rgb, frame.alpha)
        for i, frame in enumerate(still)
    ]
    filled = fixer(settings).step(times, [maps[0], *([maps[1]] * 4)])
    assert np.array_equal(pixels(list(short)), pixels(list(filled))[:2])
