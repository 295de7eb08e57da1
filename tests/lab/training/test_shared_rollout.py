"""The shared rollout: what it computes, against a slow reading of the equations; and where
gradients flow and where they do not.
"""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, initial_weights
from alpasim_plugin.block_fixers.sampling import CONTEXT_STEP, context_level, mixed_source
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.fixers.network.schedule import interpolant
from alpasim_plugin.lab.training.shared_rollout import Objectives, Sample, losses

N = 8
H = 4
W = 4


def noise(name, *shape):
    return torch.from_numpy(stream("rollout", 0, name).standard_normal(shape)).float()


def uniform(name, *shape):
    return torch.from_numpy(stream("rollout", 0, name).uniform(size=shape)).float()


@pytest.fixture(scope="module")
def net():
    return make_net(16)


def make_net(map_channels):
    sizes = DiTSizes(
        width=48,
        blocks=2,
        head_width=24,
        mlp_width=96,
        adaln_rank=8,
        text_width=8,
        context_width=16,
        map_channels=map_channels,
    )
    weights = initial_weights(sizes, 0)
    key = "final_layer.adaln_modulation.2.weight"
    weights[key] = 0.05 * noise(key, *weights[key].shape)
    return CosmosCausalDiT.from_state_dict(weights)


TEXT = noise("text", 1, 1, 8)


def sample(w=5):
    shape = (1, 16, N, H, W)
    return Sample(
        noise("z_r", *shape),
        noise("z_0", *shape),
        noise("z_map", *shape),
        (uniform("m", 1, 1, N, H, W) > 0.3).float(),
        noise("eps", *shape),
        noise("context", *shape),
        uniform("t", 1, N),
        uniform("again", 1, N),
        w,
    )


def at_w(predicted, w):
    """Stand in for a perceptual term: any smooth function of position w alone."""
    return (predicted[:, :, w] * noise("probe", *predicted[:, :, w].shape)).sum()


def velocity(net, s, b, history, x, t):
    """Return a block's velocity by one whole-clip forward: noised history before it, block-causal
    mask, one time a latent.
    """
    level = context_level()
    past = interpolant(history[:, :, : b.start], s.eps_context[:, :, : b.start], level.sigma)
    times = torch.cat([torch.full((1, b.start), CONTEXT_STEP), t], dim=1)
    return net(
        torch.cat([past, x], dim=2), times, TEXT, s.condition[:, :, : b.stop], block_latents=2
    )[:, :, b]


def slow_rollout(net, s):
    z_1 = mixed_source(s.z_r, s.m, s.eps)
    made = torch.zeros_like(z_1[:, :, :0])
    for start in range(0, N, 2):
        b = slice(start, start + 2)
        v = velocity(net, s, b, made, z_1[:, :, b], torch.full((1, 2), 1000.0))
        made = torch.cat([made, z_1[:, :, b] - v], dim=2)
    return made


def test_rollout_and_flow_matching_are_the_equations(net):
    s = sample()
    with torch.no_grad():
        result = losses(net, s, TEXT, Objectives(horizon=0), window=None)
        rollout = slow_rollout(net, s)
        z_1 = mixed_source(s.z_r, s.m, s.eps)
        z_t = interpolant(s.z_0, z_1, s.t[:, None, :, None, None])
        parts = []
        for start in range(0, N, 2):
            b = slice(start, start + 2)
            parts.append(velocity(net, s, b, rollout, z_t[:, :, b], 1000 * s.t[:, b]))
        expected = (torch.cat(parts, dim=2) - (z_1 - s.z_0)).square().mean()
    assert_close(result.rollout, rollout, atol=2e-5, rtol=0)
    assert_close(result.flow, expected, atol=1e-5, rtol=0)
    assert result.perceptual is None
    assert torch.equal(result.total, result.flow)


def test_history_of_every_kind_is_what_its_name_says(net):
    s = sample()
    with torch.no_grad():
        own, clean, again = (
            losses(net, s, TEXT, Objectives(flow=kind, horizon=0)).flow
            for kind in ("own", "clean", "redenoised")
        )
        # a model at almost no noise gives the clean latents back: history as if it were clean
        near = losses(
            net,
            replace(s, t_redenoise=torch.zeros_like(s.t_redenoise)),
            TEXT,
            Objectives(flow="redenoised", horizon=0),
        ).flow
    assert len({float(x) for x in (own, clean, again)}) == 3
    assert_close(near, clean, atol=0, rtol=0)
