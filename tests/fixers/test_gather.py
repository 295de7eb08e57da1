"""The fast gathering of what the generator reads equals the readable one."""

import pytest
import torch

from alpasim_plugin.fixers.gather import CPU
from alpasim_plugin.fixers.network.pixel_generator import TORCH
from alpasim_plugin.fixers.network.reference_blend import BlendHeads, in_floats, mix, sources_of


def recordings(batch, references, height, width):
    """References that hold, do not, or by half."""
    draw = torch.Generator().manual_seed(height + references)
    out = torch.randint(
        0, 256, (batch, references, height, width, 4), dtype=torch.uint8, generator=draw
    )
    out[..., 3] = torch.tensor([0, 128, 255], dtype=torch.uint8)[(out[..., 3] % 3).long()]
    return out


@pytest.mark.parametrize(
    ("batch", "references", "height", "width", "scale"),
    [
        (1, 1, 16, 16, 1),
        (2, 3, 32, 48, 1),
        (1, 4, 16, 80, 1),
        (2, 2, 32, 64, 2),
        (1, 1, 48, 96, 3),
        (1, 2, 32, 64, 8),
    ],
)
def test_one_pass_mixes_as_the_operations_one_by_one(batch, references, height, width, scale):
    draw = torch.Generator().manual_seed(height + references)
    repaired = torch.rand(batch, height, width, 3, generator=draw) * 2 - 1
    images = recordings(batch, references, height, width)
    at2 = (batch, references, height // (2 * scale), width // (2 * scale))
    heads = BlendHeads(
        *(
            torch.randn(*at2, n, generator=draw) * size
            for n, size in ((4, 3.0), (2, 8.0), (12, 0.3))
        )
    )
    seen, floats = repaired[:, : height // scale, : width // scale], in_floats(images)
    exact_cells = TORCH.gather_references(images, seen, scale)
    for one, other in zip(CPU.gather_references(images, seen, scale), exact_cells, strict=True):
        assert torch.allclose(one, other, atol=2e-6)
    exact = BlendHeads(
        *(part.double() for part in heads)
    )  # in float32 the operations one by one are less exact
    fast, plain = (
        CPU.blend(repaired, images, heads, scale),
        mix(sources_of(repaired.double(), floats.double(), exact, scale)),
    )
    for one, other in zip(
        fast, plain, strict=True
    ):  # at the edge of what holds, a rounded offset weighs more than the rounding itself
        assert float((one - other).abs().quantile(0.99)) < 1e-5
        assert float((one - other).abs().max()) < 1e-3
    half = BlendHeads(
        heads.weight.bfloat16(), heads.offset_px, heads.correction.bfloat16()
    )  # read as they are
    for one, other in zip(
        CPU.blend(repaired, images, half, scale),
        mix(sources_of(repaired, floats, half, scale)),
        strict=True,
    ):
        assert torch.allclose(one, other, atol=2e-3)
