"""The loss of the temporal Harmonizer between frames: on a device as on the host."""

import numpy as np
import pytest
import torch

from alpasim_plugin.lab.training.warping import flow_between, warping_loss
from tests.pretended_device import pretended_device


def frames():
    rng = np.random.default_rng(0)
    image = torch.from_numpy(rng.random((1, 3, 6, 8)).astype(np.float32))
    large = torch.nn.functional.interpolate(image, size=(24, 32), mode="bicubic")
    present = 2 * large.clamp(0, 1) - 1
    return present.roll(1, dims=3)[:, :, None], present


def loss(earlier, present):
    predicted = present.clone().requires_grad_()
    value = warping_loss(predicted, earlier, flow_between(earlier, present))
    value.backward()
    return value.detach(), predicted.grad


def test_a_device_gives_the_loss_of_the_host():
    earlier, present = frames()
    expected, gradient = loss(earlier, present)
    with pytest.MonkeyPatch.context() as patch, pretended_device(patch):
        value, slope = loss(earlier.to("cuda"), present.to("cuda"))
        assert value.device.type == "cuda"
        value, slope = value.cpu(), slope.cpu()
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(slope, gradient)
