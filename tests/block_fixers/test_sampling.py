"""Opacity mixing, flow steps, schedule and the block sampler read like their equations and refuse
what has no meaning.
"""

import pytest
import torch

from alpasim_plugin.block_fixers.sampling import (
    context_level,
    finalise,
    flow_step,
    mixed_source,
    opacity_mask,
    opacity_values,
    sample_block,
)
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.schedule import from_names, interpolant, named, shifted, steps
from tests.block_fixers.dit_cases import clip, furthest, network


def noise(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    ("first", "frames", "latents"),
    [(True, 1, 1), (True, 5, 2), (True, 9, 3), (False, 4, 1), (False, 8, 2)],
)
def test_mask_is_the_largest_opacity_of_each_latent(first, frames, latents):
    opacity = torch.rand(2, 1, frames, 16, 24, generator=torch.Generator().manual_seed(1))
    mask = opacity_mask(opacity, first)
    assert mask.shape == (2, 1, latents, 2, 3)
    for i in range(latents):
        begin = (4 * i - 3 if i else 0) if first else 4 * i
        end = (4 * i + 1) if first else 4 * i + 4
        for row in range(2):
            for column in range(3):
                cell = opacity[:, 0, begin:end, 8 * row : 8 * row + 8, 8 * column : 8 * column + 8]
                assert torch.equal(mask[:, 0, i, row, column], cell.amax((1, 2, 3)))


@pytest.mark.parametrize("first", [True, False])
def test_opacity_values_are_means_of_four_by_four_pixels_of_every_frame(first):
    opacity = torch.rand(
        2, 1, 5 if first else 8, 16, 24, generator=torch.Generator().manual_seed(1)
    )
    values = opacity_values(opacity, first)
    assert values.shape == (2, 16, 2, 2, 3)
    for channel in range(16):
        frame = channel // 4
        row = channel // 2 % 2
        column = channel % 2
        at = 1 + frame if first else 4 + frame  # of the second latent
        cell = opacity[:, 0, at, 8 + 4 * row : 12 + 4 * row, 16 + 4 * column : 20 + 4 * column]
        assert furthest(values[:, channel, 1, 1, 2], cell.mean((1, 2))) < 1e-6
    if first:
        assert torch.equal(values[:, 0:4, 0], values[:, 12:16, 0]), (
            "the first frame stands for those before it"
        )


def test_opaque_render_is_kept_and_empty_one_is_noise_bit_for_bit():
    z = noise(1, 4, 2, 2, 3)
    eps = noise(1, 4, 2, 2, 3, seed=1)
    ones = opacity_mask(torch.ones(1, 1, 5, 16, 24))
    assert torch.equal(mixed_source(z, ones, eps), z)
    assert torch.equal(mixed_source(z, 0 * ones, eps), eps)
    half = mixed_source(z, 0.25 * ones, eps)
    assert furthest(half, 0.25 * z + 0.75 * eps) < 1e-7


@pytest.mark.parametrize("shape", [(1, 1, 4, 8, 8), (1, 1, 5, 9, 8), (1, 3, 5, 8, 8), (1, 5, 8, 8)])
def test_opacity_of_a_wrong_shape_is_refused(shape):
    with pytest.raises(InputError):
        opacity_mask(torch.ones(shape))


def test_one_step_inverts_the_interpolant_at_every_time():
    z_0 = noise(1, 4, 2, 2, 2)
    z_1 = noise(1, 4, 2, 2, 2, seed=1)
    for t in (0.0, 0.13, 0.8, 1.0):
        assert furthest(flow_step(interpolant(z_0, z_1, t), z_1 - z_0, t), z_0) < 1e-6
    assert torch.equal(interpolant(z_0, z_1, 1.0), z_1)
    assert flow_step(z_1.bfloat16(), z_0.bfloat16()).dtype == torch.bfloat16


def test_released_schedules():
    assert [level.sigma for level in steps(4)] == pytest.approx(
        [1.0, 0.9375, 0.83333, 0.625], abs=1e-5
    )
    assert [level.sigma for level in steps(2)] == pytest.approx([1.0, 0.83333], abs=1e-5)
    assert [(level.t, level.sigma) for level in steps(1)] == [(1000.0, 1.0)]
    assert named(450).sigma == pytest.approx(0.8036, abs=1e-4)
    assert named(100).sigma == pytest.approx(0.3571, abs=1e-4)
    assert shifted(1.0) == 1.0


@pytest.mark.parametrize(
    "call",
    [
        lambda: steps(0),
        lambda: named(0),
        lambda: named(1001),
        lambda: from_names([]),
        lambda: from_names([500, 500]),
    ],
)
def test_senseless_schedules_are_refused(call):
    with pytest.raises(InputError):
        call()


def test_steps_leave_the_block_open_and_the_cache_keeps_the_last_forward():
    net, (_, _, text, hdmap) = network(), clip(2)
    cache = net.new_cache(1, 4, 6)
    calls = []

    class Counter:
        def step(self, x, t, text, hdmap, cache, write=True):
            calls.append((round(t), write))
            return net.step(x, t, text, hdmap, cache, write)

    sources = [noise(1, 4, 2, 4, 6, seed=i) for i in range(2)]
    z = sample_block(Counter(), sources, text, hdmap, cache, steps(2))
    assert z.isfinite().all()
    assert calls == [(1000, False), (833, False)]
    assert cache.position == 0
    finalise(Counter(), z, sources[0], text, hdmap, cache)
    assert calls[2:] == [(128, True)]
    assert cache.position == 2


@pytest.mark.parametrize("finalises", [True, False])
def test_block_left_open_can_be_guessed_again_and_then_kept_for_nothing(finalises):
    net, (z_1, _, text, hdmap) = network(), clip(2)
    kept = net.new_cache(1, 4, 6, window=4)
    guessed = net.new_cache(1, 4, 6, window=4)

    def keep(cache, z_0):
        if finalises:
            finalise(net, z_0, noise(*z_1.shape), text, hdmap, cache)
        else:
            cache.commit()

    for _ in range(4):
        truth = sample_block(net, [z_1], text, hdmap, kept, steps(1))
        keep(kept, truth)
        sample_block(net, [z_1], text, hdmap + 1, guessed, steps(1))
        assert torch.equal(sample_block(net, [z_1], text, hdmap, guessed, steps(1)), truth)
        keep(guessed, truth)
    assert guessed.position == kept.position == 8
    for layer, buffer in kept.buffers.items():
        assert torch.equal(guessed.buffers[layer], buffer)


def test_cache_write_is_told_128_and_noised_like_its_nearest_neighbour():
    level = context_level()
    assert level.t == 128.0
    assert level.sigma == pytest.approx(0.12992832, abs=1e-8)


def test_one_step_is_equation_two():
    net, (z_1, _, text, hdmap) = network(), clip(2)
    one = net.new_cache(1, 4, 6)
    z_0 = sample_block(net, [z_1], text, hdmap, one, steps(1))
    with torch.no_grad():
        assert furthest(z_0, z_1 - net(z_1, 1000.0, text, hdmap)) < 1e-5
