"""Structural similarity and its gradient on the CPU, some ten times as fast as through `similarity.ssim`, its readable twin.

The window is separable and symmetric, so with zeros beyond the border the blur is its own adjoint: the gradient is three blurs of closed
forms. What depends on the truth alone is computed once per view.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from alpasim_plugin.gaussians.fit.similarity import C1, C2, SIGMA, WINDOW
from alpasim_plugin.types import F32

_KERNEL = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_32F)


class SsimTruth:
    """The image that others are compared with.

    Args:
        truth: ``(H, W, 3)`` float32 on the CPU, 0..1.
    """

    def __init__(self, truth: Tensor) -> None:
        self.y: F32 = truth.detach().contiguous().numpy()
        self.mean: F32 = _blur(self.y)
        self.square: F32 = _blur(self.y * self.y)

    def similarity(self, image: Tensor) -> Tensor:
        """Return the mean structural similarity with an image ``(H, W, 3)``, differentiable by the image."""
        value: Tensor = _Ssim.apply(image, self)  # type: ignore[no-untyped-call]
        return value


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, truth: SsimTruth) -> Tensor:
        x, my = image.detach().contiguous().numpy(), truth.mean
        mx, mxx, mxy = _blur(x), _blur(x * x), _blur(x * truth.y)
        a1, a2 = 2 * mx * my + np.float32(C1), 2 * (mxy - mx * my) + np.float32(C2)
        b1 = mx * mx + my * my + np.float32(C1)
        b2 = mxx - mx * mx + truth.square - my * my + np.float32(C2)
        over = np.reciprocal(b1 * b2)
        s = a1 * a2 * over
        if ctx.needs_input_grad[0]:
            by_mean = 2 * (my * (a2 - a1) * over - mx * s * (np.reciprocal(b1) - np.reciprocal(b2)))
            gradient = _blur(by_mean) - 2 * x * _blur(s / b2) + truth.y * _blur(2 * a1 * over)
            ctx.gradient = torch.from_numpy(gradient / np.float32(s.size))
        return torch.tensor(s.mean(dtype=np.float64), dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0] * ctx.gradient, None


def _blur(image: npt.NDArray[np.floating]) -> F32:
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, _KERNEL, _KERNEL, borderType=cv2.BORDER_CONSTANT))
