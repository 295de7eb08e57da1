"""Casting: the same numbers as loading at that precision, islands kept, errors bounded, overflow
named.
"""

from __future__ import annotations

import pytest
import torch

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.networks import (
    at_precision,
    codec_at_precision,
    text_at_precision,
    weight_bytes,
)
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.taehv import TinyDecoder
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.wan_vae import WanVAE
from alpasim_plugin.core.errors import InputError
from tests.block_fixers.codec_cases import SMALL as SMALL_WAN
from tests.block_fixers.codec_cases import clip as video_clip
from tests.block_fixers.dit_cases import clip, stream
from tests.block_fixers.dit_reference import random_weights

WIDE = DiTSizes(128, 3, 32, 256, 16, 8, 16, 4, 3)


@pytest.mark.parametrize("precision", ["fp32", "bf16", "fp16"])
def test_cast_network_is_the_one_loaded_at_that_precision(precision):
    dtype = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}[precision]
    weights, c = random_weights(WIDE), clip(4, WIDE)
    net = CosmosCausalDiT.from_state_dict(weights)
    cast, loaded = (
        at_precision(net, precision),
        CosmosCausalDiT.from_state_dict(weights, dtype=dtype),
    )
    ours, theirs = cast.state_dict(), loaded.state_dict()
    assert all(
        ours[key].dtype == theirs[key].dtype and torch.equal(ours[key], theirs[key])
        for key in theirs
    )
    with torch.no_grad():
        assert torch.equal(cast(*c), loaded(*c))
    assert {p.dtype for p in net.parameters()} == {torch.float32}, "the original was touched"
    assert not any(p.requires_grad for p in cast.parameters())


@pytest.mark.parametrize(
    ("precision", "tolerance"), [("fp32", 1e-6), ("bf16", 0.03), ("fp16", 0.004)]
)
@pytest.mark.parametrize("folded", [False, True])
def test_error_of_each_precision_through_a_cache(precision, tolerance, folded):
    net, (x, _, text, hdmap) = CosmosCausalDiT.from_state_dict(random_weights(WIDE)), clip(6, WIDE)
    t = torch.full((1, 6), 500.0)
    net = net.folded(500.0) if folded else net
    small, prompt = at_precision(net, precision), net.encode_text(text)
    with torch.no_grad():
        exact = stream(net, net.new_cache(1, 4, 6, window=4), x, t, prompt, hdmap, (2, 2, 2))
        out = stream(
            small,
            small.new_cache(1, 4, 6, window=4),
            x,
            t,
            text_at_precision(prompt, precision),
            hdmap,
            (2, 2, 2),
        )
    error = float((out - exact).norm() / exact.norm())
    assert error < tolerance
    assert precision == "fp32" or error > 0


def test_weight_memory_by_precision():
    net = CosmosCausalDiT.from_state_dict(
        random_weights(DiTSizes(128, 3, 32, 512, 16, 8, 16, 4, 3))
    ).folded(1000.0)
    size = {
        precision: weight_bytes(at_precision(net, precision).blocks)
        for precision in ("fp32", "bf16", "fp16")
    }
    assert size["fp32"] == weight_bytes(net.blocks)
    assert size["bf16"] == size["fp16"] == size["fp32"] / 2


def test_overflow_on_the_way_to_float16_is_named():
    net = CosmosCausalDiT.from_state_dict(random_weights(WIDE))
    with torch.no_grad():
        net.blocks[0].mlp.layer1.weight[0, 0] = 1e5
    with pytest.raises(
        InputError, match=r"blocks.0.mlp.layer1.weight holds 1e\+05, beyond torch.float16"
    ):
        at_precision(net, "fp16")


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
@pytest.mark.parametrize(
    "codec",
    [WanVAE.random(SMALL_WAN), TinyVAE.random(), TinyDecoder.random(16, (8, 8, 4, 4), scaled=True)],
)
def test_codecs_are_cast_and_their_constants_are_not(codec, precision):
    cast = codec_at_precision(codec, precision)
    assert cast.dtype == {"bf16": torch.bfloat16, "fp16": torch.float16}[precision]
    assert codec.dtype == torch.float32
    assert {b.dtype for b in cast.buffers()} <= {torch.float32}
    z = torch.randn(1, 16, 2, 2, 2, generator=torch.Generator().manual_seed(0))
    exact, out = codec.decode(z), cast.decode(z)
    assert float((out - exact).norm() / exact.norm()) < (0.05 if precision == "bf16" else 0.006)
    if not isinstance(codec, TinyDecoder):
        video = video_clip(5, 16, 16)
        exact, out = codec.encode(video), cast.encode(video)
        assert float((out - exact).norm() / exact.norm()) < (0.05 if precision == "bf16" else 0.006)
