"""A term against patterns of the network's own grid (checkerboard artefacts; Odena et al.,
Deconvolution and Checkerboard Artifacts, 2016).

A generator that works on cells of 4 and 16 pixels may draw their borders: the steps from a pixel to
its neighbour are then larger in some columns of a cell than in others. In the truth they are not,
apart from chance, and chance is the same in both images.
"""

from __future__ import annotations

import torch
from torch import Tensor

PERIODS = (4, 16)  # cells of the generator at 1/4 and at 1/16
# steps above count as this one: a grid shows on flat surfaces, and edges and texture say nothing
# about it
LARGEST = 0.03
LEAST = 1e-3  # added to a mean step, so that a flat image has a ratio


def grid_term(made: Tensor, truth: Tensor) -> Tensor:
    """Return how unevenly the steps between neighbouring pixels are spread over a cell's columns
    and rows, against the truth.

    Args:
        made, truth: ``(B, T, H, W, 3)`` in [-1, 1]; the grid begins in the corner, and sides are
            multiples of 16.

    Returns:
        Mean over streams, axes and periods of ``|r_p - mean_p r_p|``, where ``r_p`` is the
        logarithm of the mean step at place p of a cell over that of the truth. Zero for the truth
        itself; 0.02 is a pattern of about 2 % of the steps.
    """
    terms = []
    for axis in (2, 3):
        steps = [_steps(images, axis) for images in (made, truth)]
        for period in PERIODS:
            ratios = torch.log(_by_place(steps[0], period) / _by_place(steps[1], period))
            terms.append((ratios - ratios.mean(dim=1, keepdim=True)).abs().mean())
    return torch.stack(terms).mean()


def _steps(images: Tensor, axis: int) -> Tensor:
    """Return the mean step to the next pixel at every place of an axis ``(B, N - 1)``."""
    step = images.diff(dim=axis).abs().clamp(max=LARGEST)
    return step.mean(dim=[i for i in range(1, images.ndim) if i != axis])


def _by_place(steps: Tensor, period: int) -> Tensor:
    """Return the mean over cells ``(B, places)``; an image of one cell has no step across the
    cell's end.
    """
    places = min(period, steps.shape[1])
    return (
        torch.stack([steps[:, place::period].mean(dim=1) for place in range(places)], dim=1) + LEAST
    )
