"""Measure how near a model's image is to a view: SSIM as a training loss, PSNR and SSIM of a
reconstruction on posed views.

SSIM against a fixed target is differentiable by the image in closed form: the window is separable
and symmetric, so with zeros beyond the border the blur is its own adjoint, and the gradient is
three blurs of closed forms. What depends on the target alone is computed once per view. Autograd
through convolutions takes ten times as long on the CPU, where OpenCV blurs.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import implementation, upload
from alpasim_plugin.core.image_metrics import C1, C2, SIGMA_PX, WINDOW_PX, gaussian_blur
from alpasim_plugin.core.types import U8


@dataclass(frozen=True, eq=False)
class Comparison:
    """One view and what the model shows there.

    Attributes:
        name: Of the view.
        image: ``(H, W, 3)`` uint8, the model's image, 8 bits as a file would hold it.
        truth: ``(H, W, 3)`` uint8.
        psnr_db: Over the pixels that count.
        ssim: Mean over the image, masked pixels taken from the truth.
    """

    name: str
    image: U8
    truth: U8
    psnr_db: float
    ssim: float


class SsimTarget:
    """The image that others are compared with; the value is that of
    `alpasim_plugin.core.image_metrics.ssim`.

    Args:
        target: ``(H, W, 3)`` float32, 0..1.
    """

    def __init__(self, target: Tensor) -> None:
        self.y = target.detach().contiguous()
        window = cv2.getGaussianKernel(WINDOW_PX, SIGMA_PX, cv2.CV_32F)
        self.window = upload(window, self.y.device)
        self.mean = self.blur(self.y)
        self.square = self.blur(self.y * self.y)

    def ssim(self, image: Tensor) -> Tensor:
        """Return the mean structural similarity with an image ``(H, W, 3)``, differentiable by the
        image.
        """
        return _Ssim.apply(image, self)  # type: ignore[no-untyped-call]

    def blur(self, image: Tensor) -> Tensor:
        """Return local means ``(H, W, C)``."""
        return implementation(image.device, _blurred_on_host, _blurred_on_card)(image, self.window)


def _blurred_on_host(image: Tensor, _: Tensor) -> Tensor:
    return torch.from_numpy(gaussian_blur(image.numpy()))


def _blurred_on_card(image: Tensor, window: Tensor) -> Tensor:
    planes = image.permute(2, 0, 1)[:, None]
    pad = WINDOW_PX // 2
    across = F.conv2d(planes, window.view(1, 1, 1, -1), padding=(0, pad))
    blurred = F.conv2d(across, window.view(1, 1, -1, 1), padding=(pad, 0))
    return blurred[:, 0].permute(1, 2, 0)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: SsimTarget) -> Tensor:
        x = image.detach().contiguous()
        my = target.mean
        mx = target.blur(x)
        mxx = target.blur(x * x)
        mxy = target.blur(x * target.y)
        a1 = 2 * mx * my + C1
        a2 = 2 * (mxy - mx * my) + C2
        b1 = mx * mx + my * my + C1
        b2 = mxx - mx * mx + target.square - my * my + C2
        over = (b1 * b2).reciprocal()
        s = a1 * a2 * over
        if ctx.needs_input_grad[0]:
            by_mean = 2 * (my * (a2 - a1) * over - mx * s * (b1.reciprocal() - b2.reciprocal()))
            ctx.gradient = (
                target.blur(by_mean)
                - 2 * x * target.blur(s / b2)
                + target.y * target.blur(2 * a1 * over)
            ) / s.numel()
        return s.mean(dtype=torch.float64).float()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0] * ctx.gradient, None
