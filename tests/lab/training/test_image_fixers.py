"""Image models and windows as sessions: cameras are independent, windows cover a clip."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import resolve_renderer
from alpasim_plugin.fixers import make_fixer
from alpasim_plugin.fixers.refine import refine_frames
from alpasim_plugin.lab.image_fixers.image_fixer import ImageFixer
from alpasim_plugin.lab.image_fixers.window_fixer import windows
from tests.fixers.clip_cases import moving_picture, pixels
from tests.lab.training.image_cases import busy_settings


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(
        1
    )  # matrices this small are slower on several; tests/conftest.py sets the number back


@pytest.fixture
def settings_of(weights):
    return lambda name, *overrides: busy_settings(weights, name, *overrides)


@pytest.fixture
def session(settings_of):
    def make(name, *overrides, seed=0):
        return make_fixer(name, settings_of(name, *overrides), scene_id="scene", seed=seed)

    return make


def run(fixer, frames):
    return [
        out
        for block in refine_frames([(frame, None) for frame in frames], fixer)
        for out in block.fixed
    ]


def levels(a, b):
    return int(np.abs(a.astype(int) - b).max())


@pytest.mark.parametrize("frames", [1, 8, 25, 26, 42, 59, 60, 198, 900])
def test_windows_cover_every_frame_and_their_weights_sum_to_one(frames):
    parts = windows(frames, 25, 17)
    times = np.bincount([t for window in parts for t in window], minlength=frames)
    assert times.min() >= 1
    assert times.max() <= 3, "three only where the last window is aligned to the end"
    assert {len(window) for window in parts} == {min(frames, 25)}
    assert parts[-1].stop == frames
    assert {(198): 12, 900: 53}.get(frames, len(parts)) == len(parts)


def test_the_temporal_model_looks_at_four_outputs_and_no_further(
    session,
):
    frames = moving_picture(7, (16, 24), holes=False)
    temporal, single = (
        pixels(run(session("harmonizer-temporal", f"references={n}"), frames)) for n in (4, 0)
    )
    assert np.array_equal(temporal[:4], single[:4]), (
        "a camera's first four frames are fixed by themselves"
    )
    assert levels(temporal[4], single[4]) > 0
    changed = [replace(frames[0], rgb=255 - frames[0].rgb), *frames[1:]]
    after = pixels(run(session("harmonizer-temporal"), changed))
    assert np.array_equal(after[1:4], temporal[1:4])
    assert levels(after[4], temporal[4]) > 0, "the fifth sees the first"


class Spoilt(ImageFixer):
    """Give NaN for its third frame, as a network that overflows."""

    def _run(self, view, pasts):  # type: ignore[no-untyped-def]
        video = super()._run(view, pasts)
        return video * float("nan") if pasts[0] is not None and pasts[0].frames == 2 else video


def test_a_broken_frame_is_replaced_and_enters_the_references_as_it_was_shown(
    settings_of,
):
    frames = moving_picture(8, (16, 24))
    fixer = Spoilt(settings_of("harmonizer-temporal"), "scene")
    out = run(fixer, frames)
    assert [frame.events for frame in out] == [(), (), ("fixer-nan",), (), (), (), (), ()]
    assert np.array_equal(out[2].rgb, frames[2].rgb)
    assert all(
        np.array_equal(a, b.rgb)
        for a, b in zip(fixer._history["front"].references, out[:-5:-1], strict=True)
    )


def test_what_does_not_continue_a_rollout_is_refused(session):
    frames = moving_picture(3, (16, 24))
    fixer = session("difix")
    fixer.step(frames[1:2], ())
    with pytest.raises(InputError):
        fixer.step(frames[:1], ())
    with pytest.raises(InputError):
        fixer.step(frames[1:], ())
    clip = session("3dgs-enhancer", "steps=1")
    clip.step(frames, ())
    with pytest.raises(InputError):
        clip.step(frames, ())
    clip.reset(1)
    assert len(clip.step(frames, ())) == 3


def test_windows_are_refused_in_a_closed_loop_before_anything_is_loaded():
    with pytest.raises(InputError):
        resolve_renderer("3dgs-enhancer")
    with pytest.raises(InputError):
        resolve_renderer("3dgs-enhancer@4+clean")
    assert resolve_renderer("gsfix3d@4", ["untrained=random"]).fixer is not None
