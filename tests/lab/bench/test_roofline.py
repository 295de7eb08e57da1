"""Counted work equals torch's own count and the formulas of the transformer; both give the
published figures.
"""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.taehv import TinyDecoder
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.wan_vae import WanVAE
from alpasim_plugin.block_fixers.wan_vae_blocks import ChannelNorm
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.op_counter import Op, OpCounter
from alpasim_plugin.lab.bench.roofline import DEVICES, device_of
from tests.block_fixers.codec_cases import SMALL, noise
from tests.block_fixers.codec_cases import clip as video_clip
from tests.block_fixers.dit_reference import random_weights
from tests.examples import first_rows_of
from tests.lab.bench.dit_work import cache_bytes, forward_work

SIZES = DiTSizes(96, 3, 32, 160, 8, 12, 24, 4, 3)
TOKENS = 15  # 6 x 10 latents


def inputs(frames: int, text_tokens: int, batch: int = 1):
    g = torch.Generator().manual_seed(0)
    x = torch.randn(batch, 4, frames, 6, 10, generator=g)
    return (
        x,
        torch.randn(1, text_tokens, 12, generator=g),
        torch.randn(batch, 3, frames, 6, 10, generator=g),
    )


def torch_counts(run) -> int:
    """Return torch's own count, with attention as plain products: its fused kernel for CPUs is not
    counted.
    """
    with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):
        run()
    return counter.get_total_flops()


@pytest.mark.parametrize("folded", [True, False])
@pytest.mark.parametrize(
    ("text_tokens", "batch", "window"), first_rows_of([(7, 2, 4), (1, 1, 6), (5, 1, 2)])
)
def test_formula_counter_and_torch_agree_on_a_steady_block(folded, text_tokens, batch, window):
    net = CosmosCausalDiT.from_state_dict(random_weights(SIZES)).requires_grad_(False)
    net = net.folded(1000.0) if folded else net
    x, text, hdmap = inputs(2, text_tokens, batch)
    prompt, cache = net.encode_text(text), net.new_cache(batch, 6, 10, window=window)
    for _ in range(window // 2):
        net.step(x, 1000.0, prompt, hdmap, cache)
    with torch.inference_mode(), OpCounter() as counter:
        net.step(x, 1000.0, prompt, hdmap, cache, False)
    work = forward_work(SIZES, TOKENS, 2, window, text_tokens, folded, 4, batch)
    assert (
        work.flops
        == counter.flops
        == torch_counts(lambda: net.step(x, 1000.0, prompt, hdmap, cache, False))
    )
    assert work.self_attention == 4 * 3 * (2 * TOKENS * batch) * (window * TOKENS) * 96
    assert (
        cache_bytes(SIZES, TOKENS, window, batch, 4)
        == cache.nbytes
        == cache.keys.nbytes + cache.values.nbytes
    )


def test_weights_in_the_formula_are_the_folded_blocks_weights():
    net = CosmosCausalDiT.from_state_dict(random_weights(SIZES)).folded(1000.0)
    of_prompt = ("cross_attn.k_proj", "cross_attn.v_proj")
    kept = [
        p
        for name, p in net.blocks.named_parameters()
        if p.ndim == 2 and not any(part in name for part in of_prompt)
    ]
    assert forward_work(SIZES, TOKENS, text_tokens=9, width_bytes=4).weight_bytes == 4 * sum(
        p.numel() for p in kept
    )


CODECS = {
    "wan": WanVAE.random(SMALL),
    "tiny": TinyVAE.random(),
    "taehv": TinyDecoder.random(16, (16, 8, 8, 4)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CODECS)
def test_counter_and_torch_agree_on_codecs(name):
    codec = CODECS[name].requires_grad_(False)
    z, video = noise(1, 16, 2, 4, 4), video_clip(5, 32, 32)
    for run in [
        lambda: codec.decode(z),
        *([lambda: codec.encode(video)] if name != "taehv" else []),
    ]:
        with torch.inference_mode(), OpCounter() as counter:
            run()
        assert counter.flops == torch_counts(run) > 0


def test_work_on_the_meta_device_is_the_work_on_a_real_one():
    sd = random_weights(SIZES)
    counted = []
    for device in ("cpu", "meta"):
        net = CosmosCausalDiT.from_state_dict(
            {k: v.to(device) for k, v in sd.items()}, dtype=torch.bfloat16
        ).requires_grad_(False)
        x, text, hdmap = (part.to(device) for part in inputs(2, 5))
        cache = net.new_cache(1, 6, 10, window=2)
        prompt = net.encode_text(text)
        with torch.inference_mode(), OpCounter() as counter:
            net.step(x, 1000.0, prompt, hdmap, cache)
        counted.append(counter)
    assert counted[0].flops == counted[1].flops
    assert counted[1].bytes == pytest.approx(counted[0].bytes, rel=0.05)


def test_counted_bytes_are_those_of_the_operands():
    a = torch.zeros(6, 4)
    b = torch.zeros(4, 3)
    x = torch.zeros(8, 1)
    with torch.inference_mode(), OpCounter() as counter:
        product = a @ b
        _ = product.t()[1:]  # views
        _ = x.expand(8, 100) + 1.0
        buffer = torch.empty(1000, 3)
        buffer.index_copy_(0, torch.tensor([1, 5]), torch.ones(2, 3))
    found = {op.name: op.bytes for op in counter.ops}
    assert found["matmul"] == 4 * (24 + 12 + 18)
    assert found["add"] == 4 * (8 + 800)
    assert found["index_copy_"] == 2 * 24 + 16
    assert "t" not in found
    assert "slice" not in found


def test_peak_is_what_was_made_inside_and_alive_at_once():
    kept = torch.zeros(1000)
    with torch.inference_mode(), OpCounter() as counter:
        a = torch.zeros(500)
        b = a + 1  # 4000 bytes alive
        del a
        c = b * 2  # 4000 again
        c.add_(1)
        view = c[1:]
        del b, c
        d = torch.zeros(250)  # 2000 by the view, 1000 here
        kept.mul_(2)
        _ = kept[:10]
    assert counter.peak_bytes == 4000
    assert len(view) == 499
    assert len(d) == 250


def test_attention_is_one_operation_that_never_holds_its_scores():
    q, k = torch.empty(1, 2, 4096, 16, device="meta"), torch.empty(1, 2, 8192, 16, device="meta")
    with torch.inference_mode(), OpCounter() as counter:
        out = nn.functional.scaled_dot_product_attention(q, k, k)
    assert out.shape == q.shape
    assert [(op.name, op.flops, op.bytes) for op in counter.ops] == [
        (
            "scaled_dot_product_attention",
            4 * 2 * 4096 * 8192 * 16,
            4 * 2 * 16 * (2 * 4096 + 2 * 8192),
        )
    ]


@pytest.mark.parametrize(
    ("height", "width", "window", "linear", "self_attention", "cross", "total", "ms"),
    [
        (544, 960, 12, 13.4, 22.9, 0.5, 36.8, 37),
        (544, 960, 6, 13.4, 11.5, 0.5, 25.4, 26),
        (544, 960, 4, 13.4, 7.6, 0.5, 21.5, 22),
        (704, 1280, 6, 23.1, 34.1, 0.8, 58.1, 59),
    ],
)
def test_full_size_forward_has_the_published_work(
    height, width, window, linear, self_attention, cross, total, ms
):
    work = forward_work(DiTSizes(), height // 16 * (width // 16), 2, window, 512)
    terms = (work.linear, work.self_attention, work.cross_attention, work.flops)
    for found, published in zip(terms, (linear, self_attention, cross, total), strict=True):
        assert found / 1e12 == pytest.approx(published, abs=0.1)
    assert work.flops / DEVICES["h200"].half * 1e3 == pytest.approx(ms, abs=0.6)


def test_floors_of_operations_with_known_work():
    device = device_of("100:10:1000:16")  # 100 and 10 TFLOP/s, 1 TB/s
    ops = [
        Op("mm", 10**9, 10**6, torch.bfloat16),
        Op("mm", 10**9, 10**6, torch.float32),
        Op("add", 0, 10**9, torch.float32),
    ]
    assert device.compute_floor_s(ops) == pytest.approx(1e-5 + 1e-4)
    assert device.eager_floor_s(ops) == pytest.approx(1e-5 + 1e-4 + 1e-3)


def test_unknown_devices_are_refused():
    assert device_of("H200") is DEVICES["h200"]
    for name in ("b300", "1:2:3", "1:2:3:-5", "a:b:c:d"):
        with pytest.raises(InputError, match="choosing a device for the roofline"):
            device_of(name)


def test_norm_of_accelerators_is_the_written_out_norm():
    layer, x = ChannelNorm(24).requires_grad_(False), noise(2, 3, 4, 5, 24)
    layer.gamma.copy_(noise(24, 1, 1, 1))
    x[0, 0], x[0, 1], x[1, 0] = 0, 1e-6, 1e4
    assert float((layer.fused(x) - layer.reference(x)).abs().max()) < 1e-5
    half = x.bfloat16().clamp(-100, 100)
    assert float((layer.fused(half).float() - layer.reference(half).float()).abs().max()) < 0.04
