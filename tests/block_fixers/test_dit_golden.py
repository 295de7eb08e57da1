"""Hold the transformer and the sampler against tensors of the original networks; SOURCE.md beside
the data says how they were made.
"""

import pytest
import torch
from safetensors.torch import load_file

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.sampling import context_level
from alpasim_plugin.fixers.network.schedule import from_names
from tests.block_fixers.cache_history import history
from tests.block_fixers.dit_cases import furthest, stream

TOLERANCE = (
    1e-5  # ten times tighter than asked; the original itself moves by 4e-6 with another arithmetic
)


@pytest.fixture(scope="module")
def golden(shared_data):
    folder = shared_data / "golden-nets"
    return {
        name: load_file(folder / f"{name}.safetensors")
        for name in ("dit.weights", "dit.io", "dit_rollout.io")
    }


@pytest.fixture(scope="module")
def net(golden):
    return CosmosCausalDiT.from_state_dict(golden["dit.weights"]).requires_grad_(False)


@pytest.fixture(scope="module")
def io(golden):
    return golden["dit.io"]


def inputs(io, name="clip", **changes):
    return {key: io[f"in.{name}.{key}"] for key in ("x", "t", "text", "hdmap")} | changes


def first_given(frames):
    mask = torch.zeros(1, 1, frames, 8, 12)
    mask[:, :, 0] = 1
    return mask


@pytest.mark.parametrize("block", [1, 2, 4])
def test_whole_clip_in_blocks(net, io, block):
    name = "out.clip.mask0.r3.out" if block == 2 else f"out.clip.mask0.r3.block{block}.out"
    assert furthest(net(**inputs(io), block_latents=block), io[name]) < TOLERANCE


def test_whole_clip_without_rope_stretch(golden, io):
    net = CosmosCausalDiT.from_state_dict(golden["dit.weights"], rope_ratios=(1.0, 1.0, 1.0))
    with torch.no_grad():
        assert furthest(net(**inputs(io)), io["out.clip.mask0.r1.out"]) < TOLERANCE


def test_first_latent_given(net, io):
    mask = first_given(6)
    assert (
        furthest(net(**inputs(io), condition_mask=mask), io["out.clip.first_frame_given.r3.out"])
        < TOLERANCE
    )


def test_bidirectional_teacher(net, io):
    t = io["in.clip.t"]
    mask = first_given(6)
    assert (
        furthest(
            net(**inputs(io), condition_mask=mask, block_latents=None),
            io["out.teacher.per_frame_t.out"],
        )
        < TOLERANCE
    )
    one = net(**inputs(io, t=t[:, :1]), condition_mask=mask, block_latents=None)
    assert furthest(one, io["out.teacher.one_t.out"]) < TOLERANCE


def test_blocks_through_a_cache_that_covers_the_clip(net, io):
    clip = inputs(io, t=io["in.cached_full.t"])
    mask = first_given(6)
    assert (
        furthest(net(**clip, condition_mask=mask), io["out.cached_full.wholeclip.out"]) < TOLERANCE
    )
    cache = net.new_cache(1, 8, 12, window=6)
    assert (
        furthest(
            stream(net, cache, **clip, blocks=(2, 2, 2), mask=mask),
            io["out.cached_full.blocks.out"],
        )
        < TOLERANCE
    )
    keys, values = history(cache, 0)
    assert furthest(keys, io["out.cached_full.block0.k_cache"]) < TOLERANCE
    assert furthest(values, io["out.cached_full.block0.v_cache"]) < TOLERANCE


@pytest.mark.parametrize(("window", "sink"), [(4, 0), (4, 2), (6, 0)])
def test_two_forwards_a_block_through_a_rolling_window(net, io, window, sink):
    cache = net.new_cache(1, 8, 12, window, sink)
    mask = first_given(10)
    noisy = []
    context = []
    for block in range(5):
        cut = slice(2 * block, 2 * block + 2)
        text = io["in.window.text"]
        hdmap = io["in.window.hdmap"][:, :, cut]
        m = mask[:, :, cut]
        t = float(io["in.window.t_per_block"][block])
        noisy.append(net.step(io["in.window.x"][:, :, cut], t, text, hdmap, cache, False, m))
        context.append(
            net.step(io["in.window.x_context"][:, :, cut], 128.0, text, hdmap, cache, True, m)
        )
    name = f"out.window{window}_sink{sink}.rolling"
    assert furthest(torch.cat(noisy, 2), io[f"{name}.out_noisy"]) < TOLERANCE
    assert furthest(torch.cat(context, 2), io[f"{name}.out_context"]) < TOLERANCE
    if sink:
        assert furthest(history(cache, 0)[0], io[f"{name}.final_block0_k_cache"]) < TOLERANCE


def test_noise_levels_are_the_recorded_ones():
    assert [round(level.t, 4) for level in from_names([1000, 450])] == [1000.0, 803.5714]
    assert abs(context_level().sigma - 0.129928321) < 1e-8
