"""DISTS with VGG-16, from the user's weights; nothing is bundled or downloaded.

Ding et al., "Image Quality Assessment: Unifying Structure and Texture Similarity", 2020. Six stages
(the image itself, then relu1_2 to relu5_3), poolings by the length of a 3x3 Hann window, and per
channel a similarity of means and one of covariances, weighted by alpha and beta. No resizing, as in
pyiqa; the authors' demonstration scales the short side to 256 first, which gives other values
(``dists_256``).
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import file_sha256, load_weights, weight
from alpasim_plugin.lab.video_metrics.lpips import TRUNKS, Trunk
from alpasim_plugin.lab.video_metrics.perceptual_net import check_images

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
SMALL = 1e-6  # the constants of both similarities
ROOT = 1e-12  # under the pooling's root
SMALLEST_PX = 32
HEADS = "dists.pt"
HEADS_SHA256 = "f5e65c96230b7f6ca995691647d482237e4cab8a50c5c4a5784f219ef0748218"


class DISTS(nn.Module):
    """The distance; randomly initialised, for tests, until weights are loaded (`load_dists`).

    Args:
        plan: Of the trunk; VGG-16 but in tests.
    """

    mean: Tensor
    std: Tensor
    hann: Tensor

    def __init__(self, plan: Trunk = TRUNKS["vgg"]) -> None:
        super().__init__()
        self.plan = plan
        self.channels = [3, *(c.outputs for c in plan.convolutions if c.tapped)]
        layers = {
            str(c.index): nn.Conv2d(c.inputs, c.outputs, c.kernel, c.stride, c.padding)
            for c in self.plan.convolutions
        }
        self.features = nn.ModuleDict(layers)
        self.alpha = nn.Parameter(torch.rand(sum(self.channels)))
        self.beta = nn.Parameter(torch.rand(sum(self.channels)))
        self.register_buffer("mean", torch.tensor(MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(STD).view(1, 3, 1, 1))
        line = torch.tensor([0.5, 1.0, 0.5])  # hanning(5) without its zeros
        self.register_buffer("hann", line[:, None] * line / line.sum() ** 2)

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the distances ``(B,)`` of images ``(B, 3, H, W)`` in [-1, 1]; zero for equal ones.

        Raises:
            InputError: Shapes differ, are not ``(B, 3, H, W)``, or a side is below 32 pixels.
        """
        check_images(a, b, SMALLEST_PX)
        total = self.alpha.sum() + self.beta.sum()
        alpha, beta = (
            torch.split(w, self.channels) for w in (self.alpha / total, self.beta / total)
        )
        score = a.new_zeros(len(a))
        for x, y, wa, wb in zip(
            self.stages((a + 1) / 2), self.stages((b + 1) / 2), alpha, beta, strict=True
        ):
            mx, my = x.mean((2, 3)), y.mean((2, 3))
            vx, vy = (
                (x - mx[..., None, None]).square().mean((2, 3)),
                (y - my[..., None, None]).square().mean((2, 3)),
            )
            covariance = (x * y).mean((2, 3)) - mx * my
            means = (2 * mx * my + SMALL) / (mx**2 + my**2 + SMALL)
            structure = (2 * covariance + SMALL) / (vx + vy + SMALL)
            score = score + (wa * means + wb * structure).sum(1)
        return 1 - score

    forward = distance

    def stages(self, image: Tensor) -> list[Tensor]:
        """Return the six stages of ``(B, 3, H, W)`` in 0 to 1; the first is the image."""
        out, x = [image], (image - self.mean) / self.std
        for c in self.plan.convolutions:
            if c.pooled_first:
                kernel = self.hann.expand(x.shape[1], 1, 3, 3)
                x = (F.conv2d(x * x, kernel, stride=2, padding=1, groups=x.shape[1]) + ROOT).sqrt()
            x = F.relu(self.features[str(c.index)](x))
            if c.tapped:
                out.append(x)
        return out


def missing_files(folder: str | Path, plan: Trunk = TRUNKS["vgg"]) -> list[str]:
    """Return which of the two files are not in a folder."""
    return [name for name in (plan.file, HEADS) if not (Path(folder) / name).is_file()]


def load_dists(
    folder: str | Path, heads_sha256: str = HEADS_SHA256, plan: Trunk = TRUNKS["vgg"]
) -> DISTS:
    """Load DISTS from a folder of weights, frozen: PyTorch's VGG-16 and the 2 x 1475 weights as
    torchmetrics ships them.

    Args:
        folder: Of the files.
        heads_sha256: Expected digest of `HEADS`.
        plan: Of the trunk; VGG-16 but in tests.

    Raises:
        InputError: A missing or modified file, or one without the expected tensors.
    """
    folder, net = Path(folder), DISTS(plan)
    if missing := missing_files(folder, plan):
        raise InputError(
            f"{folder}: not there: {', '.join(missing)}",
            "put the files there (docs/lab/judges.md)",
        )
    digest = file_sha256(folder / plan.file)
    if not digest.startswith(plan.digest_start):
        raise InputError(
            f"{folder / plan.file}: sha256 {digest}, which does not begin with {plan.digest_start}",
            "copy the file again",
        )
    trunk, heads = (
        load_weights(folder / plan.file),
        load_weights(folder / HEADS, sha256=heads_sha256),
    )
    state: dict[str, Tensor] = {}
    wanted = {
        f"features.{c.index}.{part}": trunk
        for c in plan.convolutions
        for part in ("weight", "bias")
    } | {
        "alpha": heads,
        "beta": heads,
    }
    own = net.state_dict()
    for key, source in wanted.items():
        value = source.get(key)
        if value is None or value.numel() != own[key].numel():
            found = "it is missing" if value is None else f"its shape is {tuple(value.shape)}"
            raise InputError(
                f"{key} in {folder}: {found}",
                f"give the published weights, where it has {own[key].numel()} numbers",
            )
        state[key] = weight(key, value.reshape(own[key].shape), torch.float32, str(folder))
    net.load_state_dict(state, strict=False)
    return net.requires_grad_(False).eval()
