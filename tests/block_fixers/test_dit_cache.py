"""The rolling cache: one storage for ever, no leaks between rollouts, odd windows and blocks."""

import pytest
import torch

from alpasim_plugin.core.errors import InputError
from tests.block_fixers.dit_cases import clip, furthest, network, stream


def test_forward_that_is_not_written_leaves_no_trace():
    net, (x, t, text, hdmap) = network(), clip(8)
    quiet, tried = (net.new_cache(1, 4, 6, window=4) for _ in range(2))
    for start in range(0, 8, 2):
        cut = slice(start, start + 2)
        for guess in range(3):
            net.step(x[:, :, cut] + guess, 700.0, text, hdmap[:, :, cut], tried, write=False)
        args = (x[:, :, cut], t[:, cut], text, hdmap[:, :, cut])
        assert torch.equal(net.step(*args, tried), net.step(*args, quiet))


def test_two_rollouts_interleaved_are_each_bit_equal_to_alone():
    net = network()
    clips = [clip(10, seed=seed) for seed in (1, 2)]
    alone = [stream(net, net.new_cache(1, 4, 6, 4, 1), *c, (2,) * 5) for c in clips]
    caches = [net.new_cache(1, 4, 6, 4, 1) for _ in clips]
    out = [[], []]
    for start in range(0, 10, 2):
        cut = slice(start, start + 2)
        for i, (x, t, text, hdmap) in enumerate(clips):
            out[i].append(net.step(x[:, :, cut], t[:, cut], text, hdmap[:, :, cut], caches[i]))
    for i in range(2):
        assert torch.equal(torch.cat(out[i], 2), alone[i])


def test_reset_reproduces_the_same_bits_even_after_nan():
    net = network()
    c = clip(10)
    cache = net.new_cache(1, 4, 6, 4)
    first = stream(net, cache, *c, (2,) * 5)
    net.step(torch.full_like(c[0][:, :, :2], torch.nan), 500.0, c[2], c[3][:, :, :2], cache)
    cache.reset()
    assert cache.position == 0
    assert torch.equal(stream(net, cache, *c, (2,) * 5), first)


def test_window_smaller_than_a_block_sees_the_block_and_nothing_else():
    net, (x, t, text, hdmap) = network(), clip(6)
    out = stream(net, net.new_cache(1, 4, 6, window=1), x, t, text, hdmap, (3, 3))
    for start in (0, 3):
        cut = slice(start, start + 3)
        with torch.no_grad():
            alone = net(x[:, :, cut], t[:, cut], text, hdmap[:, :, cut], None, 3, start=start)
        assert furthest(out[:, :, cut], alone) < 1e-5


def test_block_may_be_opened_again_shorter_while_nothing_was_overwritten():
    net, (x, t, text, hdmap) = network(), clip(2)
    tried, quiet = (net.new_cache(1, 4, 6, window=4) for _ in range(2))
    net.step(x, t, text, hdmap, tried, write=False)
    short = (x[:, :, :1], t[:, :1], text, hdmap[:, :, :1])
    assert torch.equal(net.step(*short, tried), net.step(*short, quiet))


def test_cache_of_another_network_or_size_is_refused():
    net, (x, t, text, hdmap) = network(), clip(2)
    other = network(rope_ratios=(1.0, 1.0, 1.0)).new_cache(1, 4, 6)
    for cache in (net.new_cache(2, 4, 6), net.new_cache(1, 6, 4), other):
        with pytest.raises(InputError):
            net.step(x, t, text, hdmap, cache)


def test_every_wrong_input_is_refused():
    net, (x, t, text, hdmap) = network(), clip(2)
    bad = [
        (x[:, :3], t, text, hdmap),
        (x[..., :5], t, text, hdmap),
        (x, t, text, hdmap[:, :, :1]),
    ]
    for args in bad:
        with pytest.raises(InputError):
            net(*args)


@pytest.mark.parametrize("made_inside", [True, False])
def test_inference_mode_may_begin_and_end_anywhere(made_inside):
    net, (x, t, text, hdmap) = network(), clip(8)
    expected = stream(net, net.new_cache(1, 4, 6, 4), x, t, text, hdmap, (2, 2, 2, 2))
    with torch.inference_mode(made_inside):
        cache = net.new_cache(1, 4, 6, 4)
    out = []
    for start in range(0, 8, 2):
        cut = slice(start, start + 2)
        with torch.inference_mode((start // 2 % 2 == 0) == made_inside):
            out.append(net.step(x[:, :, cut], t[:, cut], text, hdmap[:, :, cut], cache))
    assert torch.equal(torch.cat(out, 2), expected)
