"""DISTS: structure and texture of deep features; the user provides the weights, which are not
bundled or downloaded.

Ding et al., "Image Quality Assessment: Unifying Structure and Texture Similarity", TPAMI 2022, Eqs.
4 to 8. The features are those of VGG-16, its max poolings replaced by L2 poolings (Eq. 4), and the
image itself before them. Means compare textures, covariances compare structures, each weighted per
channel. Images keep their resolution: the paper that takes this distance uses pyiqa, which does not
resize; the original command resizes the short side to 256 and gives other values.
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.video_metrics.lpips import TRUNKS, checked_tensor, load_trunk
from alpasim_plugin.lab.video_metrics.perceptual_net import check_images

NAME = "dists"
HEADS_FILE = "dists-weights.pt"
HEADS_SHA256 = "f5e65c96230b7f6ca995691647d482237e4cab8a50c5c4a5784f219ef0748218"
MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)
STABILITY = 1e-6  # c1 and c2 of Eqs. 6 and 7
POOL_EPS = 1e-12  # under the root of the L2 pooling
SMALLEST_PX = 32


class DISTS(nn.Module):
    """The distance; its weights are random, for tests, until `load_dists` replaces them."""

    mean: Tensor
    deviation: Tensor
    hann: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.plan = TRUNKS["vgg"]
        self.features = nn.ModuleDict(
            {
                str(c.index): nn.Conv2d(c.inputs, c.outputs, 3, padding=1)
                for c in self.plan.convolutions
            }
        )
        self.channels = (3, *(c.outputs for c in self.plan.convolutions if c.tapped))
        self.alpha = nn.Parameter(torch.rand(sum(self.channels)))  # of textures
        self.beta = nn.Parameter(torch.rand(sum(self.channels)))  # of structures
        self.register_buffer("mean", torch.tensor(MEAN).view(1, 3, 1, 1))
        self.register_buffer("deviation", torch.tensor(DEVIATION).view(1, 3, 1, 1))
        window = torch.tensor(
            [0.25, 0.5, 0.25]
        )  # a Hann window of 5 without its zero ends, of sum 1
        self.register_buffer("hann", torch.outer(window, window).view(1, 1, 3, 3))

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the distances ``(B,)`` of images ``(B, 3, H, W)`` in [-1, 1]; differentiable.

        Raises:
            InputError: Shapes differ, are not ``(B, 3, H, W)``, or a side is below 32 pixels.
        """
        check_images(a, b, SMALLEST_PX)
        textures = []
        structures = []
        for x, y in zip(self.activations(a), self.activations(b), strict=True):
            texture, structure = _similarities(x, y)  # (B, C) each
            textures.append(texture)
            structures.append(structure)
        weighted = torch.cat(textures, 1) @ self.alpha + torch.cat(structures, 1) @ self.beta
        return 1 - weighted / (self.alpha.sum() + self.beta.sum())

    forward = distance

    def activations(self, image: Tensor) -> list[Tensor]:
        """Return the image in [0, 1] and the five tapped activations of ``(B, 3, H, W)`` in
        [-1, 1].
        """
        raw = (image + 1) / 2
        x = (raw - self.mean) / self.deviation
        out = [raw]
        for c in self.plan.convolutions:
            if c.pooled_first:
                x = self._pool(x)
            x = F.relu(self.features[str(c.index)](x))
            if c.tapped:
                out.append(x)
        return out

    def _pool(self, x: Tensor) -> Tensor:
        """Halve the resolution by the root of a weighted mean of squares (Eq. 4)."""
        channels = x.shape[1]
        kernel = self.hann.expand(channels, 1, 3, 3)
        return (F.conv2d(x * x, kernel, stride=2, padding=1, groups=channels) + POOL_EPS).sqrt()


def _similarities(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return the similarities of texture (Eq. 6) and of structure (Eq. 7), ``(B, C)`` each, of
    features ``(B, C, h, w)``.
    """
    mean_x, mean_y = x.mean((2, 3)), y.mean((2, 3))
    texture = (2 * mean_x * mean_y + STABILITY) / (mean_x**2 + mean_y**2 + STABILITY)
    off_x, off_y = x - mean_x[..., None, None], y - mean_y[..., None, None]
    covariance = (off_x * off_y).mean((2, 3))
    variances = (off_x**2).mean((2, 3)) + (off_y**2).mean((2, 3))
    return texture, (2 * covariance + STABILITY) / (variances + STABILITY)


def missing_files(folder: str | Path) -> list[str]:
    """Return which of the two files of the distance are not in a folder."""
    return [
        name for name in (TRUNKS["vgg"].file, HEADS_FILE) if not (Path(folder) / name).is_file()
    ]


def load_dists(folder: str | Path) -> DISTS:
    """Load DISTS from a folder of weights, frozen: the VGG-16 of PyTorch's model zoo, and the file
    ``weights.pt`` of the package ``dists-pytorch`` 0.1. Digests are checked before anything is read.

    Raises:
        InputError: A missing or modified file, or one without the expected tensors.
    """
    folder = Path(folder)
    missing = missing_files(folder)
    if missing:
        raise InputError(
            f"{NAME} from {folder}: not there: {', '.join(missing)}",
            "put the files there (docs/lab/video-metrics.md says where they come from)",
        )
    net = DISTS()
    state = load_trunk(net.plan, folder)
    heads = load_weights(folder / HEADS_FILE, sha256=HEADS_SHA256)
    shape = (1, sum(net.channels), 1, 1)
    for name in ("alpha", "beta"):
        state[name] = checked_tensor(heads, name, shape, str(folder / HEADS_FILE)).flatten()
    net.load_state_dict(state, strict=False)
    return net.requires_grad_(False).eval()
