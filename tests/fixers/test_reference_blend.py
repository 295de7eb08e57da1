"""What a generator in pixels makes of references: nothing where there is none, the same in any
order, and no harm where none holds.
"""

import pytest
import torch

from alpasim_plugin.fixers.gather import CPU
from alpasim_plugin.fixers.network.finer_weights import FinerWeights
from alpasim_plugin.fixers.network.pixel_generator import PixelGenerator, PixelSizes
from alpasim_plugin.fixers.network.reference_blend import (
    BlendHeads,
    _sampled,
    enlarged,
    in_floats,
)

SIZES = PixelSizes((16, 16, 16), blend=8)
HEIGHT = 32
WIDTH = 64


def trained_like(seed=0):
    """A network none of whose layers is zero, as after training."""
    net = PixelGenerator.random(SIZES, seed).eval().requires_grad_(False)
    draw = torch.Generator().manual_seed(seed)
    for parameter in net.blend.parameters():
        parameter.add_(0.2 * torch.randn(parameter.shape, generator=draw))
    return net


def inputs(references, batch=1, seed=0):
    draw = torch.Generator().manual_seed(seed)
    render, sdmap = (torch.rand(batch, HEIGHT, WIDTH, 3, generator=draw) * 2 - 1 for _ in range(2))
    images = torch.rand(batch, references, HEIGHT, WIDTH, 4, generator=draw)
    images[..., :3] = images[..., :3] * 2 - 1
    images[..., 3:] = (images[..., 3:] > 0.3).float()
    return render, torch.ones(batch, HEIGHT, WIDTH, 1), sdmap, images


def call(net, render, opacity, sdmap, references):
    out = net(render, opacity, sdmap, net.start(render), None, None, references)
    return out


def test_references_that_hold_nowhere_are_as_good_as_none():
    net = trained_like()
    render, opacity, sdmap, images = inputs(3)
    images[..., 3] = 0
    none, state = call(net, render, opacity, sdmap, None)
    nowhere, _ = call(net, render, opacity, sdmap, images)
    assert torch.allclose(none, nowhere, atol=1e-3)
    assert float(state.recorded.max()) == 0


def test_the_order_of_references_does_not_matter():
    net = trained_like()
    render, opacity, sdmap, images = inputs(4)
    one, _ = call(net, render, opacity, sdmap, images)
    other, _ = call(net, render, opacity, sdmap, images[:, [2, 0, 3, 1]])
    assert torch.allclose(one, other, atol=1e-5)


def test_finer_weights_follow_the_order_of_references_and_begin_as_none():
    draw = torch.Generator().manual_seed(0)
    net = FinerWeights(8).requires_grad_(False)
    rgb, images = (
        torch.randint(0, 256, shape, dtype=torch.uint8, generator=draw)
        for shape in ((2, HEIGHT, WIDTH, 3), (2, 3, HEIGHT, WIDTH, 4))
    )
    change = torch.zeros(2, 32, 48, 3)
    weight = torch.randn(2, 3, 16, 24, 4, generator=draw)
    assert not net(rgb, images, change, weight, 6).any()
    for parameter in net.parameters():
        parameter.add_(0.2 * torch.randn(parameter.shape, generator=draw))
    order = [2, 0, 1]
    added = net(rgb, images, change, weight, 6)
    other = net(rgb, images[:, order], change, weight[:, order], 6)
    assert added.shape == (2, 3, HEIGHT, WIDTH)
    assert torch.allclose(added[:, order], other, atol=1e-5)
    alone = net(rgb, images[:, :1], change, weight[:, :1], 6)
    assert not torch.allclose(alone, added[:, :1], atol=1e-2)


@pytest.mark.parametrize(("batch", "references"), [(1, 0), (1, 1), (2, 3)])
def test_the_operations_of_a_processor_give_the_same_frame(batch, references):
    net = trained_like()
    render, opacity, sdmap, images = inputs(references, batch)
    given = (images.abs() * 255).byte() if references else None
    start = net.start(render)
    fast, after = net(render, opacity, sdmap, start, None, None, given, operations=CPU)
    plain, state = call(net, render, opacity, sdmap, None if given is None else in_floats(given))
    # Where a reference ends, an offset that differs by rounding weighs more than the rounding
    # itself.
    for a, b in ((fast, plain), (after.recorded, state.recorded)):
        assert (a - b).abs().quantile(0.99) < 1e-4
        assert (a - b).abs().max() < 1e-2


def test_a_large_image_is_not_bent_by_small_offsets_and_takes_more_of_its_references():
    offset = torch.tensor([0.5, 1.6]).view(1, 1, 1, 2, 1) * torch.tensor([0.6, 0.8])
    heads = BlendHeads(torch.zeros(1, 1, 1, 2, 4), offset, torch.ones(1, 1, 1, 2, 12))
    half = enlarged(heads, 2)
    tenth = enlarged(heads, 10)
    assert torch.allclose(half.offset_px[..., 0, :], torch.zeros(2))
    assert torch.allclose(half.offset_px[..., 1, :].norm(), torch.tensor(1.0))
    assert torch.equal(half.weight, heads.weight)
    assert torch.equal(half.correction, heads.correction)
    assert torch.allclose(tenth.weight.exp(), torch.tensor(5.0))
    assert torch.allclose(tenth.correction, heads.correction / 5)


def test_offsets_look_up_whole_pixels_exactly_and_the_border_goes_on():
    image = torch.rand(1, HEIGHT, WIDTH, 4, generator=torch.Generator().manual_seed(1))
    offset = torch.zeros(1, HEIGHT // 2, WIDTH // 2, 2)
    offset[..., 0], offset[..., 1] = 3.0, -2.0
    moved = _sampled(image, offset)
    assert torch.allclose(moved[:, 2:, :-3], image[:, :-2, 3:], atol=1e-4)
    assert torch.allclose(moved[:, 0], moved[:, 1], atol=1e-4)  # the border goes on
