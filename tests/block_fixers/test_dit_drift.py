"""Long rollouts in half precision: the error against float32 by index, at far positions, and when a
fixer feeds on its own history.
"""

from __future__ import annotations

import pytest
import torch

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.networks import Precision, at_precision, text_at_precision
from alpasim_plugin.block_fixers.sizes import DiTSizes
from tests.block_fixers.dit_cases import clip
from tests.block_fixers.dit_reference import random_weights, velocity

TINY = DiTSizes(32, 2, 16, 48, 4, 6, 8, 4, 3)
SHIPPED = DiTSizes(192, 6, 48, 384, 16, 64, 64)
LIMITS = {"bf16": 0.03, "fp16": 0.004}


def errors(
    sizes: DiTSizes, precision: Precision, blocks: int, height: int, width: int, start: int = 0
) -> torch.Tensor:
    """Return the relative error of every block of a rollout whose history is kept at that
    precision, ``(blocks,)``.
    """
    net = CosmosCausalDiT.from_state_dict(random_weights(sizes)).folded(1000.0)
    small = at_precision(net, precision)
    g = torch.Generator().manual_seed(3)
    text = net.encode_text(torch.randn(1, 2, sizes.text_width, generator=g))
    prompts = text, text_at_precision(text, precision)
    caches = [n.new_cache(1, height, width, window=4) for n in (net, small)]
    before = [(c.keys.data_ptr(), c.nbytes) for c in caches]
    out = []
    with torch.inference_mode():
        for cache in caches:
            cache.reset(start)
        for _ in range(blocks):
            x = torch.randn(1, sizes.latent_channels, 2, height, width, generator=g)
            hdmap = torch.randn(1, sizes.map_channels, 2, height, width, generator=g)
            exact, v = (
                n.step(x, 1000.0, p, hdmap, c)
                for n, p, c in zip((net, small), prompts, caches, strict=True)
            )
            assert v.isfinite().all()
            out.append((v - exact).norm() / exact.norm())
    assert [(c.keys.data_ptr(), c.nbytes) for c in caches] == before
    assert caches[1].position == start + 2 * blocks
    return torch.stack(out)


def check_no_growth(error: torch.Tensor, precision: Precision) -> None:
    """The last tenth must not be worse than the second (the first fills the window)."""
    tenth = len(error) // 10
    early, late = error[tenth : 2 * tenth].mean(), error[-tenth:].mean()
    assert float(error.max()) < 2 * LIMITS[precision]
    assert float(error.mean()) < LIMITS[precision]
    assert float(late / early) < 1.15, (float(early), float(late))


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_error_does_not_grow_over_900_latents(precision):
    check_no_growth(errors(TINY, precision, 450, 2, 4), precision)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_error_does_not_grow_over_900_latents_at_the_shipped_size(precision):
    error = errors(SHIPPED, precision, 450, 8, 12)
    print(precision, [f"{part.mean():.2e}" for part in error.split(45)])
    check_no_growth(error, precision)


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_error_at_position_ten_thousand_is_that_at_the_start(precision):
    near, far = (errors(TINY, precision, 8, 4, 6, start).mean() for start in (0, 9_984))
    assert float(far / near) == pytest.approx(1, abs=0.3)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_network_at_position_ten_thousand_is_the_written_out_one(dtype):
    """Rounding the position itself to bfloat16 would turn it by up to 32 latents."""
    weights, c = random_weights(TINY), clip(4, TINY)
    net = CosmosCausalDiT.from_state_dict(weights, dtype=dtype)
    expected = velocity(weights, *c, start=10_000)
    with torch.no_grad():
        v = net(*c, start=10_000)
        wrong = net(*c, block_latents=1, start=10_000)
    assert float((v - expected).norm() / expected.norm()) < (
        0.03 if dtype == torch.bfloat16 else 0.004
    )
    assert float((wrong - expected).norm() / expected.norm()) > 0.1
