"""Hard inputs and long rollouts: finite, bounded, and how far reduced precision drifts.

The long ones at real size: ``pytest -m slow -s tests/fixers/test_fixer_hard_cases.py``.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from alpasim_plugin.block_fixers.onefixer import OneFixer
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.stand_in import save_stand_in
from alpasim_plugin.core.types import U8, Frame
from alpasim_plugin.fixers import fixer_settings
from tests.block_fixers.fixer_cases import busy_settings, fixer, run_blocks, small_settings
from tests.fixers.clip_cases import SIZE, STEP_US, maps_of, moving_picture, pixels

TINY = (16, 32)  # height, width, for long rollouts


def still(value: int | U8, count: int = 13, alpha: float | None = None) -> list[Frame]:
    picture = np.full((*SIZE, 3), value, np.uint8) if isinstance(value, int) else value
    cover = None if alpha is None else np.full(SIZE, alpha, np.float32)
    return [Frame(i * STEP_US, "front", picture, cover) for i in range(count)]


# --- opacity


def test_a_render_without_any_opacity_is_made_of_noise(weights: Path) -> None:
    settings = busy_settings(weights)
    frames = [replace(f, alpha=np.zeros(SIZE, np.float32)) for f in moving_picture(13)]
    others = [replace(f, alpha=np.zeros(SIZE, np.float32)) for f in moving_picture(13, key="other")]
    maps = maps_of(frames)
    one = pixels(run_blocks(fixer(settings), frames, maps))
    assert np.array_equal(pixels(run_blocks(fixer(settings), others, maps)), one), (
        "nothing of the render is left"
    )
    assert not np.array_equal(pixels(run_blocks(fixer(settings, seed=1), frames, maps)), one)


def test_an_opaque_render_needs_no_noise(weights: Path) -> None:
    settings = busy_settings(weights)
    frames = moving_picture(13, holes=False)
    maps = maps_of(frames)
    one = pixels(run_blocks(fixer(settings), frames, maps))
    assert np.array_equal(pixels(run_blocks(fixer(settings, seed=1), frames, maps)), one)
    unknown = [replace(f, alpha=None) for f in frames]
    assert np.array_equal(pixels(run_blocks(fixer(settings), unknown, maps)), one)


def test_an_untrained_fixer_fills_holes_from_the_render() -> None:
    frames = moving_picture(13)
    out = pixels(run_blocks(fixer(small_settings()), frames, maps_of(frames)))
    again = pixels(run_blocks(fixer(small_settings(), seed=1), frames, maps_of(frames)))
    assert np.array_equal(out, again), "no noise in it"
    difference = np.abs(out.astype(int) - pixels(frames))
    assert difference[:, :, SIZE[1] // 3 :].max() == 0
    assert 0 < difference[:, : SIZE[0] // 2, : SIZE[1] // 3].mean() < 40  # a blurred copy


# --- pictures


@pytest.mark.parametrize("value", [0, 128, 255])
def test_constant_pictures_stay_constant_when_nothing_is_learned(value: int) -> None:
    frames = still(value)
    out = run_blocks(fixer(small_settings("decoder.kind=latent")), frames, maps_of(frames))
    assert np.abs(pixels(out).astype(int) - value).max() <= 1
    assert not any(frame.events for frame in out)


def checkerboard() -> U8:
    board = np.indices(SIZE).sum(0) % 2 * 255
    return np.repeat(board[..., None], 3, axis=2).astype(np.uint8)


@pytest.mark.parametrize(
    "picture",
    [
        0,
        255,
        checkerboard(),
        np.random.Generator(np.random.Philox(1)).integers(0, 2, (*SIZE, 3)) * 255,
    ],
)
@pytest.mark.parametrize("alpha", [None, 0.0, 0.5])
def test_saturated_pictures_give_finite_ones(
    weights: Path, picture: int | U8, alpha: float | None
) -> None:
    frames = still(picture if isinstance(picture, int) else picture.astype(np.uint8), alpha=alpha)
    out = run_blocks(fixer(busy_settings(weights)), frames, maps_of(frames))
    assert all("fixer-nan" not in frame.events for frame in out)


# --- long rollouts


def drive(count: int, size: tuple[int, int] = SIZE) -> Iterator[tuple[list[Frame], list[U8]]]:
    """Yield a long clip block by block: a short one forwards and backwards, with running times."""
    clip = moving_picture(33, size)
    maps = maps_of(clip)
    start = 0
    while start < count:
        due = min(5 if start == 0 else 8, count - start)
        order = [min(i % 64, 64 - i % 64) for i in range(start, start + due)]
        yield (
            [replace(clip[k], t_us=(start + j) * STEP_US) for j, k in enumerate(order)],
            [maps[k] for k in order],
        )
        start += due


def state_bytes(session: OneFixer) -> int:
    """Return what a rollout holds between blocks."""
    (past,) = session._history
    cache = past.state.history.cache
    tensors = [*(past.state.encoder or ()), *(past.state.decoder or ()), cache.keys, cache.values]
    return sum(t.numel() * t.element_size() for t in tensors)


def resident_bytes() -> int:
    """Return the memory of this process where the system tells, else 0."""
    table = Path("/proc/self/statm")
    return int(table.read_text().split()[1]) * resource.getpagesize() if table.exists() else 0


def drift(
    settings: OneFixerSettings, reduced: str, count: int, size: tuple[int, int] = SIZE
) -> np.ndarray:
    """Return per block the mean difference in grey levels of a precision from float32."""
    exact = OneFixer(settings, "scene")
    half = OneFixer(
        settings.model_copy(update={"precision": reduced, "codec_precision": reduced}), "scene"
    )
    out = []
    for block, maps in drive(count, size):
        pair = [pixels(list(session.step(block, maps))).astype(int) for session in (exact, half)]
        out.append(np.abs(pair[0] - pair[1]).mean())
    return np.array(out)


@pytest.mark.slow
def test_a_long_rollout_stays_finite_in_constant_memory(weights: Path) -> None:
    session = fixer(busy_settings(weights))
    held = set()
    resident = []
    for i, (block, maps) in enumerate(drive(900, TINY)):
        out = session.step(block, maps)
        assert not any(frame.events for frame in out), f"block {i}"
        if i >= 3:
            held.add(state_bytes(session))
        if i % 28 == 27:
            resident.append(resident_bytes())
    assert len(held) == 1
    assert resident[-1] - resident[0] < 4e6


@pytest.mark.parametrize(
    ("history", "precision", "levels"), [("finalise", "bf16", 1.0), ("last-forward", "fp16", 0.2)]
)
def test_reduced_precision_does_not_drift(
    weights: Path, history: str, precision: str, levels: float
) -> None:
    series = drift(busy_settings(weights, f"history={history}"), precision, 101, TINY)
    early, late = series[2:7].mean(), series[-5:].mean()
    assert series.max() < levels
    assert late < 1.5 * early


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_reduced_precision_over_3600_frames(weights: Path, precision: str) -> None:
    series = drift(busy_settings(weights, "history=finalise"), precision, 3600, TINY)
    print(
        f"\n{precision}: "
        + "  ".join(
            f"{i * 8}: {series[i : i + 10].mean():.4f}" for i in (2, 56, 112, 225, 337, 440)
        )
    )
    assert series[-50:].mean() < 1.5 * series[2:52].mean()


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_the_shipped_size_over_900_frames(tmp_path: Path, precision: str) -> None:
    path = tmp_path / "stand_in.safetensors"
    plain = fixer_settings("onefixer-dit-tiny", ["holes=noise"])
    assert isinstance(plain, OneFixerSettings)
    save_stand_in(path, plain)
    settings = fixer_settings("onefixer-dit-tiny", ["holes=noise", f"weights.bundle={path}"])
    assert isinstance(settings, OneFixerSettings)
    torch.set_num_threads(2)
    series = drift(settings, precision, 900, (144, 256))
    print(
        f"\n{precision}: "
        + "  ".join(f"{i * 8}: {series[i : i + 5].mean():.4f}" for i in (1, 28, 56, 84, 107))
    )
    assert series[-20:].mean() < 1.5 * series[2:22].mean()
