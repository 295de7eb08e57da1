"""The cache of training holds what the rolling one holds, with gradients."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.lab.training.graph_cache import GraphCache
from tests.block_fixers.cache_history import history
from tests.block_fixers.dit_cases import SMALL, clip, furthest, network, stream
from tests.examples import examples


def kept(cache, layer):
    """Return a layer's visible keys and values, oldest first."""
    pairs = cache._kept.get(layer, [])
    newest = len(pairs) - (cache.window - cache.sink) if cache.window is not None else 0
    visible = [pair for i, pair in enumerate(pairs) if i < cache.sink or i >= newest]
    return torch.cat([k for k, _ in visible], dim=1), torch.cat([v for _, v in visible], dim=1)


@settings(max_examples=examples(40), deadline=None)
@given(
    blocks=st.lists(st.integers(1, 4), min_size=1, max_size=5),
    window=st.integers(1, 12),
    sink=st.integers(0, 4),
    batch=st.integers(1, 2),
    size=st.sampled_from([(2, 2), (4, 6), (6, 2)]),
)
def test_rolling_cache_is_the_growing_one(blocks, window, sink, batch, size):
    sink = min(sink, window)
    net = network()
    x, t, text, hdmap = clip(sum(blocks), batch=batch, height=size[0], width=size[1])
    caches = [
        net.new_cache(batch, *size, window, sink),
        GraphCache.of(net, batch, *size, window, sink),
    ]
    out = [stream(net, cache, x, t, text, hdmap, blocks).detach() for cache in caches]
    assert furthest(*out) < 1e-5
    for layer in range(SMALL.blocks):
        for ours, other in zip(history(caches[0], layer), kept(caches[1], layer), strict=True):
            assert furthest(ours, other) < 1e-5


def test_gradients_reach_back_as_far_as_the_history_is_not_cut():
    net, (x, t, text, hdmap) = network(), clip(6)
    for cut_after, reached in ((None, [True, True]), (1, [False, True]), (2, [False, False])):
        leaf = x.clone().requires_grad_()
        cache = GraphCache.of(net, 1, 4, 6, window=6)
        for block in range(3):
            if block == cut_after:
                cache = cache.fork()
            cut = slice(2 * block, 2 * block + 2)
            v = net.step(leaf[:, :, cut], t[:, cut], text, hdmap[:, :, cut], cache)
        (grad,) = torch.autograd.grad(v.square().sum(), leaf)
        assert [
            bool(grad[:, :, cut].abs().max() > 0) for cut in (slice(0, 2), slice(2, 4))
        ] == reached
        assert grad[:, :, 4:].abs().max() > 0


def test_gradients_of_a_clip_are_those_of_its_blocks():
    net, (x, t, text, hdmap) = network(), clip(4)
    cache = GraphCache.of(net, 1, 4, 6, window=None)
    whole = torch.autograd.grad(net(x, t, text, hdmap).square().mean(), list(net.parameters()))
    blocks = torch.autograd.grad(
        stream(net, cache, x, t, text, hdmap, (2, 2)).square().mean(), list(net.parameters())
    )
    for a, b in zip(whole, blocks, strict=True):
        assert furthest(a, b) < 1e-5
