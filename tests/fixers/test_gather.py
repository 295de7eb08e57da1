"""The fast gathering of what the generator reads equals the readable one."""

import numpy as np
import pytest
import torch

from alpasim_plugin.fixers.gather import CPU, LEAST, _exponential
from alpasim_plugin.fixers.network.pixel_generator import TORCH
from alpasim_plugin.fixers.network.reference_blend import (
    FINER_PX,
    BlendHeads,
    in_floats,
    mix,
    sources_of,
)


def recordings(batch, references, height, width):
    """References that hold, do not, or by half."""
    draw = torch.Generator().manual_seed(height + references)
    out = torch.randint(
        0, 256, (batch, references, height, width, 4), dtype=torch.uint8, generator=draw
    )
    out[..., 3] = torch.tensor([0, 128, 255], dtype=torch.uint8)[(out[..., 3] % 3).long()]
    return out


def heads_of(batch, references, height, width):
    draw = torch.Generator().manual_seed(height + references)
    at2 = (batch, references, height // 2, width // 2)
    sizes = (4, 3.0), (2, 8.0), (12, 0.3)
    return BlendHeads(*(torch.randn(*at2, n, generator=draw) * size for n, size in sizes))


def images_in_range(*shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(shape[1])) * 2 - 1


@pytest.mark.parametrize(
    ("batch", "references", "height", "width"), [(1, 1, 16, 16), (2, 3, 32, 48), (1, 4, 16, 80)]
)
def test_one_pass_mixes_as_the_operations_one_by_one(batch, references, height, width):
    repaired = images_in_range(batch, height, width, 3)
    images = recordings(batch, references, height, width)
    heads = heads_of(batch, references, height, width)
    floats = in_floats(images)
    exact_cells = TORCH.gather_references(images, repaired)
    for one, other in zip(CPU.gather_references(images, repaired), exact_cells, strict=True):
        assert torch.allclose(one, other, atol=2e-6)
    exact = BlendHeads(
        *(part.double() for part in heads[:3])
    )  # in float32 the operations one by one are less exact
    fast = CPU.blend(repaired, images, heads)
    plain = mix(sources_of(repaired.double(), floats.double(), exact))
    for one, other in zip(
        fast, plain, strict=True
    ):  # at the edge of what holds, a rounded offset weighs more than the rounding itself
        assert (one - other).abs().quantile(0.99) < 1e-5
        assert (one - other).abs().max() < 1e-3
    half = BlendHeads(
        heads.weight.bfloat16(), heads.offset_px, heads.correction.bfloat16()
    )  # read as they are
    for one, other in zip(
        CPU.blend(repaired, images, half), mix(sources_of(repaired, floats, half)), strict=True
    ):
        assert torch.allclose(one, other, atol=2e-3)


@pytest.mark.parametrize(
    ("references", "height", "width", "scale"), [(2, 32, 64, 2), (1, 130, 100, 8), (0, 45, 91, 3)]
)
def test_bands_enlarge_as_the_operations_one_by_one(references, height, width, scale):
    rgb = recordings(2, 1, height, width)[:, 0, ..., :3]
    images = None
    seen = CPU.smaller(rgb, scale)
    apart = seen.int() - TORCH.smaller(rgb, scale)
    assert int(apart.abs().max()) <= 1  # halves are rounded to other sides
    assert torch.allclose(*(one.smaller(rgb.float(), scale) for one in (CPU, TORCH)))
    size = [-(-side // (16 * scale)) * 16 for side in (height, width)]
    change = images_in_range(2, *size, 3)
    heads = None
    if references:
        images = recordings(2, references, height, width)
        heads = heads_of(2, references, *size)
        cells = 2, references, -(-height // FINER_PX), -(-width // FINER_PX)
        heads = heads._replace(finer=torch.randn(cells) if scale == 8 else None)
    one, other = (each.enlarge(rgb, change, images, heads, scale) for each in (CPU, TORCH))
    assert one.shape == rgb.shape
    assert ((one.int() - other).abs() > 1).float().mean() < 1e-3
    if not references:  # the change of the render is all there is, here in the middle of squares
        due = rgb[:, 1::3, 1::3] + 127.5 * change[:, : height // 3, : width // 3]
        assert (one[:, 1::3, 1::3] - due.clamp(0, 255)).abs().max() <= 0.51


@pytest.mark.parametrize(
    ("batch", "references", "height", "width"), [(1, 1, 1, 1), (2, 3, 3, 7), (1, 2, 9, 40)]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_references_are_compared_and_moved_as_by_the_operations_one_by_one(
    batch, references, height, width, dtype
):
    draw = torch.Generator().manual_seed(width)

    def features(count, scale, channels):
        shape = count, scale * height, scale * width, channels
        return torch.randn(shape, generator=draw).to(dtype)

    count = batch * references
    alike = features(batch, 1, 16), features(count, 1, 16)
    # Columns of a wider tensor, as a network's heads are.
    moved = features(count, 2, 5)[..., 1:3], features(count, 1, 2)
    tolerance = 1e-5 if dtype == torch.float32 else 2e-2
    for name, arguments in (("likeness", alike), ("offsets", moved)):
        fast, plain = (getattr(operations, name)(*arguments) for operations in (CPU, TORCH))
        assert fast.dtype == plain.dtype
        assert fast.shape == plain.shape
        assert torch.allclose(fast.float(), plain.float(), atol=tolerance, rtol=tolerance)


def test_weights_are_exponentials_also_where_a_float_has_no_smaller_one():
    values = np.linspace(-100, 60, 4001, dtype=np.float32)
    made = np.array([_exponential(value) for value in values], dtype=np.float64)
    due = np.exp(np.maximum(values, LEAST).astype(np.float64))
    allowed = 3e-7 + 1e-7 * np.abs(values)
    assert (np.abs(made / due - 1) < allowed).all()
