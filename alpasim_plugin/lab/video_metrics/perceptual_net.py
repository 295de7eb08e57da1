"""`perceptual-syn`: a perceptual distance over a small frozen feature network. It is not LPIPS: it
    is trained on synthetic scenes.

The definition is that of LPIPS (Zhang et al., CVPR 2018, Eq. 1): features of every stage, scaled to
unit length over the channels, squared difference, a non-negative weight per channel, mean over the
image, sum over the stages. Values cannot be compared with published LPIPS numbers.
docs/lab/video-metrics.md says how far it can be trusted.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import load_weights, weight

NAME = "perceptual-syn"
WIDTHS = (16, 32, 64, 96)  # channels of the stages, at 1/2, 1/4, 1/8 and 1/16 of the resolution
SMALLEST_PX = 16
HEAD_INIT = -3.0  # before softplus
# added to the squared length of a feature, against division by nearly zero in flat dark cells
LENGTH_EPS = 1e-4


class FeatureNet(nn.Module):
    """Four convolution stages, each at half the resolution of the previous one."""

    def __init__(self) -> None:
        super().__init__()
        first, second, third, fourth = WIDTHS
        self.stages = nn.ModuleList(
            [
                nn.Sequential(nn.Conv2d(3, first, 4, 2, 1), _activation()),
                nn.Sequential(nn.Conv2d(first, second, 3, 2, 1), _activation()),
                nn.Sequential(nn.Conv2d(second, third, 3, 2, 1), _activation()),
                nn.Sequential(
                    nn.Conv2d(third, fourth, 3, 2, 1),
                    _activation(),
                    nn.Conv2d(fourth, fourth, 3, 1, 1),
                    _activation(),
                ),
            ]
        )

    def forward(self, image: Tensor) -> list[Tensor]:
        """Map ``(B, 3, H, W)`` in [-1, 1] to features ``(B, C, H / 2^k, W / 2^k)`` of stages k = 1
        to 4.
        """
        out = []
        for stage in self.stages:
            image = stage(image)
            out.append(image)
        return out


class PerceptualDistance(nn.Module):
    """Distance of two images in feature space.

    Example:
        >>> net = PerceptualDistance().requires_grad_(False)
        >>> a = torch.zeros(2, 3, 32, 48)
        >>> net.distance(a, a)
        tensor([0., 0.])
    """

    def __init__(self) -> None:
        super().__init__()
        self.trunk = FeatureNet()
        # Before softplus, which keeps the weights positive.
        self.heads = nn.ParameterList([nn.Parameter(torch.full((c,), HEAD_INIT)) for c in WIDTHS])

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the distances ``(B,)`` of images ``(B, 3, H, W)`` in [-1, 1]; differentiable in
        both, zero for equal ones.

        Raises:
            InputError: Shapes differ, are not ``(B, 3, H, W)``, or a side is below 16 pixels.
        """
        check_images(a, b, SMALLEST_PX)
        return self.feature_distance(self.trunk(a), self.trunk(b))

    forward = distance

    def feature_distance(self, a: list[Tensor], b: list[Tensor]) -> Tensor:
        """Return the distances ``(B,)`` of features as `FeatureNet` gives them."""
        parts = [
            _stage_distance(x, y, F.softplus(head))
            for x, y, head in zip(a, b, self.heads, strict=True)
        ]
        return torch.stack(parts).sum(0)


def load_perceptual() -> PerceptualDistance:
    """Load the distance `perceptual-syn`, frozen, in float32."""
    source = shipped_weights()
    net = PerceptualDistance()
    net.load_state_dict(
        {key: weight(key, value, str(source)) for key, value in load_weights(source).items()}
    )
    return net.requires_grad_(False).eval()


def shipped_weights() -> Path:
    """Return the path of the shipped weights."""
    return (
        Path(str(resources.files("alpasim_plugin.lab.video_metrics")))
        / "weights"
        / f"{NAME}.safetensors"
    )


def check_images(a: Tensor, b: Tensor, smallest_px: int) -> None:
    """Refuse other tensors than two batches of images ``(B, 3, H, W)`` of equal shape.

    Raises:
        InputError: Another shape.
    """
    if a.shape != b.shape or a.ndim != 4 or a.shape[1] != 3 or min(a.shape[2:]) < smallest_px:
        raise InputError(
            f"two batches of images: shapes {tuple(a.shape)} and {tuple(b.shape)}",
            f"give two tensors (B, 3, H, W) of one shape, sides of at least {smallest_px}",
        )


def _stage_distance(a: Tensor, b: Tensor, head: Tensor) -> Tensor:
    difference = unit(a) - unit(b)  # (B, C, h, w)
    return torch.einsum("bchw,c->b", difference * difference, head) / (a.shape[2] * a.shape[3])


def unit(x: Tensor) -> Tensor:
    """Scale features ``(B, C, h, w)`` to unit length over the channels."""
    return x * torch.rsqrt((x * x).sum(1, keepdim=True) + LENGTH_EPS)


def _activation() -> nn.Module:
    return nn.LeakyReLU(0.1, inplace=True)  # leaky, since units die under a plain ReLU
