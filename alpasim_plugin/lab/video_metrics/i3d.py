"""Inflated Inception, the network of the Frechet video distance, as its weights are published for
PyTorch.

Carreira and Zisserman, "Quo Vadis, Action Recognition? A New Model and the Kinetics Dataset", CVPR
2017, Fig. 3. The names of the modules are the keys of the published file. Padding is TensorFlow's:
as much as makes the output ``ceil(size / stride)``, the odd pixel behind.
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.fixers.network.checkpoints import load_checked, load_weights

CLASSES = 400  # of Kinetics-400
SIDE_PX = 224
FEWEST_FRAMES = 9  # the last pooling spans two cells of eight frames
Sizes = tuple[int, int, int]  # along time, rows, columns
# Channels of the four branches of each mixed block: 1x1; 1x1 and 3x3; 1x1 and 3x3; pooled 1x1
BRANCHES = {
    "Mixed_3b": (64, 96, 128, 16, 32, 32),
    "Mixed_3c": (128, 128, 192, 32, 96, 64),
    "Mixed_4b": (192, 96, 208, 16, 48, 64),
    "Mixed_4c": (160, 112, 224, 24, 64, 64),
    "Mixed_4d": (128, 128, 256, 24, 64, 64),
    "Mixed_4e": (112, 144, 288, 32, 64, 64),
    "Mixed_4f": (256, 160, 320, 32, 128, 128),
    "Mixed_5b": (256, 160, 320, 32, 128, 128),
    "Mixed_5c": (384, 192, 384, 48, 128, 128),
}


class I3D(nn.Module):
    """The network up to its class scores."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv3d_1a_7x7 = Unit(3, 64, (7, 7, 7), (2, 2, 2))
        self.MaxPool3d_2a_3x3 = SamePool((1, 3, 3), (1, 2, 2))
        self.Conv3d_2b_1x1 = Unit(64, 64)
        self.Conv3d_2c_3x3 = Unit(64, 192, (3, 3, 3))
        self.MaxPool3d_3a_3x3 = SamePool((1, 3, 3), (1, 2, 2))
        channels = self._add_blocks(192, "Mixed_3b", "Mixed_3c")
        self.MaxPool3d_4a_3x3 = SamePool((3, 3, 3), (2, 2, 2))
        channels = self._add_blocks(
            channels, "Mixed_4b", "Mixed_4c", "Mixed_4d", "Mixed_4e", "Mixed_4f"
        )
        self.MaxPool3d_5a_2x2 = SamePool((2, 2, 2), (2, 2, 2))
        channels = self._add_blocks(channels, "Mixed_5b", "Mixed_5c")
        self.stages = list(self._modules)  # in the order of their use
        self.logits = Unit(channels, CLASSES, is_last=True)

    def _add_blocks(self, channels: int, *names: str) -> int:
        """Add mixed blocks and return the channels of the last."""
        for name in names:
            self.add_module(name, Mixed(channels, BRANCHES[name]))
            first, _, second, _, third, fourth = BRANCHES[name]
            channels = first + second + third + fourth
        return channels

    def forward(self, video: Tensor) -> Tensor:
        """Return the scores before the softmax ``(B, 400)``, averaged over time, of videos ``(B, 3,
        T, 224, 224)`` in [-1, 1], at least nine frames.
        """
        for name in self.stages:
            video = getattr(self, name)(video)
        pooled = F.avg_pool3d(video, (2, 7, 7), (1, 1, 1))
        return self.logits(pooled)[..., 0, 0].mean(dim=2)


class Mixed(nn.Module):
    """Four branches side by side."""

    def __init__(self, inputs: int, branches: tuple[int, ...]) -> None:
        super().__init__()
        first, reduced_second, second, reduced_third, third, fourth = branches
        self.b0 = Unit(inputs, first)
        self.b1a = Unit(inputs, reduced_second)
        self.b1b = Unit(reduced_second, second, (3, 3, 3))
        self.b2a = Unit(inputs, reduced_third)
        self.b2b = Unit(reduced_third, third, (3, 3, 3))
        self.b3a = SamePool((3, 3, 3), (1, 1, 1))
        self.b3b = Unit(inputs, fourth)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, C, T, h, w)`` to the joined channels of the branches."""
        branches = (
            self.b0(x),
            self.b1b(self.b1a(x)),
            self.b2b(self.b2a(x)),
            self.b3b(self.b3a(x)),
        )
        return torch.cat(branches, dim=1)


class Unit(nn.Module):
    """A convolution with batch norm and a rectifier; the last has a bias alone."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: Sizes = (1, 1, 1),
        stride: Sizes = (1, 1, 1),
        is_last: bool = False,
    ) -> None:
        super().__init__()
        self.conv3d = nn.Conv3d(inputs, outputs, kernel, stride, bias=is_last)
        self.bn = None if is_last else Norm(outputs)
        self.kernel = kernel
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, C, T, h, w)``."""
        x = self.conv3d(pad_as_tensorflow(x, self.kernel, self.stride))
        return x if self.bn is None else F.relu(self.bn(x))


class Norm(nn.Module):
    """A batch norm with fixed statistics."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, C, T, h, w)``."""
        return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias)


class SamePool(nn.Module):
    """A max pooling; the padding is zero, which rectified inputs do not fall below."""

    def __init__(self, kernel: Sizes, stride: Sizes) -> None:
        super().__init__()
        self.kernel = kernel
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, C, T, h, w)``."""
        return F.max_pool3d(
            pad_as_tensorflow(x, self.kernel, self.stride), self.kernel, self.stride
        )


def pad_as_tensorflow(x: Tensor, kernel: Sizes, stride: Sizes) -> Tensor:
    """Pad the last three axes with zeros, so that the output has ``ceil(size / stride)`` cells."""
    pads: list[int] = []
    for size, k, s in zip(reversed(x.shape[2:]), reversed(kernel), reversed(stride), strict=True):
        total = max(k - (size % s or s), 0)
        pads += [total // 2, total - total // 2]
    return F.pad(x, pads)


def video_tensor(video: Tensor) -> Tensor:
    """Return frames ``(T, H, W, 3)`` uint8 as ``(1, 3, T, 224, 224)`` in [-1, 1]: each frame is
    squeezed to a square, bilinear.
    """
    frames = video.permute(0, 3, 1, 2).float()  # (T, 3, H, W)
    square = F.interpolate(frames, size=(SIDE_PX, SIDE_PX), mode="bilinear", align_corners=False)
    return (2 * square / 255 - 1).transpose(0, 1)[None]


def load_i3d(path: Path) -> I3D:
    """Load the network from a file of its weights, frozen.

    Raises:
        InputError: No such file, or other tensors.
    """
    net = I3D()
    tensors = load_weights(path)
    used = {k: value for k, value in tensors.items() if not k.endswith("num_batches_tracked")}
    load_checked(net, used, str(path))
    return net.requires_grad_(False).eval()
