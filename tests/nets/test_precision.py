"""Casting and quantising: the same numbers as loading at that precision, islands kept, errors bounded, overflow named."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import nn

from alpasim_plugin.errors import InputError
from alpasim_plugin.nets import CosmosCausalDiT, DiTSizes, TinyDecoder, TinyVAE, WanVAE
from alpasim_plugin.nets.int8 import ACTIVATION_LEVELS, WEIGHT_LEVELS, Int8Linear, quantise_rows, sum_exactly
from alpasim_plugin.nets.layers import Float32Linear
from alpasim_plugin.nets.precision import at_precision, codec_at_precision, text_at_precision, weight_bytes
from tests.nets.codec_cases import SMALL as SMALL_WAN
from tests.nets.codec_cases import clip as video_clip
from tests.nets.dit_cases import clip, stream
from tests.nets.dit_reference import random_weights

WIDE = DiTSizes(128, 3, 32, 256, 16, 8, 16, 4, 3)


@pytest.mark.parametrize("precision", ["fp32", "bf16", "fp16"])
def test_cast_network_is_the_one_loaded_at_that_precision(precision):
    dtype = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}[precision]
    weights, c = random_weights(WIDE), clip(4, WIDE)
    net = CosmosCausalDiT.from_state_dict(weights)
    cast, loaded = at_precision(net, precision), CosmosCausalDiT.from_state_dict(weights, dtype=dtype)
    ours, theirs = cast.state_dict(), loaded.state_dict()
    assert all(ours[key].dtype == theirs[key].dtype and torch.equal(ours[key], theirs[key]) for key in theirs)
    with torch.no_grad():
        assert torch.equal(cast(*c), loaded(*c))
    assert {p.dtype for p in net.parameters()} == {torch.float32}, "the original was touched"
    assert not any(p.requires_grad for p in cast.parameters())


@pytest.mark.parametrize(("precision", "tolerance"), [("fp32", 1e-6), ("bf16", 0.03), ("fp16", 0.004), ("int8", 0.05)])
@pytest.mark.parametrize("folded", [False, True])
def test_error_of_each_precision_through_a_cache(precision, tolerance, folded):
    net, (x, _, text, hdmap) = CosmosCausalDiT.from_state_dict(random_weights(WIDE)), clip(6, WIDE)
    t = torch.full((1, 6), 500.0)
    net = net.folded(500.0) if folded else net
    small, prompt = at_precision(net, precision), net.encode_text(text)
    with torch.no_grad():
        exact = stream(net, net.new_cache(1, 4, 6, window=4), x, t, prompt, hdmap, (2, 2, 2))
        out = stream(small, small.new_cache(1, 4, 6, window=4), x, t, text_at_precision(prompt, precision), hdmap, (2, 2, 2))
    error = float((out - exact).norm() / exact.norm())
    assert error < tolerance
    assert precision == "fp32" or error > 0


def test_int8_replaces_the_blocks_linears_and_nothing_else():
    net = at_precision(CosmosCausalDiT.from_state_dict(random_weights(WIDE)).folded(1000.0), "int8")
    quantised = {name for name, module in net.named_modules() if isinstance(module, Int8Linear)}
    assert len(quantised) == WIDE.blocks * (2 + 4 + 2)  # qkv and output; q, k, v, output; two of the MLP
    assert all(name.startswith("blocks.") for name in quantised)
    plain = CosmosCausalDiT.from_state_dict(random_weights(WIDE))
    assert not any(isinstance(module, Int8Linear) and isinstance(module, Float32Linear) for module in at_precision(plain, "int8").modules())
    assert sum(isinstance(m, Float32Linear) for m in at_precision(plain, "int8").modules()) == 6 * WIDE.blocks + 4


def test_weight_memory_by_precision():
    net = CosmosCausalDiT.from_state_dict(random_weights(DiTSizes(128, 3, 32, 512, 16, 8, 16, 4, 3))).folded(1000.0)
    size = {precision: weight_bytes(at_precision(net, precision).blocks) for precision in ("fp32", "bf16", "fp16", "int8")}
    assert size["fp32"] == weight_bytes(net.blocks)
    assert size["bf16"] == size["fp16"] == size["fp32"] / 2
    assert 0.25 < size["int8"] / size["fp32"] < 0.27


def test_overflow_on_the_way_to_float16_is_named():
    net = CosmosCausalDiT.from_state_dict(random_weights(WIDE))
    with torch.no_grad():
        net.blocks[0].mlp.layer1.weight[0, 0] = 1e5
    with pytest.raises(InputError, match=r"blocks.0.mlp.layer1.weight holds 1e\+05, beyond torch.float16"):
        at_precision(net, "fp16")


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
@pytest.mark.parametrize("codec", [WanVAE.random(SMALL_WAN), TinyVAE.random(), TinyDecoder.random(16, (8, 8, 4, 4), scaled=True)])
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


@pytest.mark.parametrize(("rows", "inputs", "outputs"), [(1, 1, 1), (3, 7, 5), (40, 192, 64), (2, 8192, 9)])
def test_engine_sums_exactly_even_at_the_largest_products(rows, inputs, outputs):
    g = torch.Generator().manual_seed(0)
    layer = Int8Linear(nn.Linear(inputs, outputs))
    layer.weight = torch.randint(-WEIGHT_LEVELS, WEIGHT_LEVELS + 1, (outputs, inputs), dtype=torch.int8, generator=g)
    layer.weight[0] = WEIGHT_LEVELS
    layer.scale = torch.ones(outputs)
    q = torch.randint(-ACTIVATION_LEVELS, ACTIVATION_LEVELS + 1, (rows, inputs), dtype=torch.int8, generator=g)
    for row in (ACTIVATION_LEVELS, -ACTIVATION_LEVELS):
        q[0] = row
        assert torch.equal(layer._sum(q), sum_exactly(q, layer.weight))


def test_layer_is_the_written_out_rounding():
    g = torch.Generator().manual_seed(1)
    linear, x = nn.Linear(24, 10), 3 * torch.randn(2, 5, 24, generator=g)
    with torch.no_grad():
        linear.weight.copy_(torch.randn(10, 24, generator=g))
        linear.bias.copy_(torch.randn(10, generator=g))
        linear.weight[3], x[0, 2] = 0, 0  # an output that is only bias, a row of zeros
        w = linear.weight.double()
        s = w.abs().amax(1, keepdim=True).clamp_min(1e-12) / 63
        a = x.double().abs().amax(-1, keepdim=True).clamp_min(1e-12) / 127
        expected = ((x / a).round() * a) @ ((w / s).round() * s).T + linear.bias
        out = Int8Linear(linear)(x)
    assert float((out - expected).abs().max()) < 1e-4
    assert torch.equal(out[0, 2], linear.bias)
    assert float((out - linear(x)).norm() / linear(x).norm()) < 0.03


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_numbers_that_are_not_finite_stay_visible_in_their_row(value):
    layer, x = Int8Linear(nn.Linear(8, 4)), torch.ones(3, 8)
    x[1, 2] = value
    out = layer(x)
    assert not out[1].isfinite().any()
    assert out[[0, 2]].isfinite().all()


def test_rows_do_not_share_a_scale():
    """A loud token must not cost a quiet one its precision."""
    q, scale = quantise_rows(torch.tensor([[1e-3, -5e-4], [1e3, 5e2]]), 127)
    assert q.tolist() == [[127, -64], [127, 64]]
    assert scale[1] / scale[0] == pytest.approx(1e6)


def test_gradients_are_refused():
    with pytest.raises(InputError, match="train the float network"):
        Int8Linear(nn.Linear(4, 4))(torch.ones(1, 4, requires_grad=True))


def test_layer_that_has_run_can_be_copied_and_pickled():
    layer, x = Int8Linear(nn.Linear(16, 8)), torch.linspace(-1, 1, 32).view(2, 16)
    out = layer(x)
    assert torch.equal(copy.deepcopy(layer)(x), out)
    assert torch.equal(pickle.loads(pickle.dumps(layer))(x), out)


@pytest.mark.gpu
@pytest.mark.parametrize("rows", [1, 17, 300])
def test_cuda_engine_sums_exactly(rows):
    layer = Int8Linear(nn.Linear(190, 70)).cuda()
    q = torch.randint(-127, 128, (rows, 190), dtype=torch.int8, generator=torch.Generator().manual_seed(0))
    expected = sum_exactly(q, layer.weight.cpu()) * layer.scale.cpu()
    assert torch.allclose(layer._sum(q.cuda()).cpu(), expected, rtol=1e-6)
