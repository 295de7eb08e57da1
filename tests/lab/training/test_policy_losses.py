"""Losses and augmentation of the learned policy's training, where errors are large and pixels dark."""

import numpy as np
import pytest
import torch

from alpasim_plugin.lab.training.policy import WIDEST, _jitter_brightness, sigma_loss


def test_sigma_grows_with_every_error_however_large_it_is():
    for deviations in (0.5, 2.0, 7.0, 100.0):
        sigma = torch.tensor(0.1, requires_grad=True)
        sigma_loss(torch.tensor(0.1 * deviations), sigma).backward()
        assert (sigma.grad < 0.0) == (deviations > 1.0), "a step down the gradient widens sigma"


def test_the_loss_of_sigma_is_the_likelihood_of_a_normal_error_and_then_a_line():
    sigma = torch.tensor(0.5)
    normal = torch.distributions.Normal(torch.tensor(0.0), sigma)
    off = torch.tensor([0.0, 0.7, -2.9])
    expected = -normal.log_prob(off) - 0.5 * np.log(2 * np.pi)
    torch.testing.assert_close(sigma_loss(off, sigma), expected)
    beyond = sigma_loss(sigma * torch.tensor([WIDEST, WIDEST + 1.0, WIDEST + 2.0]), sigma)
    assert beyond.diff().tolist() == pytest.approx([WIDEST, WIDEST])


@pytest.mark.parametrize("contrast", [0.85, 1.0, 1.15])
@pytest.mark.parametrize("brightness", [0.85, 1.0, 1.15])
def test_brightness_and_contrast_keep_the_order_of_levels(contrast, brightness):
    levels = np.arange(256, dtype=np.uint8)[None, :, None].repeat(3, axis=2)
    changed = _jitter_brightness(levels, contrast, brightness)[0, :, 0].astype(int)
    assert (np.diff(changed) >= 0).all(), "a darker pixel stays the darker one"
    expected = np.clip(brightness * (contrast * (np.arange(256) - 128.0) + 128.0), 0, 255)
    assert np.abs(changed - expected).max() <= 0.5
