"""Small networks and inputs shared by the transformer's tests."""

import torch

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.sizes import DiTSizes
from tests.block_fixers.dit_reference import random_weights

SMALL = DiTSizes(
    width=24,
    blocks=2,
    head_width=12,
    mlp_width=40,
    adaln_rank=5,
    text_width=7,
    context_width=9,
    latent_channels=4,
    map_channels=3,
)


def network(sizes=SMALL, seed=0, **options):
    return CosmosCausalDiT.from_state_dict(random_weights(sizes, seed), **options)


def clip(
    frames,
    sizes=SMALL,
    batch=1,
    height=4,
    width=6,
    tokens=3,
    seed=1,
):
    """Return x, t (one step per block of 2), text, hdmap."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(batch, sizes.latent_channels, frames, height, width, generator=g)
    t = (1000 * torch.rand(batch, -(-frames // 2), generator=g)).repeat_interleave(2, 1)[:, :frames]
    text = torch.randn(batch, tokens, sizes.text_width, generator=g)
    hdmap = torch.randn(batch, sizes.condition_channels, frames, height, width, generator=g)
    return x, t, text, hdmap


def stream(net, cache, x, t, text, hdmap, blocks, mask=None):
    """Run a clip block by block, each forward kept; ``blocks`` lists their lengths."""
    out = []
    start = 0
    for latents in blocks:
        cut = slice(start, start + latents)
        m = None if mask is None else mask[:, :, cut]
        out.append(net.step(x[:, :, cut], t[:, cut], text, hdmap[:, :, cut], cache, True, m))
        start += latents
    assert start == x.shape[2]
    return torch.cat(out, dim=2)


def furthest(a, b):
    """Largest absolute difference."""
    return float((a.detach().double() - b.detach().double()).abs().max())
