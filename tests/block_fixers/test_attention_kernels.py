"""Kernels of attention agree; one that is not there is an error and never replaced in silence."""

from __future__ import annotations

import pytest
import torch

from alpasim_plugin.block_fixers.attention import attention_kernel
from alpasim_plugin.core.errors import InputError
from tests.block_fixers.dit_cases import clip, furthest, network, stream


@pytest.mark.parametrize("name", ["auto", "flash", "math"])
def test_kernels_agree_on_a_cpu(name):
    net, c = network(), clip(6)
    with torch.no_grad():
        expected = stream(net, net.new_cache(1, 4, 6, window=4), *c, (2, 2, 2))
        with attention_kernel(name):
            out = stream(net, net.new_cache(1, 4, 6, window=4), *c, (2, 2, 2))
    assert furthest(out, expected) < 1e-5


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["cudnn", "efficient"])
def test_kernels_that_a_cpu_lacks_are_refused(name):
    with (
        pytest.raises(
            InputError, match=rf"choosing an attention kernel[\s\S]*{name}[\s\S]*use auto"
        ),
        attention_kernel(name),
    ):
        pass


def test_unknown_kernel_is_refused():
    with pytest.raises(InputError, match="take one of auto, flash"), attention_kernel("fast"):
        pass


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["flash", "cudnn", "efficient", "math"])
def test_kernels_agree_on_a_gpu(name):
    q, k, v = (
        torch.randn(1, 4, n, 64, device="cuda", dtype=torch.bfloat16) for n in (200, 600, 600)
    )
    exact = torch.nn.functional.scaled_dot_product_attention(q.double(), k.double(), v.double())
    with attention_kernel(name, "cuda", torch.bfloat16):
        out = torch.nn.functional.scaled_dot_product_attention(q, k, v)
    assert furthest(out, exact) < 0.02
