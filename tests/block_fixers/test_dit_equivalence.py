"""Two execution paths, one network: whole clip, blocks through either cache, and the written-out
reference agree.
"""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.block_fixers.sizes import DiTSizes
from tests.block_fixers.dit_cases import SMALL, clip, furthest, network, stream
from tests.block_fixers.dit_reference import latent_mask, random_weights, velocity
from tests.examples import examples

SIZES = [
    SMALL,
    DiTSizes(16, 1, 16, 24, 3, 5, 16, 16, 16),  # one block, one head, context as wide as the stream
    DiTSizes(
        96, 3, 8, 64, 96, 11, 6, 16, 1
    ),  # many heads of the smallest useful width, square AdaLN, map of one channel
    DiTSizes(64, 2, 64, 256, 16, 48, 40, 16, 16),
    DiTSizes(20, 2, 10, 33, 4, 3, 2, 5, 7),  # no power of two anywhere
    DiTSizes(24, 2, 12, 40, 5, 7, 9, 4, 3, 6),  # every block sees the opacity
]


@pytest.mark.parametrize("sizes", SIZES, ids=lambda s: f"{s.width}x{s.blocks}x{s.head_width}")
@pytest.mark.parametrize(
    ("frames", "block", "ratios"),
    [(5, 2, (3.0, 3.0, 1.0)), (3, 3, (1.0, 2.0, 1.5)), (1, 2, (1.0, 1.0, 1.0))],
)
def test_network_is_the_written_out_one_at_any_size(sizes, frames, block, ratios):
    weights = random_weights(sizes, 3)
    x, t, text, hdmap = clip(frames, sizes, batch=2)
    mask = (
        torch.rand(2, 1, frames, 4, 6, generator=torch.Generator().manual_seed(0)) > 0.5
    ).float()
    net = network(sizes, 3, rope_ratios=ratios)
    assert net.sizes == sizes
    with torch.no_grad():
        v = net(x, t, text, hdmap, mask, block)
    assert furthest(v, velocity(weights, x, t, text, hdmap, mask, block, ratios)) < 1e-4


@settings(max_examples=examples(40), deadline=None)
@given(
    frames=st.integers(1, 9),
    block=st.integers(1, 4),
    window=st.integers(1, 10),
    sink=st.integers(0, 3),
    size=st.sampled_from([(2, 2), (4, 6)]),
)
def test_blocks_through_a_cache_are_the_whole_clip_under_the_same_window(
    frames, block, window, sink, size
):
    sink = min(sink, window)
    net = network()
    x, t, text, hdmap = clip(frames, height=size[0], width=size[1])
    lengths = [min(block, frames - start) for start in range(0, frames, block)]
    with torch.no_grad():
        blocks = stream(net, net.new_cache(1, *size, window, sink), x, t, text, hdmap, lengths)
        assert (
            furthest(blocks, net(x, t, text, hdmap, None, block, window=window, sink=sink)) < 1e-5
        )
        if window >= frames:
            assert furthest(blocks, net(x, t, text, hdmap, None, block)) < 1e-5


def test_past_beyond_the_window_is_forgotten_and_the_sink_is_not():
    one_layer = network(
        DiTSizes(**{**SMALL.__dict__, "blocks": 1})
    )  # several layers would pass it on from block to block
    x, t, text, hdmap = clip(8)
    far = x.clone()
    sunk = x.clone()
    far[:, :, 2:4] += 5
    sunk[:, :, 0:2] += 5
    with torch.no_grad():
        last = [one_layer(a, t, text, hdmap, window=6, sink=2)[:, :, 6:] for a in (x, far, sunk)]
    assert torch.equal(last[0], last[1])
    assert furthest(last[0], last[2]) > 1e-3


def test_the_mask_of_a_window_is_what_the_reference_says():
    expected = torch.tensor([[1, 1, 0, 0, 0, 0], [1, 1, 1, 1, 0, 0], [1, 0, 0, 1, 1, 1]]).bool()
    assert torch.equal(latent_mask(6, 2, window=4, sink=1), expected.repeat_interleave(2, 0))
    weights = random_weights(SMALL)
    x, t, text, hdmap = clip(6)
    with torch.no_grad():
        v = network()(x, t, text, hdmap, window=4, sink=1)
    assert furthest(v, velocity(weights, x, t, text, hdmap, window=4, sink=1)) < 1e-5


@pytest.mark.parametrize("tokens", [1, 5])
def test_prepared_text_is_the_text(tokens):
    net = network()
    x, t, text, hdmap = clip(4, tokens=tokens)
    with torch.no_grad():
        assert torch.equal(net(x, t, net.encode_text(text), hdmap), net(x, t, text, hdmap))
        assert (
            furthest(net(x, t, text, hdmap), velocity(random_weights(SMALL), x, t, text, hdmap))
            < 1e-5
        )
