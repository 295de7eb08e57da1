"""The term sees patterns of the cells and nothing else: noise, blur and edges do not count, and it
falls by its own gradient.
"""

import numpy as np
import pytest
import torch
from torch.nn import functional

from alpasim_plugin.lab.training.grid_term import grid_term

SIDE = 96


def picture(seed=0):
    """A smooth picture with an edge, ``(2, 2, 96, 96, 3)``."""
    rng = np.random.default_rng(seed)
    coarse = torch.from_numpy(rng.uniform(-0.1, 0.1, (4, 3, 12, 12)).astype(np.float32))
    smooth = functional.interpolate(coarse, size=(SIDE, SIDE), mode="bicubic", align_corners=False)
    smooth[..., 37:] += 0.4
    fine = torch.from_numpy(rng.normal(0, 0.003, smooth.shape).astype(np.float32))
    return (smooth + fine).permute(0, 2, 3, 1).unflatten(0, (2, 2))


def pattern(period, size):
    """A line at every border of a cell, in columns and rows."""
    line = (torch.arange(SIDE) % period == 0).float() * size
    return (line[:, None] + line[None, :])[None, None, :, :, None]


def test_the_truth_has_none():
    assert float(grid_term(picture(), picture())) == 0


@pytest.mark.parametrize("period", [4, 16])
def test_it_grows_with_a_pattern_of_a_cell(period):
    truth = picture()
    found = [
        float(grid_term(truth + pattern(period, size), truth)) for size in (0.0, 0.005, 0.01, 0.02)
    ]
    assert found == sorted(found)
    assert found[-1] > 0.02


def test_blur_noise_and_contrast_count_little():
    truth = picture()
    marked = float(grid_term(truth + pattern(4, 0.02), truth))
    flat = truth.flatten(0, 1).permute(0, 3, 1, 2)
    blurred = (
        functional.avg_pool2d(functional.pad(flat, (1, 1, 1, 1), mode="replicate"), 3, 1)
        .permute(0, 2, 3, 1)
        .unflatten(0, (2, 2))
    )
    noisy = truth + 0.003 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    for other in (blurred, noisy, 0.8 * truth):
        assert float(grid_term(other, truth)) < 0.35 * marked
