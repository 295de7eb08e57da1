"""The generator in pixels: cells, sizes from weights, an explicit state, no trace of its grid at
the start.
"""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.pixel_generator import (
    PixelGenerator,
    PixelSizes,
    dense_source,
    pixel_noise,
    pixel_source,
    sparse_source,
)
from alpasim_plugin.fixers.network.pixel_layers import Upsample, cells, pixels

SMALL = PixelSizes((8, 12, 16), (1, 0, 2, 1, 1), 8, 4)


def network(seed=0, sizes=SMALL):
    torch.manual_seed(seed)
    return PixelGenerator(sizes).requires_grad_(False)


def frames(count, seed=1, batch=2):
    source = torch.Generator().manual_seed(seed)

    def draw(channels):
        return torch.rand(batch, 32, 48, channels, generator=source)

    return [(2 * draw(3) - 1, draw(1), 2 * draw(3) - 1) for _ in range(count)]


def rolled(net, clip):
    state = net.start(clip[0][0])
    out = []
    for render, opacity, sdmap in clip:
        made, state = net(render, opacity, sdmap, state)
        out.append(made)
    return out, state


def test_cells_hold_their_pixels_in_rows_and_come_apart_again():
    x = torch.arange(2 * 8 * 12 * 3.0).view(2, 8, 12, 3)
    packed = cells(x, 4)
    assert torch.equal(packed[1, 1, 2].view(4, 4, 3), x[1, 4:8, 8:12])
    assert torch.equal(pixels(packed, 4), x)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("refine.bias", None),
        ("more.weight", torch.zeros(2)),
        ("mix.weight", torch.zeros(8, 8, 1, 1)),
        ("mix.bias", torch.full((8,), float("nan"))),
        ("stem.weight", None),
    ],
)
def test_weights_that_do_not_fit_are_named(key, value):
    tensors = network().state_dict() | {key: value}
    kept = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    with pytest.raises(InputError, match=key):
        PixelGenerator.from_state_dict(kept)


def test_the_state_is_all_that_goes_on():
    net = network()
    clip = frames(4)
    whole, _ = rolled(net, clip)
    _, after_two = rolled(net, clip[:2])
    third, _ = net(*clip[2], after_two)
    assert torch.equal(third, whole[2])
    other, _ = rolled(net, [*clip[:3], frames(1, seed=9)[0]])
    assert all(
        torch.equal(a, b) for a, b in zip(other[:3], whole[:3], strict=True)
    )  # later frames change nothing
    assert not torch.equal(net(*clip[3], after_two)[0], whole[3])  # and the past is seen


def test_time_one_is_the_deployed_step_and_other_times_differ():
    net, (frame,) = network(), frames(1)
    torch.nn.init.normal_(net.time.weight)
    state = net.start(frame[0])
    source = torch.randn_like(frame[0])
    deployed, _ = net(*frame, state, source)
    at_one, _ = net(*frame, state, source, torch.ones(2))
    assert_close(at_one, deployed, atol=1e-6, rtol=0)
    assert not torch.allclose(
        net(*frame, state, source, torch.tensor([1.0, 0.5]))[0][1], deployed[1]
    )


def test_noise_enters_holes_alone():
    opacity = torch.tensor([0.0, 0.25, 0.5, 0.9, 1.0])
    kept = pixel_source(torch.ones(5), opacity, torch.zeros(5))
    assert kept.tolist() == [0, 0.5, 1, 1, 1]
    ((render, alpha, _),) = frames(1)
    keys = torch.tensor([5 - 2**63, 7])[: len(render)]
    everywhere = np.arange(render[0, ..., 0].numel())
    noise = [pixel_noise(int(key), everywhere).reshape(render.shape[1:]) for key in keys]
    dense = pixel_source(render, alpha, torch.from_numpy(np.stack(noise)))
    assert_close(sparse_source(render, alpha, keys), dense)
    assert_close(dense_source(render, alpha, keys), dense, rtol=0, atol=1e-6)
    assert sparse_source(render, torch.ones_like(alpha), keys) is render


def test_an_upsampled_cell_starts_flat():
    out = Upsample(5, 3)(torch.randn(1, 4, 6, 5))
    assert out.shape == (1, 8, 12, 3)
    assert_close(out[:, ::2, ::2], out[:, 1::2, 1::2])


def test_weights_say_the_sizes():
    net = network()
    again = PixelGenerator.from_state_dict(net.state_dict())
    assert again.sizes == SMALL
    clip = frames(1)
    assert torch.equal(rolled(again, clip)[0][0], rolled(net, clip)[0][0])
    plain = network(sizes=PixelSizes((8, 8, 8), hidden=0))
    assert PixelGenerator.from_state_dict(plain.state_dict()).sizes.hidden == 0


def test_clips_of_a_batch_do_not_see_each_other():
    net = network()
    clip = frames(3)
    whole, _ = rolled(net, clip)
    for b in range(2):
        alone, _ = rolled(net, [tuple(x[b : b + 1] for x in frame) for frame in clip])  # type: ignore[misc]
        for one, both in zip(alone, whole, strict=True):
            assert_close(one[0], both[b], atol=2e-6, rtol=0)
