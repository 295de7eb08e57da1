"""The fast gathering of what the generator reads equals the readable one."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from alpasim_plugin.fixers.gather import CPU
from alpasim_plugin.fixers.network.pixel_generator import TORCH, PixelState
from alpasim_plugin.fixers.network.reference_blend import BlendHeads, in_floats, mix, sources_of


def images(
    batch: int, height: int, width: int, hidden: int
) -> tuple[Tensor, Tensor, Tensor, PixelState]:
    draw = torch.Generator().manual_seed(batch + height + width + hidden)

    def image(h: int, w: int, channels: int) -> Tensor:
        return torch.rand(batch, h, w, channels, generator=draw) * 2 - 1

    render, sdmap, output, last = (image(height, width, 3) for _ in range(4))
    state = PixelState(
        output,
        last,
        image(height // 4, width // 4, hidden),
        render.new_zeros(batch, height, width, 1),
    )
    return render, image(height, width, 1).abs(), sdmap, state


def recordings(batch: int, references: int, height: int, width: int) -> Tensor:
    """References that hold, do not, or by half."""
    draw = torch.Generator().manual_seed(height + references)
    out = torch.randint(
        0, 256, (batch, references, height, width, 4), dtype=torch.uint8, generator=draw
    )
    out[..., 3] = torch.tensor([0, 128, 255], dtype=torch.uint8)[(out[..., 3] % 3).long()]
    return out


@pytest.mark.parametrize(
    ("batch", "height", "width", "hidden"), [(1, 16, 16, 16), (3, 32, 48, 16), (2, 16, 80, 0)]
)
@pytest.mark.parametrize("noisy", [True, False])
def test_one_pass_gathers_the_same_bits(batch, height, width, hidden, noisy):
    render, opacity, sdmap, state = images(batch, height, width, hidden)
    source = render * 0.25 if noisy else render
    given = render, opacity, sdmap, state, source
    fast, plain = CPU.gather_cells(*given), TORCH.gather_cells(*given)
    assert torch.equal(fast.coarse, plain.coarse)
    assert torch.equal(fast.fine, plain.fine)


def test_views_of_larger_images_and_values_that_are_not_numbers_pass_through():
    render, opacity, sdmap, state = images(2, 32, 64, 16)
    render[0, 3, 5, 1], opacity[1, 0, 0, 0] = float("nan"), float("inf")
    half = slice(None), slice(0, 16), slice(16, 48)
    views = (
        render[half],
        opacity[half],
        sdmap[half],
        state._replace(
            output=state.output[half], render=state.render[half], hidden=state.hidden[:, :4, :8]
        ),
    )
    fast, plain = CPU.gather_cells(*views, views[2]), TORCH.gather_cells(*views, views[2])
    assert torch.equal(fast.coarse.nan_to_num(7.0), plain.coarse.nan_to_num(7.0))
    assert torch.equal(fast.fine.nan_to_num(7.0), plain.fine.nan_to_num(7.0))


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


@pytest.mark.parametrize(
    ("batch", "references", "height", "width", "channels"),
    [(1, 1, 1, 1, 16), (2, 3, 9, 16, 16), (1, 2, 4, 20, 5)],
)
def test_features_are_compared_as_the_operations_one_by_one_do(
    batch, references, height, width, channels
):
    draw = torch.Generator().manual_seed(width)
    sought = torch.randn(batch, height, width, channels, generator=draw)
    shown = torch.randn(batch * references, height, width, channels, generator=draw)
    assert torch.allclose(CPU.likeness(sought, shown), TORCH.likeness(sought, shown), atol=1e-6)
    coarse = sought.bfloat16(), shown.bfloat16()
    exact = TORCH.likeness(*(x.double() for x in coarse))
    assert CPU.likeness(*coarse).dtype == torch.bfloat16
    assert torch.allclose(
        CPU.likeness(*coarse).double(), exact, rtol=2**-8, atol=1e-6
    )  # rounded once, where operations round each product


@pytest.mark.parametrize(("images", "height", "width"), [(1, 2, 2), (3, 8, 16), (2, 6, 22)])
def test_offsets_are_joined_as_the_operations_one_by_one_do(images, height, width):
    draw = torch.Generator().manual_seed(width)
    at2 = torch.randn(images, height, width, 2, generator=draw) * 3
    at4 = torch.randn(images, height // 2, width // 2, 2, generator=draw)
    at2[0, 0, 0], at2[0, 1, 1] = torch.tensor([300.0, -300.0]), torch.tensor([1e-4, -0.0])
    for dtype in (torch.float32, torch.bfloat16):
        said = at2.to(dtype), at4.to(dtype)
        assert torch.allclose(CPU.offsets(*said), TORCH.offsets(*said), atol=2e-5)


def test_weights_over_all_magnitudes_blend_as_in_float64():
    weight = torch.linspace(-100, 59, 8 * 8 * 4).view(1, 1, 8, 8, 4)
    draw = torch.Generator().manual_seed(5)
    repaired, images = torch.rand(1, 16, 16, 3, generator=draw), recordings(1, 1, 16, 16)
    heads = BlendHeads(weight, torch.zeros(1, 1, 8, 8, 2), torch.zeros(1, 1, 8, 8, 12))
    out, recorded = CPU.blend(repaired, images, heads, 1)
    exact = mix(
        sources_of(
            repaired.double(),
            in_floats(images).double(),
            BlendHeads(*(part.double() for part in heads)),
        )
    )
    assert torch.allclose(out.double(), exact[0], atol=1e-6)
    assert torch.allclose(recorded.double(), exact[1], atol=1e-6)
