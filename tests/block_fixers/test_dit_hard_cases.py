"""Long rollouts, far positions, half precision, the full size without its weights, first
weights.
"""

from __future__ import annotations

import pytest
import torch

from alpasim_plugin.block_fixers.attention import Rope3D, axis_widths
from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.layers import Float32Linear
from alpasim_plugin.block_fixers.sizes import DiTSizes, initial_weights
from alpasim_plugin.core.errors import InputError
from tests.block_fixers.dit_cases import SMALL, clip, furthest, network, stream
from tests.block_fixers.dit_reference import random_weights, rope_angles, velocity

WIDE = DiTSizes(
    width=128,
    blocks=3,
    head_width=32,
    mlp_width=256,
    adaln_rank=16,
    text_width=8,
    context_width=16,
    latent_channels=4,
    map_channels=3,
)


@pytest.mark.parametrize("start", [127, 128, 1000, 10_000])
def test_far_positions_are_right_and_only_differences_matter(start):
    net, c = network(), clip(4)
    with torch.no_grad():
        near, far = net(*c), net(*c, start=start)
    assert furthest(far, velocity(random_weights(SMALL), *c, start=start)) < 1e-5
    assert furthest(far, near) < 2e-5
    cache = net.new_cache(1, 4, 6)
    cache.reset(position=start)
    assert furthest(stream(net, cache, *c, (2, 2)), far) < 1e-5


@pytest.mark.parametrize("head_width", [2, 4, 6, 10, 12, 16, 32, 64, 128])
@pytest.mark.parametrize("ratios", [(1.0, 1.0, 1.0), (3.0, 3.0, 1.0), (2.0, 1.5, 4.0)])
def test_rope_angles_are_the_written_out_ones(head_width, ratios):
    assert sum(axis_widths(head_width)) == head_width
    ours = Rope3D(head_width, ratios).angles(10_000, 2, 3, 2)
    assert (
        furthest(ours.reshape(-1, head_width), rope_angles(10_000, 2, 3, 2, head_width, ratios))
        < 1e-9
    )


def test_odd_heads_have_no_rotation():
    with pytest.raises(InputError, match="use an even head width"):
        axis_widths(7)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float16])
def test_3600_frames_stay_finite_in_constant_memory(dtype):
    net = network(dtype=dtype)
    cache = net.new_cache(1, 2, 2, window=4)
    before = cache.keys.data_ptr(), cache.nbytes
    g = torch.Generator().manual_seed(0)
    text = net.encode_text(torch.randn(1, 2, SMALL.text_width, generator=g))
    z = torch.randn(1, 4, 2, 2, 2, generator=g)
    with torch.no_grad():
        for _ in range(450):  # 2 latents = 8 frames each
            v = net.step(z, 1000.0, text, torch.zeros(1, 3, 2, 2, 2), cache)
            z = (z - v) / (z - v).std()
            assert z.isfinite().all()
    assert cache.position == 900
    assert (cache.keys.data_ptr(), cache.nbytes) == before


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.bfloat16, 0.03), (torch.float16, 0.004)])
def test_half_precision_stays_near_float32(dtype, tolerance):
    weights, c = random_weights(WIDE), clip(6, WIDE)
    exact = velocity(weights, *c)
    net = CosmosCausalDiT.from_state_dict(weights, dtype=dtype)
    with torch.no_grad():
        for v in (
            net(*c),
            stream(net, net.new_cache(1, 4, 6), *c, (2, 2, 2)),
            net.folded(500.0)(c[0], 500.0, *c[2:]),
        ):
            assert v.dtype == torch.float32
            assert v.isfinite().all()
        assert float((net(*c) - exact).norm() / exact.norm()) < tolerance


@pytest.mark.parametrize("route", ["loaded", "cast", "autocast"])
def test_time_and_modulation_stay_float32_in_a_half_precision_network(route):
    net = network(dtype=torch.bfloat16 if route == "loaded" else torch.float32)
    if route == "cast":
        net = net.to(torch.bfloat16)
    seen = []
    for module in net.modules():
        if isinstance(module, Float32Linear):
            module.register_forward_hook(lambda _, i, o: seen.append(o.dtype))
    x, t, text, hdmap = clip(2)
    with torch.autocast("cpu", torch.bfloat16, enabled=route == "autocast"):
        assert net(x, t, text, hdmap).isfinite().all()
    assert set(seen) == {torch.float32}
    if route == "loaded":
        kept = {name for name, p in net.named_parameters() if p.dtype == torch.float32}
        assert kept == {
            name
            for name, _ in net.named_parameters()
            if "adaln" in name or name.startswith("t_embed")
        }


def test_full_size_has_the_published_number_of_parameters():
    with torch.device("meta"):
        net = CosmosCausalDiT(DiTSizes())
    assert sum(p.numel() for p in net.parameters()) == DiTSizes().parameters == 2_059_305_984
    assert sum(p.numel() for p in net.blocks.parameters()) == 1_937_782_784
    assert {
        key: tuple(value.shape) for key, value in net.state_dict().items()
    } == DiTSizes().shapes()


@pytest.mark.slow
def test_full_size_runs_without_numbers_at_544x960():
    sizes = DiTSizes()
    sd = {key: torch.empty(shape, device="meta") for key, shape in sizes.shapes().items()}
    net = CosmosCausalDiT.from_state_dict(sd, dtype=torch.bfloat16).requires_grad_(False)
    assert net.sizes == sizes
    x, text = (
        torch.empty(1, 16, 2, 68, 120, device="meta"),
        torch.empty(1, 512, 100352, device="meta"),
    )
    cache = net.new_cache(1, 68, 120, window=12)
    assert cache.nbytes / 2**30 == pytest.approx(5.23, abs=0.01)  # the published size of this cache
    context = net.encode_text(text)
    for _ in range(2):
        assert net.folded(1000.0).step(x, 1000.0, context, x, cache).shape == x.shape


def test_first_weights_are_bounded_and_repeatable():
    weights = initial_weights(WIDE, seed=5)
    again, other = initial_weights(WIDE, seed=5), initial_weights(WIDE, seed=6)
    layer = weights["blocks.1.mlp.layer2.weight"]
    assert all(torch.equal(weights[key], again[key]) for key in weights)
    assert not torch.equal(layer, other["blocks.1.mlp.layer2.weight"])
    assert layer.abs().max() <= 3 / 16
    assert layer.std() == pytest.approx(1 / 16, rel=0.03)
    assert not weights["final_layer.adaln_modulation.2.weight"].any()
    assert (weights["blocks.0.self_attn.q_norm.weight"] == 1).all()
    assert not weights["crossattn_proj.0.bias"].any()


def test_network_without_output_layer_returns_the_source():
    net = CosmosCausalDiT.from_state_dict(initial_weights(SMALL, 0, zero_velocity=True))
    x, t, text, hdmap = clip(4)
    assert not net(x, t, text, hdmap).any()


def test_folded_network_refuses_another_time_step_and_a_second_folding():
    net = network().folded(1000.0)
    x, t, text, hdmap = clip(2)
    for wrong in (128.0, t):
        with pytest.raises(
            InputError, match=r"folded for t=1000.0[\s\S]*use the network that is not folded"
        ):
            net(x, wrong, text, hdmap)
    with pytest.raises(InputError, match="fold the original network"):
        net.folded(128.0)


def test_folded_copy_does_not_follow_its_original():
    net, (x, _, text, hdmap) = network(), clip(2)
    folded = net.folded(1000.0)
    before = folded(x, 1000.0, text, hdmap)
    with torch.no_grad():
        for p in net.parameters():
            p.mul_(2)
    assert torch.equal(folded(x, 1000.0, text, hdmap), before)


@pytest.mark.filterwarnings("ignore")
def test_int8_linears_leave_the_islands_alone():
    x, t, text, hdmap = clip(4, WIDE)
    net = network(WIDE)
    small = torch.ao.quantization.quantize_dynamic(network(WIDE), {torch.nn.Linear}, torch.qint8)
    with torch.no_grad():
        a, b = net(x, t, text, hdmap), small(x, t, text, hdmap)
    assert float((a - b).norm() / a.norm()) < 0.2
    assert isinstance(small.t_embedder[1].linear_1, Float32Linear)
