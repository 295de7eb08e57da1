"""Random sizes, options and shapes: the network is the written-out one, its cache is its mask, and
sizes are read off the tensors.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.sizes import DiTSizes
from tests.block_fixers.dit_cases import clip, furthest, stream
from tests.block_fixers.dit_reference import random_weights, velocity
from tests.examples import examples

HEAD_WIDTHS = (
    16,
    18,
    20,
    22,
    26,
    32,
    34,
    40,
    48,
    50,
    62,
    64,
    74,
    80,
    96,
    100,
    128,
)  # remainders 0, 2, 4 of 6


@st.composite
def sizes(draw) -> DiTSizes:
    head_width = draw(st.sampled_from(HEAD_WIDTHS))
    return DiTSizes(
        width=head_width * draw(st.integers(1, 4)),
        blocks=draw(st.integers(1, 3)),
        head_width=head_width,
        mlp_width=draw(st.integers(1, 90)),
        adaln_rank=draw(st.integers(1, 40)),
        text_width=draw(st.integers(1, 30)),
        context_width=draw(st.integers(1, 40)),
        latent_channels=draw(st.sampled_from((1, 4, 16))),
        map_channels=draw(st.sampled_from((1, 16, 192))),
    )


@settings(max_examples=examples(40), deadline=None)
@given(data=st.data(), sizes=sizes())
def test_any_size_is_read_and_computed(data, sizes):
    frames, block = data.draw(st.integers(1, 5)), data.draw(st.none() | st.integers(1, 4))
    batch, tokens = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 5))
    height, width = (2 * data.draw(st.integers(1, 4)) for _ in range(2))
    ratios = tuple(data.draw(st.sampled_from((0.5, 1.0, 1.5, 3.0))) for _ in range(3))
    start, seed = data.draw(st.sampled_from((0, 1, 7, 127, 4000))), data.draw(st.integers(0, 99))
    window = data.draw(st.none() | st.integers(1, 6)) if block else None
    sink = data.draw(st.integers(0, min(2, window))) if window else 0
    weights = random_weights(sizes, seed)
    x, t, text, hdmap = clip(frames, sizes, batch, height, width, tokens, seed)
    g = torch.Generator().manual_seed(seed)
    mask = (
        (torch.rand(batch, 1, frames, height, width, generator=g) > 0.5).float()
        if data.draw(st.booleans())
        else None
    )
    padding = (
        (torch.rand(batch, 1, height, width, generator=g) > 0.5).float()
        if data.draw(st.booleans())
        else None
    )
    net = CosmosCausalDiT.from_state_dict(weights, rope_ratios=ratios)
    assert net.sizes == sizes
    expanded = None if padding is None else padding[:, :, None].expand(-1, -1, frames, -1, -1)
    expected = velocity(
        weights, x, t, text, hdmap, mask, block or frames, ratios, expanded, window, sink, start
    )
    with torch.no_grad():
        v = net(
            x,
            t,
            text,
            hdmap,
            mask,
            block,
            padding_mask=padding,
            window=window,
            sink=sink,
            start=start,
        )
    assert furthest(v, expected) < 1e-4


@settings(max_examples=examples(20), deadline=None)
@given(data=st.data(), sizes=sizes())
def test_any_size_streams_as_its_mask_says(data, sizes):
    block, blocks = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 4))
    window = data.draw(st.integers(1, 8))
    sink = data.draw(st.integers(0, min(3, window)))
    batch, tokens = data.draw(st.integers(1, 2)), data.draw(st.integers(1, 3))
    weights = random_weights(sizes, 5)
    x, t, text, hdmap = clip(block * blocks, sizes, batch, 2, 4, tokens)
    net = CosmosCausalDiT.from_state_dict(weights)
    with torch.no_grad():
        v = stream(
            net, net.new_cache(batch, 2, 4, window, sink), x, t, text, hdmap, (block,) * blocks
        )
    assert (
        furthest(v, velocity(weights, x, t, text, hdmap, None, block, window=window, sink=sink))
        < 1e-4
    )


@pytest.mark.parametrize("shape", [(16, 1), (16, 16), (24, 12)])
def test_sizes_that_coincide_are_still_told_apart(shape):
    """Width, inner width, rank, context and text all equal: only counts of heads and channels are
    left to read.
    """
    width, head_width = shape
    sizes = DiTSizes(width, 2, max(2, head_width), width, width, width, width, 16, 16)
    weights = random_weights(sizes)
    net = CosmosCausalDiT.from_state_dict(weights)
    assert net.sizes == sizes
    c = clip(4, sizes)
    with torch.no_grad():
        assert furthest(net(*c), velocity(weights, *c)) < 1e-4


@pytest.mark.parametrize("value", ["zeros", "constant", "huge", "tiny", "nan"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_latents_that_are_flat_saturated_or_not_numbers(value, dtype):
    sizes = DiTSizes(32, 2, 16, 48, 4, 6, 8)
    weights = random_weights(sizes)
    net = CosmosCausalDiT.from_state_dict(weights, dtype=dtype)
    _, t, text, hdmap = clip(4, sizes)
    levels = {"zeros": 0.0, "constant": 1.5, "huge": 1e4, "tiny": 1e-6, "nan": torch.nan}
    x = torch.full((1, 16, 4, 4, 6), levels[value])
    clean = torch.zeros_like(x)
    if value == "nan":
        clean[:, :, 2:] = x[:, :, 2:]
        x = clean
    with torch.no_grad():
        v = net(x, t, text, hdmap)
        blocks = stream(net, net.new_cache(1, 4, 6, 4), x, t, text, hdmap, (2, 2))
    if value == "nan":  # stays within its own and later blocks, and is not hidden
        assert v[:, :, :2].isfinite().all()
        assert v[:, :, 2:].isnan().all()
        assert blocks[:, :, 2:].isnan().all()
        return
    assert v.isfinite().all()
    tolerance = {torch.float32: 1e-4, torch.bfloat16: 0.06, torch.float16: 0.01}[dtype]
    expected = velocity(weights, x, t, text, hdmap)
    assert float((v - expected).norm() / expected.norm()) < tolerance
    assert float((blocks - expected).norm() / expected.norm()) < tolerance
