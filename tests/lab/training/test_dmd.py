"""DMD: the direction is a divergence's gradient, and the critic sends none to the student."""

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, initial_weights
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.adversarial import AdversarialHead, AdversarialTerm
from alpasim_plugin.lab.training.distillation import ScoreNet
from alpasim_plugin.lab.training.dmd import (
    direction,
    generator_loss,
)

N = 4
TEXT = torch.zeros(1, 1, 8)


def noise(name, *shape):
    return torch.from_numpy(stream("dmd", 0, name).standard_normal(shape)).float()


@pytest.fixture(scope="module")
def net():
    sizes = DiTSizes(
        width=24, blocks=2, head_width=12, mlp_width=32, adaln_rank=4, text_width=8, context_width=8
    )
    weights = initial_weights(sizes, 0)
    key = "final_layer.adaln_modulation.2.weight"
    return CosmosCausalDiT.from_state_dict({**weights, key: 0.05 * noise(key, *weights[key].shape)})


class Gaussian:
    """A normal distribution of clean latents and the exact velocity of its noised samples."""

    def __init__(self, mean, std):
        self.mean = mean
        self.std = std

    def __call__(self, x, sigma):
        s = sigma[:, None, None, None, None].double()
        variance = (1 - s) ** 2 * self.std**2 + s**2
        z_0 = self.mean + (1 - s) * self.std**2 / variance * (x - (1 - s) * self.mean)  # E[z | x]
        return (x - z_0) / s

    def noised(self, sigma):
        """Return mean and deviation of the noised samples."""
        return (1 - sigma) * self.mean, math.hypot((1 - sigma) * self.std, sigma)


def divergence(a, b, sigma):
    """Return KL(a, b) of the noised distributions."""
    (ma, sa), (mb, sb) = a.noised(sigma), b.noised(sigma)
    return math.log(sb / sa) + (sa**2 + (ma - mb) ** 2) / (2 * sb**2) - 0.5


@pytest.mark.parametrize("sigma", [0.1, 0.5, 0.9])
def test_the_direction_is_the_gradient_of_the_divergence_from_the_student_to_the_teacher(
    sigma,
):
    """With z = mean + std a, the gradient of KL to the mean is E[(score_F - score_R)(1 - sigma)],
    score = ((1-sigma) x0 - x) / sigma^2.
    """
    fake = Gaussian(0.7, 0.5)
    real = Gaussian(-0.4, 1.2)
    h = 1e-5
    a = noise("a", 64, 1, 1, 1, 1).double()
    n = noise("n", 64, 1, 1, 1, 1).double()
    a, n = (
        torch.cat([a, -a, a, -a]),
        torch.cat([n, n, -n, -n]),
    )  # means of linear functions are then exact
    levels = torch.full((len(a),), sigma, dtype=torch.float64)
    z = fake.mean + fake.std * a
    g, normaliser = direction(real, fake, z, n, levels)
    plain = g * normaliser[:, None, None, None, None]
    found = float(plain.mean()) * (1 - sigma) ** 2 / sigma**2
    ahead, behind = (divergence(Gaussian(fake.mean + d, fake.std), real, sigma) for d in (h, -h))
    assert found == pytest.approx((ahead - behind) / (2 * h), rel=1e-6)
    mean = torch.tensor(fake.mean, dtype=torch.float64, requires_grad=True)
    generator_loss(mean + fake.std * a, g).backward()
    assert float(mean.grad) == pytest.approx(float(g.mean()), rel=1e-9)


def test_the_head_judges_frozen_trunks_for_the_student_and_trains_them_for_the_critic(
    net,
):
    term = AdversarialTerm(heads=2, inner=8)
    head, score = AdversarialHead(24, 1, 2, 8, seed=0), ScoreNet(net, term.taps)
    x = noise("x", 2, 16, N, 4, 4).requires_grad_(True)
    sigma = torch.tensor([0.2, 0.7])
    condition = torch.zeros(2, 16, N, 4, 4)
    v = score(x, sigma, condition, frozen=True)
    assert_close(v, net(x, 1000 * sigma[:, None], TEXT, condition, block_latents=None))
    score(x, sigma, condition, frozen=True)
    term.generator(head(score.features)).backward()
    assert x.grad.abs().max() > 0
    assert all(p.grad is None for p in net.parameters())

    def logits(x):
        score(x, sigma, condition)
        return head(score.features)

    fake = x.detach() + 1
    xi = noise("xi", *x.shape)
    loss, real = term.critic(logits, x.detach(), fake, logits(fake), xi)
    plain, _ = replace(term, r1=0.0, r2=0.0).critic(logits, x.detach(), fake, logits(fake), xi)
    r1 = (logits(x.detach() + 0.1 * xi) - real).square().mean()
    r2 = 0.5 * 0.001 * ((logits(fake + 0.01 * xi) - logits(fake)) / 0.01).square().mean()
    assert_close(loss, plain + r1 + r2)
    loss.backward()
    assert all(p.grad is not None for p in head.parameters())
    assert net.blocks[0].self_attn.q_proj.weight.grad is not None
    net.zero_grad(set_to_none=True)
    assert head(score.features).shape == (2,)
