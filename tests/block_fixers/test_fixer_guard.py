"""Every output frame is looked at; a broken one is replaced by the raw frame and counted."""

from dataclasses import replace

import numpy as np
import torch

from alpasim_plugin.block_fixers import onefixer
from alpasim_plugin.fixers import guard
from tests.block_fixers.fixer_cases import busy_settings, fixer, run_blocks, small_settings
from tests.fixers.clip_cases import maps_of, moving_picture, pixels

FRAMES = moving_picture(29)
MAPS = maps_of(FRAMES)


def video(*values):
    """Return one frame of 10 x 10 per value."""
    return torch.tensor(values).view(-1, 1, 1, 1).expand(-1, 10, 10, 3).clone()


def failures(x):
    grey = np.full((len(x), 10, 10, 3), 90, dtype=np.uint8)
    grey += np.arange(len(x), dtype=np.uint8)[:, None, None, None]
    return guard.check_frames(x, grey, grey, None)


def test_a_single_nan_or_infinity_spoils_its_frame_alone():
    x = video(0.0, 0.0, 0.0)
    x[1, 3, 4, 1], x[2, 5, 5, 2] = torch.nan, torch.inf
    assert failures(x) == ["", "fixer-nan", "fixer-nan"]


def test_overshoot_at_a_few_pixels_is_not_out_of_range():
    x = video(0.0, 0.0, -1.4)
    x[0, 0, :3, 0] = 9.0  # 1 % of 300 values
    x[1, 0, :4, 0] = -9.0
    assert failures(x) == ["", "fixer-range", ""]
    assert failures(x.bfloat16()) == ["", "fixer-range", ""]


def test_black_counts_only_where_the_render_is_not_black():
    dark = np.full((1, 10, 10, 3), 10, dtype=np.uint8)
    grey = np.full((1, 10, 10, 3), 90, dtype=np.uint8)
    assert guard.check_frames(video(0.0), dark, grey, None) == ["fixer-black"]
    assert guard.check_frames(video(0.0), dark, dark, None) == [""]
    assert guard.check_frames(video(0.0), grey, grey, None) == [""]


def test_frozen_counts_only_where_the_render_moves():
    raw = pixels(FRAMES[:3])
    out = np.stack([raw[0], raw[0], raw[1]])
    fine = video(0.0, 0.0, 0.0)
    assert guard.check_frames(fine, out, raw, None) == ["", "fixer-frozen", ""]
    standing = np.stack([raw[0]] * 3)
    assert guard.check_frames(fine, standing, standing, (raw[0], raw[0])) == ["", "", ""]
    assert guard.check_frames(fine, out, raw, (raw[0], raw[2]))[0] == "fixer-frozen", (
        "also across blocks"
    )
    flicker = standing.copy()
    flicker[1, 0, 0, 0] ^= 1
    assert guard.check_frames(fine, standing, flicker, None) == ["", "", ""]


def test_numbers_that_are_none_are_replaced_and_do_not_stay(weights, monkeypatch):
    session = fixer(busy_settings(weights))
    real = onefixer.latent_noise

    def spoiled(*args):
        return [torch.full_like(eps, torch.nan) for eps in real(*args)]

    out = list(session.step(FRAMES[:5], MAPS[:5]))
    assert not any(frame.events for frame in out)
    monkeypatch.setattr(onefixer, "latent_noise", spoiled)
    bad = list(session.step(FRAMES[5:13], MAPS[5:13]))
    assert all(frame.events == ("fixer-nan",) for frame in bad)
    assert np.array_equal(pixels(bad), pixels(FRAMES[5:13]))
    monkeypatch.setattr(onefixer, "latent_noise", real)
    after = [*session.step(FRAMES[13:21], MAPS[13:21]), *session.step(FRAMES[21:29], MAPS[21:29])]
    assert not any(frame.events for frame in after), "the history was dropped with the block"
    assert np.abs(pixels(after).astype(int) - pixels(FRAMES[13:])).max() > 2


def test_a_previewed_failure_leaves_no_trace(weights, monkeypatch):
    settings = busy_settings(weights)
    alone = pixels(run_blocks(fixer(settings), FRAMES[:21], MAPS[:21]))
    session = fixer(settings)
    real = onefixer.latent_noise
    out = list(session.step(FRAMES[:5], MAPS[:5]))
    for start, end in ((5, 13), (13, 21)):
        monkeypatch.setattr(
            onefixer,
            "latent_noise",
            lambda *args: [torch.full_like(eps, torch.nan) for eps in real(*args)],
        )
        assert session.preview(moving_picture(end)[start:end], MAPS[start:end])[0].events == (
            "fixer-nan",
        )
        monkeypatch.setattr(onefixer, "latent_noise", real)
        session.preview(FRAMES[start : start + 1], MAPS[start : start + 1])
        out += session.step(FRAMES[start:end], MAPS[start:end])
    assert np.array_equal(pixels(out), alone)


def test_weights_that_overflow_are_seen(weights):
    settings = small_settings("untrained=random", "holes=noise", "precision=bf16")
    session = fixer(settings)
    session.networks.dit.final_layer.linear.weight.data.mul_(1e3)
    try:
        out = session.step(FRAMES[:5], MAPS[:5])
    finally:
        onefixer.load_networks.__globals__["_load"].cache_clear()
    assert all(frame.events in (("fixer-nan",), ("fixer-range",)) for frame in out)
    assert np.array_equal(pixels(list(out)), pixels(FRAMES[:5]))


def test_events_of_the_renderer_are_kept():
    frames = [replace(FRAMES[0], events=("black",))]
    assert fixer(small_settings()).step(frames, MAPS[:1])[0].events == ("black",)
