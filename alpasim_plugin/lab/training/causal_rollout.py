"""A few-step rollout of the causal generator that carries gradients: the student's own clips, as
its deployment makes them.

    z^i = G(z^i_1 | history^<i)        block by block, one to n flow steps; a gradient through the last step of every block alone

What the history holds decides where gradients go. With ``finalise`` the finished latents are
written by a forward without gradient, so none crosses from one block to another (Self-Forcing).
With ``last-forward`` the keys and values of the last step stay, graph and all, so a block's loss
reaches every block before it (ArtiFixer).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.block_fixers.kv_cache import BlockCache
from alpasim_plugin.block_fixers.sampling import finalise, flow_step
from alpasim_plugin.fixers.network.schedule import NoiseLevel, interpolant
from alpasim_plugin.lab.training.graph_cache import GraphCache
from alpasim_plugin.lab.training.recipes.recipe import Attention


def causal_rollout(
    net: CosmosCausalDiT,
    sources: Sequence[Tensor],
    schedule: Sequence[NoiseLevel],
    eps_context: Tensor,
    text: Tensor | TextContext,
    condition: Tensor,
    attention: Attention,
    gradient_latents: int | None = None,
) -> Tensor:
    """Roll the generator out over whole clips.

    Args:
        net: The generator.
        sources: ``z_1`` of every step, each ``(B, C, N, H, W)`` and mixed with noise of its own
            (Eq. 1).
        schedule: Noise levels of the steps, as many as sources: the last is the exit step, whose
            prediction is kept.
        eps_context: Noise of the cache write ``(B, C, N, H, W)``; used with ``finalise``.
        text, condition: As the network takes them.
        attention: Blocks, window, sink and history, as at deployment.
        gradient_latents: Latents at the clip's end whose blocks carry gradients; None for all.

    Returns:
        ``(B, C, N, H, W)`` clean latents.
    """
    b, _, n, h, w = sources[0].shape
    cache = GraphCache.of(net, b, h, w, attention.window, attention.sink)
    first = 0 if gradient_latents is None else n - gradient_latents
    made = []
    for start in range(0, n, attention.block_latents):
        block = slice(start, min(start + attention.block_latents, n))
        with torch.set_grad_enabled(torch.is_grad_enabled() and block.start >= first):
            made.append(
                _block(
                    net,
                    [z_1[:, :, block] for z_1 in sources],
                    schedule,
                    text,
                    condition[:, :, block],
                    cache,
                )
            )
        if attention.history == "finalise":
            with torch.no_grad():
                finalise(
                    net, made[-1], eps_context[:, :, block], text, condition[:, :, block], cache
                )
        else:
            cache.commit()
    return torch.cat(made, dim=2)


def _block(
    net: CosmosCausalDiT,
    sources: Sequence[Tensor],
    schedule: Sequence[NoiseLevel],
    text: Tensor | TextContext,
    condition: Tensor,
    cache: BlockCache,
) -> Tensor:
    """Denoise a block and leave it open: steps before the last without gradient, each from the last
    prediction and a fresh source.
    """
    z = sources[0]
    with torch.no_grad():
        for level, z_1, following in zip(schedule, sources[1:], schedule[1:], strict=False):
            z_0 = flow_step(
                z, net.step(z, level.t, text, condition, cache, write=False), level.sigma
            )
            z = interpolant(z_0, z_1, following.sigma)
    return flow_step(
        z, net.step(z, schedule[-1].t, text, condition, cache, write=False), schedule[-1].sigma
    )
