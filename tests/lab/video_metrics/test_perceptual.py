"""`perceptual-syn`: what holds for any weights, and what the shipped ones must do on pictures made
here.
"""

import cv2
import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.video_metrics.perceptual_net import (
    load_perceptual,
)


def pictures(count=2, height=40, width=56, seed=0):
    """Draw soft coloured blobs ``(count, 3, height, width)`` in [-1, 1]."""
    noise = stream("nets", seed, "perceptual").standard_normal((count, height, width, 3))
    soft = np.stack([cv2.GaussianBlur(x, (0, 0), 2.0) for x in noise])
    return torch.from_numpy(np.clip(soft / soft.std() / 2.5, -1, 1)).permute(0, 3, 1, 2).float()


def blurred(image, sigma):
    arrays = image.permute(0, 2, 3, 1).numpy()
    return torch.from_numpy(np.stack([cv2.GaussianBlur(x, (0, 0), sigma) for x in arrays])).permute(
        0, 3, 1, 2
    )


@pytest.fixture(scope="module")
def net():
    return load_perceptual()


def test_distance_is_zero_for_equal_and_symmetric_for_other_pictures(
    net,
):
    a = pictures()
    b = pictures(seed=1)
    assert torch.equal(net.distance(a, a), torch.zeros(2))
    torch.testing.assert_close(net.distance(a, b), net.distance(b, a))
    assert torch.all(net.distance(a, b) > 0)


def test_distance_is_the_sum_over_stages_written_out(net):
    a = pictures(1)
    b = pictures(1, seed=1)
    wanted = 0.0
    for x, y, head in zip(net.trunk(a), net.trunk(b), net.heads, strict=True):
        p, q = (f[0].double() / (f[0].double().square().sum(0) + 1e-4).sqrt() for f in (x, y))
        wanted += float(
            ((p - q) ** 2 * torch.nn.functional.softplus(head.double())[:, None, None])
            .sum(0)
            .mean()
        )
    assert float(net.distance(a, b)) == pytest.approx(wanted, rel=1e-5)


def test_shipped_distance_grows_with_blur_and_noise(net):
    a = pictures(4, 64, 96)
    noise = torch.from_numpy(stream("nets", 0, "noise").standard_normal(a.shape)).float()
    for damaged in (
        [blurred(a, s) for s in (0.5, 1.0, 2.0, 4.0)],
        [(a + s * noise).clamp(-1, 1) for s in (0.02, 0.05, 0.1, 0.3)],
    ):
        rungs = torch.stack([net.distance(d, a) for d in damaged])
        assert torch.all(rungs.diff(dim=0) > 0)


@pytest.mark.parametrize(
    ("a", "b"),
    [((1, 3, 32, 32), (2, 3, 32, 32)), ((3, 32, 32), (3, 32, 32)), ((1, 3, 8, 32), (1, 3, 8, 32))],
)
def test_pictures_that_cannot_be_compared_are_refused(net, a, b):
    with pytest.raises(InputError):
        net.distance(torch.zeros(a), torch.zeros(b))
